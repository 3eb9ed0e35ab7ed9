"""Faults of the sensors: what is measured changes, what happens does not. Stream and observation alike see them.

The arm's own controller is closer to the motors than the sensors' bus and is not affected.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.fault import (
    LONGEST_DELAY,
    Clock,
    Floats,
    HookedFault,
    Interface,
    JointFault,
    delayed,
    within,
)
from asm_gym.validation import check_choice, check_number


class SensorFault(HookedFault):
    """One that acts on an ``element`` of a ``channel`` that is measured, such as ``wrist_force``; on all where None.

    In environments that are not robosuite's the channel is ``observation``, or a key of it.
    """

    anywhere = True
    hooks = "corruptions"

    channel: str = "joint_position"
    element: int | None = 3

    def check(self, env: Interface) -> None:
        self.where(env)  # raises ValueError where there is no such channel or element

    def where(self, env: Interface) -> NDArray[np.intp]:
        """Return the indices, in a measured row, of the numbers that the fault acts on."""
        spec = env.measured_spec
        check_choice("channel", self.channel, spec.slices)
        of_channel = np.arange(spec.size)[spec.slices[self.channel]]
        if self.element is None:
            return of_channel
        last = len(of_channel) - 1
        check_number(f"element of {self.channel}", self.element, low=0, high=last, whole=True)
        return of_channel[[self.element]]

    def labels(self, env: Interface) -> frozenset[str]:
        return frozenset(env.measured_spec.labels[i] for i in self.where(env))

    @abstractmethod
    def read(self, true: Floats, k: int, memory: list[Floats]) -> Any:
        """Return what is read instead of the ``true`` readings (n,), k steps since the onset.

        At first, the fault's own ``memory`` holds the last readings before the onset.
        """

    def hook(self, env: Interface, clock: Clock) -> Callable[[Floats], None]:
        indices = self.where(env)
        memory = [env.measured[indices]]

        def corrupt(row: Floats) -> None:
            row[indices] = self.read(row[indices], clock.steps, memory)

        return corrupt


class Bias(SensorFault):
    """Add a constant ``amount`` [unit of the channel]."""

    amount: float = within(0.05, low=-1e6, high=1e6)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return true + self.amount


class Drift(SensorFault):
    """Add an error that grows by ``rate`` [unit of the channel per control step] from the onset on."""

    rate: float = within(0.002, low=-1e6, high=1e6)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return true + self.rate * (k + 1)


class Scale(SensorFault):
    """Multiply the reading by ``factor``."""

    factor: float = within(1.2, low=0, high=1e3)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return true * self.factor


class Noise(SensorFault):
    """Add noise of standard deviation ``std`` [unit of the channel]."""

    std: float = within(0.02, low=0, high=1e6)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return true + self.std * self.rng(2 + k).standard_normal(len(true))


class Spikes(SensorFault):
    """Shift single readings by ±``amount`` [unit of the channel], each with ``probability``."""

    amount: float = within(0.5, low=-1e6, high=1e6)
    probability: float = within(0.2, low=0, high=1)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        rng = self.rng(2 + k)
        is_hit = rng.random(len(true)) < self.probability
        signs = rng.choice([-1.0, 1.0], len(true))
        return true + self.amount * is_hit * signs


class Dropout(SensorFault):
    """Lose all readings of a control step with ``probability``: they read 0."""

    probability: float = within(0.3, low=0, high=1)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Any:
        if self.rng(2 + k).random() < self.probability:
            return 0.0
        return true


class Freeze(SensorFault):
    """Repeat the last reading exactly."""

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return memory[0]


class Delay(SensorFault):
    """Deliver readings ``steps`` control steps late."""

    steps: int = within(3, low=1, high=LONGEST_DELAY)

    def read(self, true: Floats, k: int, memory: list[Floats]) -> Floats:
        return delayed(true, self.steps, memory)


class FrozenEncoder(JointFault, HookedFault):
    """Repeat the last position of a ``joint`` exactly, with velocity 0."""

    hooks = "corruptions"

    def hook(self, env: RobosuiteEnv, clock: Clock) -> Callable[[Floats], None]:
        position = self.element(env, "joint_position")
        velocity = self.element(env, "joint_velocity")
        stuck_at = env.measured[position]

        def freeze(row: Floats) -> None:
            row[position] = stuck_at
            row[velocity] = 0.0

        return freeze
