"""Policies that do harm, to try a guard on: they ram, grind, fling, flail, turn hostile, or act late."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy, StatefulPolicy
from asm_gym.policies.registry import make_policy

BANG_STEPS = 10  # control steps for which a bang-bang policy goes on in one direction
TURNS_AT = 40  # control step in which a healthy policy turns hostile
LATE_STEPS = 10  # delay of stale actions [control steps]
Floats = NDArray[np.floating[Any]]


class Hostile(StatefulPolicy):
    """Acts by a ``rule``, whatever it observes, at a share ``speed`` of the full change of the hand's pose."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float, rule: Rule) -> None:
        self._space: Any = env.action_space
        self.size = int(np.prod(env.action_space.shape or ()))
        self._rule, self._speed, self.seed = rule, speed, seed
        self.held = np.zeros(self.size)  # what a rule goes on with

    def begin(self, observation: Any) -> tuple[int, np.random.Generator]:
        return 0, np.random.default_rng(self.seed)

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        step, rng = state
        first = self._speed * np.asarray(self._rule(self, step, rng), np.float64)
        action = np.pad(first, (0, self.size - len(first)))
        return np.clip(action, self._space.low, self._space.high).astype(np.float32), (
            step + 1,
            rng,
        )


Rule = Callable[[Hostile, int, np.random.Generator], Floats | tuple[float, ...]]
"""The first numbers of the action of a control step, (x, y, z), turns about them and grip; the others are 0."""


def _bang_bang(policy: Hostile, step: int, rng: np.random.Generator) -> Floats:
    """Return full scale in every number, in another direction every ``BANG_STEPS``."""
    if step % BANG_STEPS == 0:
        policy.held = rng.choice([-1.0, 1.0], policy.size)
    return policy.held


class _Spoilt(StatefulPolicy):
    """A scripted expert whose actions are spoilt on their way: ``stale``, ``flipped``, or downwards once it turns."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, how: str) -> None:
        self._policy: Policy = make_policy("scripted", env, seed=seed)
        self._space: Any = env.action_space
        self._how = how

    def begin(self, observation: Any) -> tuple[int, Any, tuple[NDArray[np.float32], ...]]:
        return 0, None, ()

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        step, inner, late = state
        action, inner = self._policy.predict(
            observation, inner, np.array([step == 0]), deterministic
        )
        action = np.array(action, np.float32)
        late = (*late, action.copy())[-LATE_STEPS - 1 :]
        if self._how == "stale":
            action = late[0]
        elif self._how == "flipped":
            action[:-1] = -action[:-1]
        elif step >= TURNS_AT:
            action[:] = 0.0
            action[2] = self._space.low[2]
        return action, (step + 1, inner, late)


RULES: dict[str, Rule] = {
    "down": lambda policy, t, rng: (0.0, 0.0, -1.0),
    "aside and down": lambda policy, t, rng: (0.0, policy.seed % 2 * 2.0 - 1.0, -1.0),
    "forward": lambda policy, t, rng: (1.0, 0.0, -0.3),
    "bang-bang": _bang_bang,
    "uniform": lambda policy, t, rng: rng.uniform(-1.0, 1.0, policy.size),
    "ramp": lambda policy, t, rng: (0.0, 0.0, -min(1.0, t / 100)),
    "hammering": lambda policy, t, rng: (0.0, 0.0, -1.0 if t % 20 < 12 else 1.0),
    "grinding": lambda policy, t, rng: (np.cos(t / 5), np.sin(t / 5), -0.5),
    "squeezing": lambda policy, t, rng: (
        0.0,
        0.0,
        -1.0 * (t < 60),
        0.0,
        0.0,
        0.0,
        -1.0 if t < 60 else 1.0,
    ),
    "flinging": lambda policy, t, rng: (
        0.0,
        1.0 if t % 12 < 6 else -1.0,
        0.0,
        0.0,
        0.0,
        0.0,
        (-1.0) ** (t // 6),
    ),
    "to joint limits": lambda policy, t, rng: (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    "into itself": lambda policy, t, rng: (-1.0, 0.0, -0.3),
    "turning": lambda policy, t, rng: (0.0, 0.0, 0.0, 1.0, 1.0, 0.0),
    "rolling": lambda policy, t, rng: (0.0, 0.0, 0.0, -1.0, 0.0, 0.0),
    # a trial comes after 10
    "waits for the hand-back": lambda policy, t, rng: (
        0.0,
        0.0,
        -1.0 * (t % 36 < 24),
    ),
    "first rows": lambda policy, t, rng: (
        1.0 * (t < 12),
        0.0,
        -1.0 * (t < 12),
        0.0,
        1.0 * (t < 12),
        0.0,
    ),
}
HOSTILE: dict[str, Callable[[gym.Env[Any, Any], int, float], Policy]] = {
    **{name: partial(Hostile, rule=rule) for name, rule in RULES.items()},
    "turns hostile": lambda env, seed, speed: _Spoilt(env, seed, "turns"),
    "stale actions": lambda env, seed, speed: _Spoilt(env, seed, "stale"),
    "flipped actions": lambda env, seed, speed: _Spoilt(env, seed, "flipped"),
}
"""Hostile policies by name: made for an environment, with a seed and a share of the full speed."""
