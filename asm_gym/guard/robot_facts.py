"""What a guard knows of the robots: bounds, rest, grip, kinematic chains, and what they feel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeaning
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.kinematics import Chain
from asm_gym.spec import Channel, StreamSpec

NO_COLUMNS = np.zeros(0, np.intp)

SMALLEST = 1e-6  # of a number of an action that can be slowed

NOTHING: Mapping[int, Any] = MappingProxyType({})  # where there is nothing to say of any robot

# Returns the action (A,) that turns the joints of a robot, by its index, by angles (J,) [rad].
TurningAction = Callable[[int, NDArray[np.floating[Any]]], NDArray[np.float32]]


def columns_ending(
    channels: Sequence[Channel],
    ending: str,
    size: int | None = None,
) -> NDArray[np.intp]:
    """Return the columns of channels whose names have an ending, of all arms.

    Args:
        channels: in the order of their columns.
        ending: of their names, such as ``"external_torque"``.
        size: how many columns a channel must have; any number by default.

    Returns:
        (N,) columns.
    """
    matches = [c.name.endswith(ending) and size in (None, c.size) for c in channels]
    sizes = [channel.size for channel in channels]
    return np.flatnonzero(np.repeat(matches, np.array(sizes, np.intp)))


@dataclass(frozen=True, eq=False)
class RobotFacts:
    """What a guard knows of n robots of one kind."""

    count: int  # n, how many there are
    low: NDArray[np.float32]  # (A,) least action
    high: NDArray[np.float32]  # (A,) greatest action
    rest: NDArray[np.float32]  # (A,) for which a robot stays, or what comes nearest to it
    meaning: ActionMeaning | None = None  # None where ``rest`` makes a robot stay everywhere
    brakes: bool = False  # a robot can stay by itself, whatever the action is
    grip: NDArray[np.intp] = field(default_factory=lambda: NO_COLUMNS)  # (G,) of the action
    dt: float = 1.0  # control period [s]
    task: str = ""  # name of the task; empty where unknown
    chains: tuple[tuple[Chain, ...], ...] = ()  # kinematics of each arm, in each of n robots
    felt_channels: tuple[Channel, ...] = ()  # felt in physics substeps; empty where nothing is
    contact_limits: ContactLimits = field(default_factory=ContactLimits)  # of these arms
    limits_contact: bool = False  # each substep compares what is felt with contact limits
    observed: NDArray[np.bool_] | None = None  # (D,) columns in the observation; None: unknown
    turning_action: TurningAction | None = None  # None where no action turns the joints
    efference: NDArray[np.intp] | None = None  # (A,) columns of the executed action, if slowed
    refused: Mapping[str, str] = field(default_factory=dict)  # why, by the name of a reflex

    @property
    def rest_is_known(self) -> bool:
        """Whether ``rest``, or ``meaning``, is known to make a robot stay."""
        return "hold" not in self.refused

    @cached_property
    def felt_size(self) -> int:
        """F, how many numbers the arms feel in physics substeps."""
        return sum(channel.size for channel in self.felt_channels)

    def executed_in(
        self,
        rows: NDArray[np.float32],
        commanded: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the actions that were executed.

        Args:
            rows: (n, D) of the stream, after the actions.
            commanded: (n, A) the actions where the rows do not tell them.

        Returns:
            (n, A) actions.
        """
        if self.efference is None:
            return commanded
        executed = rows[:, self.efference]
        return np.where(np.isfinite(executed), executed, commanded)

    def slowed(
        self, commanded: NDArray[np.float32], executed: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return (n,) the greatest share that was taken from a number of an action; NaN where unknown.

        Args:
            commanded: (n, A) the actions that were commanded.
            executed: (n, A) the actions that were executed.
        """
        if self.limits_contact and self.efference is None:  # a wrapper inside changes actions
            return np.full(len(commanded), np.nan)
        moved = np.abs(commanded) > SMALLEST
        left = np.ones(commanded.shape)  # share of each number
        np.divide(executed, commanded, out=left, where=moved)
        return np.nan_to_num(1.0 - left).clip(0.0, 1.0).max(axis=1, initial=0.0)

    @classmethod
    def unknown(cls, spec: StreamSpec, observed: NDArray[np.bool_] | None = None) -> Self:
        """Return one robot of which nothing is known but its stream."""
        high = np.full(len(spec.motor), np.inf, np.float32)
        rest = np.zeros_like(high)
        return cls(count=1, low=-high, high=high, rest=rest, dt=spec.dt, observed=observed)
