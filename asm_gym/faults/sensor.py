"""Faults of the sensors: what is measured changes, what happens does not. Stream and observation alike see them.

The arm's own controller is closer to the motors than the sensors' bus and is not affected.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import LONGEST, Apply, Fault, Interface, check_joint, joint_labels, listed, within

Row = NDArray[Any]
Act = Callable[[Row, float, int], None]


@dataclass(frozen=True, kw_only=True)
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
        """Where its numbers stand in a measured row."""
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

    @abstractmethod
    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        """What the fault does to a measured row, in place: a function of (row, intensity, k), with k readings since the
        onset; ``last`` is the row before it."""

    @contextmanager
    def applied(self, env: Interface) -> Iterator[Apply]:
        where, intensity, k = self.where(env), 0.0, -1
        act = self.act(env.measured, where)

        def edit(row: Row) -> None:
            act(row, intensity, k)

        def apply(share: float) -> None:
            nonlocal intensity, k
            intensity, k = share, k + 1

        with listed(env.corruptions, edit):
            yield apply


@dataclass(frozen=True, kw_only=True)
class Bias(SensorFault):
    """A constant error.

    Args:
        amount: [unit of the channel].
    """

    amount: float = within(0.05, low=-1e6, high=1e6)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            row[where] += intensity * self.amount

        return change


@dataclass(frozen=True, kw_only=True)
class Drift(SensorFault):
    """An error that grows from the onset on.

    Args:
        rate: [unit of the channel per control step].
    """

    rate: float = within(0.002, low=-1e6, high=1e6)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            row[where] += intensity * self.rate * (k + 1)

        return change


@dataclass(frozen=True, kw_only=True)
class Scale(SensorFault):
    """A gain that is wrong.

    Args:
        factor: what the reading is multiplied by.
    """

    factor: float = within(1.2, low=0, high=1e3)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            row[where] *= 1.0 + intensity * (self.factor - 1.0)

        return change


@dataclass(frozen=True, kw_only=True)
class Noise(SensorFault):
    """More noise than there should be.

    Args:
        std: standard deviation of what is added [unit of the channel].
    """

    std: float = within(0.02, low=0, high=1e6)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            row[where] += intensity * self.std * self.rng(2 + k).standard_normal(len(where))

        return change


@dataclass(frozen=True, kw_only=True)
class Spikes(SensorFault):
    """Single readings that are far off.

    Args:
        amount: how far, either way [unit of the channel].
        probability: of each reading.
    """

    amount: float = within(0.5, low=-1e6, high=1e6)
    probability: float = within(0.2, low=0, high=1)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            rng = self.rng(2 + k)
            hit = rng.random(len(where)) < self.probability
            row[where] += intensity * self.amount * hit * rng.choice([-1.0, 1.0], len(where))

        return change


@dataclass(frozen=True, kw_only=True)
class Dropout(SensorFault):
    """Readings that are lost, and come as 0.

    Args:
        probability: of each reading.
    """

    graded = False

    probability: float = within(0.3, low=0, high=1)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def change(row: Row, intensity: float, k: int) -> None:
            if self.rng(2 + k).random() < self.probability:
                row[where] = 0.0

        return change


@dataclass(frozen=True, kw_only=True)
class Freeze(SensorFault):
    """The reading stays what it was, to the last digit."""

    graded = False

    def holds(self, env: Interface) -> frozenset[str]:
        return self.labels(env)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        def freeze(row: Row, _: float, __: int) -> None:
            row[where] = last[where]

        return freeze


@dataclass(frozen=True, kw_only=True)
class Delay(SensorFault):
    """Readings that come late.

    Args:
        steps: by how many control steps.
    """

    graded = False

    steps: int = within(3, low=1, high=LONGEST)

    def act(self, last: Row, where: NDArray[np.intp]) -> Act:
        # What was sensed before the onset is on its way already, and arrives first.
        queue = deque([last[where].copy()] * self.steps)

        def late(row: Row, _: float, __: int) -> None:
            queue.append(row[where].copy())
            row[where] = queue.popleft()

        return late


@dataclass(frozen=True, kw_only=True)
class FrozenEncoder(Fault):
    """A joint's encoder keeps saying what it said last: the same position, to the last digit, and no velocity.

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

        def freeze(row: Row) -> None:
            row[position], row[velocity] = stuck_at, 0.0

        with listed(env.corruptions, freeze):
            yield lambda _: None

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return joint_labels(env, self.joint, "joint_position", "joint_velocity")

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        return self.labels(env)


def corrupts_senses(fault: Fault) -> bool:
    """Whether it changes what is measured, and nothing that happens."""
    return isinstance(fault, SensorFault | FrozenEncoder)
