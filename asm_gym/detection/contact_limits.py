"""How hard an arm may press and how fast its hand may go before it stays, whatever the cause is taken for.

ISO/TS 15066:2016 (Annex A) lets a robot press a hand, the least tolerant part that it is likely to meet, with 140 N for
long and 280 N for a moment. Healthy motion of the tasks of this package reaches 10 to 71 N at the wrist on one axis and
8 to 34 N m in a joint; what is peculiar to a set-up is learned from its calibration episodes, and the larger of the two
counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asm_gym.spec import Channel, StreamSpec
from asm_gym.validation import check_flag, check_number, check_numbers

FELT = "external_torque", "wrist_force"
"""Ends of the names of the channels that limits are about."""

LEFT_OUT = 0.05
"""Share of healthy episodes, those that pressed hardest, left out of what healthy motion needs: one knock in twenty."""

MOST = 2.5
"""What was seen counts up to so many times the usual limits: 200 N, 100 N m."""

CELL, NEAR = 0.02, 0.04
"""Edge of the cubes in which speeds are learned, and distance within which a cube counts [m]."""

QUANTILE = 0.95
"""Of the speeds in a cube."""

MORE = 1.2
"""Faster by so many times than healthy episodes were is familiar still."""

UNKNOWN = 0.05
"""Speed where nothing is known [m/s]: the first blow on a stiff table stays below 100 N."""

PLACE, VELOCITY = "hand_position", "hand_velocity"
"""Channels that tell of one hand."""


@dataclass(frozen=True)
class ContactLimits:
    """What an arm may feel and how fast it may go.

    Args:
        wrist_force: on each axis of the wrist, the hand's own weight included [N].
        external_torque: of each joint [N m].
        hand_speed: a command that would move the hand faster is scaled down to it [m/s]; infinite for none. Of
            OSC_POSE and JOINT_POSITION, whose actions are changes of where the arm is; others are not scaled.
        by_place: the hand goes no faster than healthy episodes of this body and task did near where it is, and slowly
            where they never were; ``hand_speed`` is the most. That needs a monitor that was calibrated since.
        healthy: the most that healthy motion of this body and task was seen to reach, (N,) in the order of
            ``RobosuiteEnv.felt_channels``; where that is more, it counts. Empty where nobody knows.
        stays: the arm stays from the physics substep on after a limit was passed; else it is only said.

    Raises:
        ValueError: a limit that is none.
    """

    wrist_force: float = 80.0
    external_torque: float = 40.0
    hand_speed: float = 0.15
    by_place: bool = False
    healthy: tuple[float, ...] = ()
    stays: bool = True

    def __post_init__(self) -> None:
        for name in ("wrist_force", "external_torque", "hand_speed"):
            check_number(name, getattr(self, name), above=0, infinite=True)
        for value in self.healthy:
            check_number("healthy", value, low=0)
        check_flag("by_place", self.by_place)
        check_flag("stays", self.stays)

    def most(self, felt: Sequence[Channel]) -> NDArray[np.float64]:
        """Return (N,) the limit of each number that is felt. Raises ValueError where ``healthy`` is of another arm."""
        fixed = [self.wrist_force if c.name.endswith("wrist_force") else self.external_torque for c in felt]
        most = np.repeat(fixed, [c.size for c in felt]).astype(np.float64)
        if self.healthy and len(self.healthy) != len(most):
            raise ValueError(
                f"healthy must say {len(most)} numbers, one for each that is felt, got {len(self.healthy)}"
            )
        return np.maximum(most, self.healthy) if self.healthy else most

    def stricter(self, forces: float, speed: float) -> ContactLimits:
        """Return limits with a share of those on ``forces``, and at most ``speed`` [m/s]."""
        return replace(
            self,
            wrist_force=forces * self.wrist_force,
            external_torque=forces * self.external_torque,
            hand_speed=min(speed, self.hand_speed),
            healthy=tuple(forces * value for value in self.healthy),
        )

    @property
    def limits_speed(self) -> bool:
        """Whether there is a limit of speed."""
        return math.isfinite(self.hand_speed)


def healthy_forces(streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> tuple[float, ...]:
    """Return (N,) the most that healthy motion reached, of each number that an arm feels [N m], [N].

    Args:
        streams: (T, D) of healthy episodes; peaks within rows count where they are sensed.
        spec: of the streams; where it senses no such forces, nothing is returned.
    """
    felt = [c for c in spec.channels if c.name.endswith(FELT)]
    if not streams or not felt:
        return ()
    peaks = [spec.slices.get(f"{c.name}_peak", spec.slices[c.name]) for c in felt]
    columns = np.concatenate([np.arange(spec.size)[peak] for peak in peaks])
    reached = np.stack([np.nanmax(np.abs(stream[:, columns].astype(np.float64)), axis=0) for stream in streams])
    usual = ContactLimits().most(felt)
    shares = (reached / usual).max(axis=1)
    kept = shares <= np.quantile(shares, 1.0 - LEFT_OUT, method="higher" if len(shares) < 1.0 / LEFT_OUT else "lower")
    return tuple(np.minimum(reached[kept].max(axis=0), MOST * usual).tolist())


class FamiliarSpeed(NamedTuple):
    """How fast a hand has healthily gone at each place: the 95 % quantile in cubes of ``CELL``.

    Attributes:
        places: (n, 3) middles of cubes [m].
        speeds: (n,) [m/s].
    """

    places: NDArray[np.float64]
    speeds: NDArray[np.float64]

    @classmethod
    def learned(cls, streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> Self | None:
        """Learn it from healthy episodes (T, D); None where their stream tells of no hand, or of two."""
        if not streams or PLACE not in spec.slices or VELOCITY not in spec.slices:
            return None
        rows = np.concatenate([np.asarray(stream, np.float64) for stream in streams])
        cells = np.floor(rows[:, spec.slices[PLACE]] / CELL).astype(np.int64)
        speeds = np.linalg.norm(rows[:, spec.slices[VELOCITY]], axis=1)
        finite = np.isfinite(speeds) & np.isfinite(rows[:, spec.slices[PLACE]]).all(axis=1)
        known, which = np.unique(cells[finite], axis=0, return_inverse=True)
        usual = [np.quantile(speeds[finite][which.ravel() == n], QUANTILE) for n in range(len(known))]
        return cls((known + 0.5) * CELL, np.array(usual))

    @classmethod
    def restored(cls, rows: ArrayLike) -> Self | None:
        """Return what ``rows`` says; None of nothing. Raises ValueError where it is something else."""
        if not np.size(rows):
            return None
        saved = check_numbers("familiar speeds", rows, len(np.asarray(rows)), 4)
        return cls(saved[:, :3], saved[:, 3])

    @property
    def rows(self) -> list[list[float]]:
        """What a file keeps: place and speed, a row each."""
        found: list[list[float]] = np.column_stack([self.places, self.speeds]).round(4).tolist()
        return found

    def at(self, place: NDArray[np.floating[Any]]) -> float:
        """Return how fast a hand may go at ``place`` (3,) [m/s], by the fastest of the cubes within ``NEAR``."""
        near = np.linalg.norm(self.places - place, axis=1) <= NEAR
        return max(UNKNOWN, MORE * float(self.speeds[near].max())) if near.any() else UNKNOWN
