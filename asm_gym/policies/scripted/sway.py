"""Policies for environments that are not robosuite's: smooth motion that is alike from episode to episode."""

from __future__ import annotations

from typing import Any, TypeGuard

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.control_period import control_period
from asm_gym.policies.policy import StatefulPolicy

Floats = NDArray[np.float64]


class Swaying(StatefulPolicy):
    """Sways smoothly in a finite Box of actions: each number a sine of its own, and coloured noise.

    Raises:
        ValueError: the actions are in no finite Box.
    """

    # Shares of half the range of an action.
    WIDTH = 0.4
    NOISE = 0.05
    COLOUR = 0.7  # how much of the noise stays from step to step

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None) -> None:
        space = env.action_space
        if not _is_finite_box(space):
            raise ValueError(f"the policy 'sway' needs actions in a finite Box, got {space}")
        self.low: NDArray[Any] = space.low
        self.high: NDArray[Any] = space.high
        self.dt = control_period(env)
        middle = 0.5 * (self.high + self.low)
        half = 0.5 * (self.high - self.low)
        self.middle = np.ravel(middle).astype(np.float64)
        self.half = np.ravel(half).astype(np.float64)
        self.size = self.half.size
        self.set_random_seed(seed or 0)

    def set_random_seed(self, seed: int) -> None:
        """Begin an episode of this seed."""
        self.rng = np.random.default_rng([seed, 3])
        self.t = 0.0  # [s]
        self.noise = np.zeros(self.size)
        self.draw()

    def draw(self) -> None:
        """Draw what an episode keeps."""
        self.phase = self.rng.normal(0.0, 0.3, self.size) + np.arange(self.size)
        self.width = self.WIDTH * self.rng.uniform(0.8, 1.2, self.size)
        self.frequency = 0.5 + 0.3 * np.linspace(0.0, 1.0, self.size)  # [Hz]

    def sines(self, t: float, phase: Floats | float = 0.0) -> Floats:
        """Return the sine (A,) of each number of the action at a time [s]."""
        angle = 2 * np.pi * self.frequency * t + phase
        return np.sin(angle)

    def intended(self, observation: Any) -> Floats:
        """Return the action (A,) before noise."""
        return self.middle + self.half * self.width * self.sines(self.t, self.phase)

    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action and the state as it was."""
        fresh = self.NOISE * self.half * self.rng.standard_normal(self.size)
        self.noise = self.COLOUR * self.noise + fresh
        action = self.intended(observation) + self.noise
        self.t += self.dt
        within = np.clip(action.reshape(self.low.shape), self.low, self.high)
        return within.astype(np.float32), state


def _is_finite_box(space: gym.Space[Any]) -> TypeGuard[gym.spaces.Box]:
    """Return whether a space is a Box without infinite bounds."""
    if not isinstance(space, gym.spaces.Box):
        return False
    return bool(np.isfinite(space.low).all() and np.isfinite(space.high).all())


class SyntheticArmExpert(Swaying):
    """The synthetic arm goes through four poses, a second each, and sways a little on the way."""

    NOISE = 0.0
    GAIN = 4.0  # of the position error [1/s]

    def draw(self) -> None:
        turns = self.rng.uniform(-0.6, 0.6, (4, self.size))
        start = np.zeros(self.size)
        self.poses = 0.7 * np.cumsum(np.vstack([start, turns]), axis=0)  # (5, 7) [rad]
        self.width = self.rng.uniform(0.02, 0.08, self.size)  # [rad]
        self.frequency = np.linspace(0.5, 1.5, self.size)  # [Hz]

    def intended(self, observation: Any) -> Floats:
        now = self.reference(self.t)
        soon = self.reference(self.t + self.dt)
        error = now - observation[: self.size]
        return (soon - now) / self.dt + self.GAIN * error

    def reference(self, t: float) -> Floats:
        """Return positions (7,) along minimum-jerk moves [rad]."""
        move = min(int(t), len(self.poses) - 2)
        s = min(t - move, 1.0)
        share = 10 * s**3 - 15 * s**4 + 6 * s**5
        start = self.poses[move]
        way = self.poses[move + 1] - start
        return start + share * way + self.width * self.sines(t)
