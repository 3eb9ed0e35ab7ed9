"""What the engine knows of the robots that it guards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeaning
from asm_gym.detection.kinematics import Chain
from asm_gym.spec import Channel, StreamSpec

NO_COLUMNS = np.zeros(0, np.intp)

SMALLEST = 1e-6  # of a number of an action that can be slowed

NOTHING: Mapping[int, Any] = MappingProxyType({})  # where there is nothing to say of any robot


def named(channels: Sequence[Channel], ending: str, size: int | None = None) -> NDArray[np.intp]:
    """Return (N,) the columns of channels whose names end so, of all arms; of a ``size`` alone where one is given."""
    return np.flatnonzero([c.name.endswith(ending) and size in (None, c.size) for c in channels for _ in range(c.size)])


@dataclass(frozen=True, eq=False)
class Robots:
    """n robots of one kind, as far as a guard asks."""

    count: int  # n
    low: NDArray[np.float32]  # (A,) bounds of the actions
    high: NDArray[np.float32]
    rest: NDArray[np.float32]  # (A,) the action for which a robot stays, or what comes nearest to it
    rests: bool = True  # ``rest``, or ``meaning``, is known to make a robot stay
    meaning: ActionMeaning | None = None  # of the actions, where no one action makes a robot stay everywhere
    brakes: bool = False  # the robots stay by themselves where they are told to, whatever the action is
    grip: NDArray[np.intp] = field(default_factory=lambda: NO_COLUMNS)  # (G,) places in the action of grippers
    dt: float = 1.0  # control period [s]
    task: str = ""  # its name; empty where unknown
    chains: tuple[tuple[Chain, ...], ...] = ()  # of each arm, its kinematics in each of the n robots
    felt_channels: tuple[Channel, ...] = ()  # what the arms feel in physics substeps; empty where nothing
    limits_contact: bool = False  # they compare what they feel with contact limits in every physics substep
    read: NDArray[np.bool_] | None = None  # (D,) the columns of the stream that are observed; None: not known
    turn: Callable[[int, NDArray[np.floating[Any]]], NDArray[np.float32]] | None = None
    """The action (A,) that turns the joints of robot i by so much (J,) [rad]; None where there is none."""
    efference: NDArray[np.intp] | None = None
    """(A,) columns of the stream that say what was executed, where robots slow down what they are told; else None."""
    refused: Mapping[str, str] = field(default_factory=dict)  # why they cannot do a reflex, by its name

    @cached_property
    def felt_size(self) -> int:
        """F, how many numbers the arms feel in physics substeps."""
        return sum(c.size for c in self.felt_channels)

    def executed_in(self, rows: NDArray[np.float32], commanded: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actions (n, A) that were executed in place of what was ``commanded``, by the rows (n, D) after."""
        if self.efference is None:
            return commanded
        told = rows[:, self.efference]
        return np.where(np.isfinite(told), told, commanded)

    def slowed(self, commanded: NDArray[np.float32], executed: NDArray[np.float32]) -> float:
        """Return the greatest share of a number of the action (A,) that was taken from it; NaN where nobody knows."""
        if self.limits_contact and self.efference is None:  # a wrapper inside changes actions
            return np.nan
        asked, done = commanded.ravel(), executed.ravel()
        moved = np.abs(asked) > SMALLEST
        taken = 1.0 - done[moved] / asked[moved]
        return float(np.clip(np.nan_to_num(taken).max(initial=0.0), 0.0, 1.0))

    @classmethod
    def unknown(cls, spec: StreamSpec, read: NDArray[np.bool_] | None = None) -> Self:
        """Return one robot of which nothing is known but its stream."""
        size = len(spec.motor)
        unbounded = np.full(size, np.inf, np.float32)
        return cls(1, -unbounded, unbounded, np.zeros(size, np.float32), dt=spec.dt, read=read)
