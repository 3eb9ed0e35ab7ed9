"""Policies that do harm, to try a guard on: they ram, flail, turn hostile, act late, or the wrong way round."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy
from asm_gym.policies.registry import make_policy

BANG_STEPS = 10
"""Control steps for which a bang-bang policy goes on in one direction."""

TURNS_AT = 40
"""Control step in which a healthy policy turns hostile."""

LATE_STEPS = 10
"""Delay of stale actions [control steps]."""

Floats = NDArray[np.floating[Any]]


class Hostile:
    """Acts by a rule, whatever it observes.

    Args:
        env: one whose actions are changes of the hand's pose, the grip last.
        choose: (A,) from the control step, the generator of the episode, and A.
        speed: share of the full action.
        seed: of the episode.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        choose: Callable[[int, np.random.Generator, int], Floats],
        speed: float,
        seed: int,
    ) -> None:
        self._space: Any = env.action_space
        self._choose, self._speed, self._seed = choose, speed, seed

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action (A,); the state is the step and the episode's generator."""
        step, rng = (0, np.random.default_rng(self._seed)) if state is None else state
        action = self._speed * np.asarray(self._choose(step, rng, self._space.shape[0]), np.float64)
        return np.clip(action, self._space.low, self._space.high).astype(np.float32), (step + 1, rng)


def _towards(x: float, y: float, z: float) -> Callable[[int, np.random.Generator, int], Floats]:
    return lambda step, rng, size: np.array([x, y, z, *[0.0] * (size - 3)])


class _BangBang:
    """Full scale in every number, in another direction every ``BANG_STEPS``."""

    def __init__(self) -> None:
        self._action = np.zeros(0)

    def __call__(self, step: int, rng: np.random.Generator, size: int) -> Floats:
        if step % BANG_STEPS == 0 or self._action.size != size:
            self._action = rng.choice([-1.0, 1.0], size)
        return self._action


class _Spoilt:
    """A scripted expert whose actions are spoilt on their way: ``stale``, ``flipped``, or downwards once it turns."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, how: str) -> None:
        self._policy: Policy = make_policy("scripted", env, seed=seed)
        self._space: Any = env.action_space
        self._how = how

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action (A,)."""
        step, inner, late = (0, None, ()) if state is None else state
        action, inner = self._policy.predict(observation, inner, np.array([step == 0]), deterministic)
        action = np.array(action, np.float32)
        late = deque((*late, action.copy()), maxlen=LATE_STEPS + 1)
        if self._how == "stale":
            action = late[0]
        elif self._how == "flipped":
            action[:-1] = -action[:-1]
        elif step >= TURNS_AT:
            action[:] = 0.0
            action[2] = self._space.low[2]
        return action, (step + 1, inner, late)


HOSTILE: dict[str, Callable[[gym.Env[Any, Any], int, float], Policy]] = {
    "down": lambda env, seed, speed: Hostile(env, _towards(0.0, 0.0, -1.0), speed, seed),
    "aside and down": lambda env, seed, speed: Hostile(
        env, _towards(0.0, 1.0 if seed % 2 else -1.0, -1.0), speed, seed
    ),
    "forward": lambda env, seed, speed: Hostile(env, _towards(1.0, 0.0, -0.3), speed, seed),
    "bang-bang": lambda env, seed, speed: Hostile(env, _BangBang(), speed, seed),
    "uniform": lambda env, seed, speed: Hostile(env, lambda t, rng, n: rng.uniform(-1.0, 1.0, n), speed, seed),
    "turns hostile": lambda env, seed, speed: _Spoilt(env, seed, "turns"),
    "stale actions": lambda env, seed, speed: _Spoilt(env, seed, "stale"),
    "flipped actions": lambda env, seed, speed: _Spoilt(env, seed, "flipped"),
}
"""Hostile policies by name: made for an environment, with a seed and a share of the full speed."""
