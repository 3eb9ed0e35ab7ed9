"""Faults of the sensors: what is measured changes, what happens does not. Stream and observation alike see them.

The arm's own controller is closer to the motors than the sensors' bus and is not affected.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import (
    LONGEST,
    Apply,
    Fault,
    Floats,
    Interface,
    check_joint,
    joint_labels,
    listed,
    within,
)


class SensorFault(Fault):
    """One that acts on numbers of one channel.

    Args:
        channel: a channel that is measured, such as ``joint_position`` or ``wrist_force``; in environments that are not
            robosuite's ``observation``, or a key of it, as ``StreamSpec.from_spaces`` names them.
        element: which of its numbers; all where None.
    """

    anywhere = True

    channel: str = "joint_position"
    element: int | None = 3

    def check(self, env: Interface) -> None:
        self.where(env)

    def where(self, env: Interface) -> NDArray[np.intp]:
        """Return the indices of the channel's numbers in a measured row."""
        slices = env.measured_spec.slices
        if self.channel not in slices:
            raise ValueError(f"unknown channel {self.channel!r}; known: {', '.join(slices)}")
        span = np.arange(slices[self.channel].start, slices[self.channel].stop)
        if self.element is None:
            return span
        if not 0 <= self.element < len(span):
            raise ValueError(f"element of {self.channel} must be 0 to {len(span) - 1}, got {self.element}")
        return span[[self.element]]

    def labels(self, env: Interface) -> frozenset[str]:
        return frozenset(env.measured_spec.labels[i] for i in self.where(env))

    def begin(self, last: Floats) -> Any:
        """Return the fault's memory for one injection, from the readings (n,) before the onset."""
        return last

    @abstractmethod
    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Any:
        """Return what is read instead of the ``true`` readings (n,), at the k-th control step since the onset."""

    @contextmanager
    def applied(self, env: Interface) -> Iterator[Apply]:
        where, intensity, k = self.where(env), 0.0, -1
        memory = self.begin(env.measured[where])

        def edit(row: Floats) -> None:
            row[where] = self.read(row[where], intensity, k, memory)

        def apply(share: float) -> None:
            nonlocal intensity, k
            intensity, k = share, k + 1

        with listed(env.corruptions, edit):
            yield apply


class Bias(SensorFault):
    """Add a constant ``amount`` [unit of the channel]."""

    amount: float = within(0.05, low=-1e6, high=1e6)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Floats:
        return true + intensity * self.amount


class Drift(SensorFault):
    """Add an error that grows by ``rate`` [unit of the channel per control step] from the onset on."""

    rate: float = within(0.002, low=-1e6, high=1e6)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Floats:
        return true + intensity * self.rate * (k + 1)


class Scale(SensorFault):
    """Multiply the reading by ``factor``."""

    factor: float = within(1.2, low=0, high=1e3)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Floats:
        return true * (1.0 + intensity * (self.factor - 1.0))


class Noise(SensorFault):
    """Add noise of standard deviation ``std`` [unit of the channel]."""

    std: float = within(0.02, low=0, high=1e6)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Floats:
        return true + intensity * self.std * self.rng(2 + k).standard_normal(len(true))


class Spikes(SensorFault):
    """Put single readings off by ``amount`` [unit of the channel] either way, each with ``probability``."""

    amount: float = within(0.5, low=-1e6, high=1e6)
    probability: float = within(0.2, low=0, high=1)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Floats:
        rng = self.rng(2 + k)
        hit = rng.random(len(true)) < self.probability
        off: Floats = intensity * self.amount * hit * rng.choice([-1.0, 1.0], len(true))
        return true + off


class Dropout(SensorFault):
    """Lose readings, each with ``probability``: they read 0."""

    graded = False

    probability: float = within(0.3, low=0, high=1)

    def read(self, true: Floats, intensity: float, k: int, memory: Any) -> Any:
        return 0.0 if self.rng(2 + k).random() < self.probability else true


class Freeze(SensorFault):
    """Keep the last reading, to the last digit."""

    graded = False

    def holds(self, env: Interface) -> frozenset[str]:
        return self.labels(env)

    def read(self, true: Floats, intensity: float, k: int, memory: Floats) -> Floats:
        return memory


class Delay(SensorFault):
    """Deliver readings ``steps`` control steps late."""

    graded = False

    steps: int = within(3, low=1, high=LONGEST)

    def begin(self, last: Floats) -> deque[Floats]:
        # What was sensed before the onset is on its way already, and arrives first.
        return deque([last] * self.steps)

    def read(self, true: Floats, intensity: float, k: int, memory: deque[Floats]) -> Floats:
        memory.append(true)
        return memory.popleft()


class FrozenEncoder(Fault):
    """Keep a joint's position at its last reading, to the last digit, and its velocity at 0.

    Args:
        joint: counted from the base, 0 first; a second arm's go on after the first one's.
    """

    graded = False

    joint: int = 3

    def check(self, env: RobosuiteEnv) -> None:
        check_joint(env, self.joint)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        labels = list(env.measured_spec.labels)
        position, velocity = (
            labels.index(next(iter(joint_labels(env, self.joint, name))))
            for name in ("joint_position", "joint_velocity")
        )
        stuck_at = env.measured[position]

        def freeze(row: Floats) -> None:
            row[position], row[velocity] = stuck_at, 0.0

        with listed(env.corruptions, freeze):
            yield lambda _: None

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return joint_labels(env, self.joint, "joint_position", "joint_velocity")

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return self.labels(env)


class NoisySensors(Fault):
    """Multiply the standard deviation of every sensor's noise by ``factor``."""

    harmless = True

    factor: float = within(2.0, low=1, high=1e3)

    def check(self, env: RobosuiteEnv) -> None:
        """Every environment has sensors."""

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset()

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        share, k = 0.0, -1
        usual = env.measured_spec.noise * env.sensor_noise

        def add(row: Floats) -> None:
            extra = np.sqrt((1.0 + share * (self.factor - 1.0)) ** 2 - 1.0)
            row += extra * usual * self.rng(2 + k).standard_normal(len(row))

        def apply(intensity: float) -> None:
            nonlocal share, k
            share, k = intensity, k + 1

        with listed(env.corruptions, add):
            yield apply


def corrupts_senses(fault: Fault) -> bool:
    """Whether a fault changes what is measured, and nothing that happens."""
    return isinstance(fault, SensorFault | FrozenEncoder)
