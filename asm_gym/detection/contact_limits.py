"""How hard an arm may press and how fast its hand may go before it stays, whatever the cause is taken for.

ISO/TS 15066:2016 (Annex A) lets a robot press a hand, the least tolerant part that it is likely to meet, with 140 N for
long and 280 N for a moment. Healthy motion of the tasks of this package reaches 10 to 71 N at the wrist on one axis and
8 to 34 N m in a joint; what is peculiar to a set-up is learned from its calibration episodes, and the larger of the two
counts.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from asm_gym.data.episode import Episode
from asm_gym.spec import Channel, StreamSpec
from asm_gym.validation import check_flag, check_number

FELT = "external_torque", "wrist_force"  # ends of the names of the channels that limits are about
Floats = NDArray[np.float64]
LEFT_OUT = 0.05  # share of healthy episodes that no limit makes room for: those that pressed hardest, or went fastest
ODD = 0.002  # share of all healthy episodes that may be odd at any one place
MOST = 2.5  # what was seen counts up to so many times the usual limits: 200 N, 100 N m


OWN_PACE = 40  # healthy episodes of a task, from which on its pace is its own: at a bin others may go down fast
FAR = 100  # cells; hands further away are not learned of
CELL = 0.04, 0.04, 0.02  # edges of the cells by which pace is learned [m]
FASTER = 1.25  # a hand may be commanded to go so many times as fast as healthy ones did: about 0.8 of it is reached
DOWN = 1.05  # the same of a hand that goes down, where what it meets is hard
SLACK = np.array([0.03] * 3 + [0.15] * 3)  # and by so much more [m/s], [rad/s]
STILL = 1e-9  # no speed is divided by less [m/s]
MOMENTUM = 1.5  # of an arm along its hand's motion where no healthy hand was: 10 kg at the usual speed [N s]
MOMENTUM_ASTRAY = 1.35  # the same in a task whose own pace is known


class Pace:
    """How fast healthy hands went, by place and direction.

    Args:
        cells: (N, 16) arm; place in cells; greatest twist along the axes of the world and against them. The greatest
            counts where a place is given twice.
        momentum: limit of an arm's, along its hand's motion, where no healthy hand was [N s].

    Raises:
        ValueError: numbers that are none of these.
    """

    def __init__(self, cells: NDArray[np.floating[Any]], momentum: float = MOMENTUM) -> None:
        near = cells.ndim == 2 and cells.shape[1] == 16 and len(cells) > 0 and (np.abs(cells[:, :4]) <= FAR).all()
        if not (near and (cells[:, 0] >= 0).all() and (cells[:, 4:] >= 0).all()):
            raise ValueError(f"pace must be rows of 16 numbers, places within {FAR} cells, got {cells.shape}")
        self.cells, self.momentum, at = cells, momentum, cells[:, :4].astype(np.intp)
        self._low = at.min(axis=0) - (0, 1, 1, 1)
        grid = np.zeros((*(at.max(axis=0) - self._low + (1, 2, 2, 2)), 12), np.float32)
        np.maximum.at(grid, tuple((at - self._low).T), cells[:, 4:])
        # Neighbours count as well, downwards those at the same height.
        self._seen = maximum_filter(grid, (1, 3, 3, 3, 1))
        self._seen[..., 8] = maximum_filter(grid[..., 8], (1, 3, 3, 1))

    @classmethod
    def of(cls, known: Mapping[str, NDArray[np.floating[Any]]], task: str = "") -> Self | None:
        """Return the pace of a task, by cells of each; of all tasks where it is not ``known``, None where none is."""
        if task and task in known:
            return cls(known[task], MOMENTUM_ASTRAY)
        return cls(np.concatenate(list(known.values()))) if known else None

    @classmethod
    def by_task(cls, episodes: Sequence[Episode], spec: StreamSpec) -> dict[str, NDArray[np.float32]]:
        """Return the cells of each task with ``OWN_PACE`` healthy episodes, and of all others under an empty name."""
        streams: defaultdict[str, list[NDArray[np.float32]]] = defaultdict(list)
        count = Counter(e.label.task if e.label else "" for e in episodes)
        for e in episodes:
            streams[e.label.task if e.label and count[e.label.task] >= OWN_PACE else ""].append(e.stream)
        learned = {name: cls.learned(own, spec) for name, own in streams.items()}
        return {name: cells for name, cells in learned.items() if cells is not None}

    @staticmethod
    def learned(streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> NDArray[np.float32] | None:
        """Return the cells of healthy streams (T, D); None where these do not tell how hands move.

        The fastest ``LEFT_OUT`` of the episodes at a place, and ``ODD`` of all more, do not count there: of hundreds of
        episodes an odd one sets no pace where few others go.
        """
        found = []
        names = [c.name.removesuffix("position") for c in spec.channels if c.name.endswith("hand_position")]
        for arm, name in enumerate(names):
            parts = [spec.slices.get(name + what) for what in ("position", "velocity", "angular_velocity")]
            if None in parts:
                continue
            each = (np.column_stack((np.full(len(x), n), *(x[:, p] for p in parts))) for n, x in enumerate(streams))
            rows = np.concatenate(list(each)).astype(np.float64)  # (T, 10) episode, place, velocity, turn
            rows = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 1:4]) < FAR * np.array(CELL)).all(axis=1)]
            rows[:, 1:4] = np.floor(rows[:, 1:4] / CELL)
            visits, which = np.unique(rows[:, :4], axis=0, return_inverse=True)
            fastest = np.zeros((len(visits), 12))
            np.maximum.at(fastest, which.ravel(), np.hstack((rows[:, 4:], -rows[:, 4:])))
            places, which = np.unique(visits[:, 1:], axis=0, return_inverse=True)
            ordered = (np.sort(fastest[which.ravel() == n], axis=0)[::-1] for n in range(len(places)))
            kept = [own[int(LEFT_OUT * len(own) + ODD * len(streams)) :] for own in ordered]
            seen = [(arm, *place, *own[0]) for place, own in zip(places, kept, strict=True) if len(own)]
            found.append(np.array(seen).reshape(-1, 16))
        return np.concatenate(found).astype(np.float32) if found else None

    def seen(self, arm: int, place: Floats) -> NDArray[np.floating[Any]]:
        """Return (2, 6) the greatest twist near a place (3,), along the axes of the world and against them; else 0."""
        cell = (arm, *np.floor(place / CELL).astype(np.intp)) - self._low
        there = (cell >= 0).all() and (cell < self._seen.shape[:4]).all()
        return self._seen[tuple(cell)].reshape(2, 6) if there else np.zeros((2, 6))

    def shares(self, arm: int, place: Floats, twists: Floats, speeds: Floats, momenta: Floats, usual: float) -> Floats:
        """Return the shares of ``ContactLimits.shares``; ``usual`` is the limit of speed."""
        seen = self.seen(arm, place)
        along = FASTER * np.where(twists > 0.0, seen[0], seen[1])
        known = ((along + SLACK) / np.maximum(np.abs(twists), STILL)).min(axis=1)
        known = np.minimum(known, np.clip(DOWN * seen[1, 2], SLACK[2], usual) / np.maximum(-twists[:, 2], STILL))
        return np.maximum(np.minimum(usual / speeds, self.momentum / np.maximum(momenta, STILL)), known)


@dataclass(frozen=True)
class ContactLimits:
    """Limit the contact forces of an arm and the speed of its hand.

    Args:
        wrist_force: on each axis of the wrist, including the weight of the hand [N].
        external_torque: of each joint [N m].
        hand_speed: of the hand, and of points 0.15 m from its fingers as it turns [m/s]; infinite for no limit.
            Under OSC_POSE, OSC_POSITION and JOINT_POSITION a faster command is scaled down. Under every controller a
            brake slows an arm that is still too fast.
        pace: higher speeds where healthy hands were faster; None for no such places.
        healthy: largest values in healthy motion of this body and task, (N,) in the order of
            ``RobosuiteEnv.felt_channels``; a larger one replaces the limit. Empty if unknown.
        stays: hold the arm from the physics substep after a limit was passed; False only reports.

    Raises:
        ValueError: a limit is not positive.
    """

    wrist_force: float = 80.0
    external_torque: float = 40.0
    hand_speed: float = 0.15
    healthy: tuple[float, ...] = ()
    pace: Pace | None = None
    stays: bool = True

    def __post_init__(self) -> None:
        for name in ("wrist_force", "external_torque", "hand_speed"):
            check_number(name, getattr(self, name), above=0, infinite=True)
        for value in self.healthy:
            check_number("healthy", value, low=0)
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
            pace=None,
        )

    def and_those_of(self, other: ContactLimits, felt: Sequence[Channel]) -> ContactLimits:
        """Return limits as strict as the stricter of two; those for which an arm stays count alone, if one does."""
        if self.stays != other.stays:
            return self if self.stays else other
        same = self.pace is not None and other.pace is not None and np.array_equal(self.pace.cells, other.pace.cells)
        return replace(
            self,
            wrist_force=min(self.wrist_force, other.wrist_force),
            external_torque=min(self.external_torque, other.external_torque),
            hand_speed=min(self.hand_speed, other.hand_speed),
            healthy=tuple(np.minimum(self.most(felt), other.most(felt)).tolist()),
            pace=self.pace if same else None,
        )

    def shares(self, arm: int, place: Floats, twists: Floats, speeds: Floats, momenta: Floats) -> Floats:
        """Return the share (n,) that a hand may have of each of n motions, above 1 where it may go faster.

        Args:
            arm, place: which, and where it is (3,) [m].
            twists, speeds: the motions (n, 6), and how fast the hand's fastest point goes in each (n,) [m/s].
            momenta: the arm's along its hand's motion in each (n,) [N s]; 0 where nobody knows.
        """
        speeds, usual = np.maximum(speeds, STILL), self.hand_speed
        return usual / speeds if self.pace is None else self.pace.shares(arm, place, twists, speeds, momenta, usual)


def healthy_forces(streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> tuple[float, ...]:
    """Return the most that healthy streams (T, D) reached, of each number that an arm feels [N m], [N]; () without."""
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
