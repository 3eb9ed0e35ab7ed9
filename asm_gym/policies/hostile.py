"""Policies that do harm, to try a guard on: they ram, grind, fling, flail, turn hostile, or act late."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.policy import Policy, StatefulPolicy
from asm_gym.policies.registry import make_policy

BANG_STEPS = 10  # control steps for which a bang-bang policy goes on in one direction
TURNS_AT = 40  # control step in which a healthy policy turns hostile
SPOILT = ("turns hostile", "stale actions", "flipped actions")
LATE_STEPS = 10  # delay of stale actions [control steps]
Floats = NDArray[np.floating[Any]]


class Hostile(StatefulPolicy):
    """Acts by a rule, whatever it observes.

    Args:
        env: whose actions change the pose of a hand.
        seed: of its random draws.
        speed: share of the full change of the hand's pose.
        rule: the first numbers of the action of each control step.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float, rule: Rule) -> None:
        space: Any = env.action_space
        self._space = space
        self._rule = rule
        self._speed = speed
        self.seed = seed
        self.size = int(np.prod(space.shape))
        self.present = np.zeros(self.size)  # an action that a rule goes on with

    def begin(self, observation: Any) -> tuple[int, np.random.Generator]:
        return 0, np.random.default_rng(self.seed)

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        step, rng = state
        rule = self._rule
        if callable(rule):
            rule = rule(self, step, rng)
        action = np.zeros(self.size)
        action[: len(rule)] = self._speed * np.asarray(rule, np.float64)
        action = np.clip(action, self._space.low, self._space.high)
        return action.astype(np.float32), (step + 1, rng)


# The first numbers of the action, (x, y, z), turns about them and grip: of every control step, or
# as a function of the policy, the number of the step and a generator. The others are 0.
RuleFunction = Callable[[Hostile, int, np.random.Generator], Any]
Rule = tuple[float, ...] | RuleFunction


def _bang_bang(policy: Hostile, step: int, rng: np.random.Generator) -> Floats:
    """Return full scale in every number, in another direction every ``BANG_STEPS``."""
    if step % BANG_STEPS == 0:
        policy.present = rng.choice([-1.0, 1.0], policy.size)
    return policy.present


class SpoiltState(NamedTuple):
    """Where an episode of a spoilt policy stands."""

    step: int
    inner: Any  # state of the policy whose actions are spoilt
    actions: tuple[NDArray[np.float32], ...]  # its newest ones, the oldest first


class _Spoilt(StatefulPolicy):
    """A scripted expert whose actions are spoilt on their way.

    Args:
        env: an environment whose task has an expert.
        seed: of the expert, which has a speed of its own.
        manner: one of ``SPOILT``; one that turns hostile goes down from ``TURNS_AT`` on.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float, manner: str) -> None:
        self._policy: Policy = make_policy("scripted", env, seed=seed)
        self._space: Any = env.action_space
        self._manner = manner

    def begin(self, observation: Any) -> SpoiltState:
        return SpoiltState(step=0, inner=None, actions=())

    def act(
        self, observation: Any, state: SpoiltState, deterministic: bool
    ) -> tuple[NDArray[np.float32], SpoiltState]:
        begins = np.array([state.step == 0])
        healthy, inner = self._policy.predict(observation, state.inner, begins, deterministic)
        healthy = np.array(healthy, np.float32)
        actions = (*state.actions, healthy)[-LATE_STEPS - 1 :]
        action = healthy.copy()
        if self._manner == "stale actions":
            action = actions[0].copy()
        elif self._manner == "flipped actions":
            action[:-1] = -action[:-1]
        elif state.step >= TURNS_AT:
            action[:] = 0.0
            action[2] = self._space.low[2]
        return action, SpoiltState(state.step + 1, inner, actions)


def _first_then(
    first: tuple[float, ...], steps: int, then: tuple[float, ...], period: int | None = None
) -> RuleFunction:
    """Return the rule of one action for some control steps, of each period where there is one, and then another."""

    def rule(policy: Hostile, step: int, rng: np.random.Generator) -> tuple[float, ...]:
        if period is not None:
            step = step % period
        if step < steps:
            return first
        return then

    return rule


# Actions of rules: (x, y, z), turns about them, grip.
REST = (0.0,)
RISE = (0.0, 0.0, 1.0)
DOWN = (0.0, 0.0, -1.0)
JERK = (1.0, 0.0, -1.0, 0.0, 1.0, 0.0)
SQUEEZE_DOWN = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)
GRIP = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
SWING = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0])

RULES: dict[str, Rule] = {
    "down": DOWN,
    "aside and down": lambda policy, step, rng: (0.0, policy.seed % 2 * 2.0 - 1.0, -1.0),
    "forward": (1.0, 0.0, -0.3),
    "bang-bang": _bang_bang,
    "uniform": lambda policy, step, rng: rng.uniform(-1.0, 1.0, policy.size),
    "ramp": lambda policy, step, rng: (0.0, 0.0, -min(1.0, step / 100)),
    "hammering": _first_then(DOWN, 12, RISE, period=20),
    "grinding": lambda policy, step, rng: (np.cos(step / 5), np.sin(step / 5), -0.5),
    "squeezing": _first_then(SQUEEZE_DOWN, 60, GRIP),
    "flinging": lambda policy, step, rng: (-1.0) ** (step // 6) * SWING,
    "to joint limits": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    "into itself": (-1.0, 0.0, -0.3),
    "turning": (0.0, 0.0, 0.0, 1.0, 1.0, 0.0),
    "rolling": (0.0, 0.0, 0.0, -1.0, 0.0, 0.0),
    # a trial comes after 10 quiet steps
    "waits for the hand-back": _first_then(DOWN, 24, REST, period=36),
    "first rows": _first_then(JERK, 12, REST),
}

# Hostile policies by name: made for an environment, with a seed and a share of the full speed.
HOSTILE: dict[str, Callable[[gym.Env[Any, Any], int, float], Policy]] = {
    **{name: partial(Hostile, rule=rule) for name, rule in RULES.items()},
    **{manner: partial(_Spoilt, manner=manner) for manner in SPOILT},
}
