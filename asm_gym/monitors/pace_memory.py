"""Pace: how fast healthy motion passes a place in a direction.

    pace = median of |q̇_t| / |q̇_i|     i: the healthy moments most like moment t in place and direction

1 is the pace of healthy episodes; 0.7 of a motion that is 30 % slower on the same path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.torque.arm_features import position_columns
from asm_gym.readings import spans
from asm_gym.scaling import StreamScaler, rows_apart

Floats = NDArray[np.float64]

MOMENTS = "pace_moments"  # in a checkpoint
LIMITS = "pace_limits"
MOST_MOMENTS = 2000  # that are remembered, evenly spaced
MOST_QUERIES = 200  # moments that are looked up, evenly spaced
FARTHEST = 0.99  # quantile of the distance of a healthy place from those of other episodes
NEAREST = 5  # moments whose median speed is expected
STILL = 0.05  # of the median speed, under which nothing moves
LONGER = 1.2  # times the longest healthy pause, and
PAUSE_S = 0.3  # so much more, is a standstill [s]
TURNING = 0.5  # weight of the direction beside the place


class Motion(NamedTuple):
    """Where a stream is in each of N moments, and how it moves."""

    place: Floats  # (N, J) standardised
    direction: Floats  # (N, J) of length 1; 0 at rest
    speed: Floats  # (N,) standardised numbers a second


class PaceMemory(NamedTuple):
    """Moments of healthy motion."""

    moments: Motion
    longest_pause: float  # [s]
    farthest: float  # usual distance of a place from those of other episodes
    columns: NDArray[np.intp]  # (J,) positions
    senses: StreamScaler

    @classmethod
    def fit(cls, senses: StreamScaler, streams: Sequence[NDArray[np.floating[Any]]]) -> Self | None:
        """Learn from training episodes (T, D); None for a stream without positions, or that never moves."""
        columns = position_columns(senses.spec)
        if not len(columns):
            return None
        motions = [motion_in(senses, columns, stream) for stream in streams]
        speed = np.concatenate([motion.speed for motion in motions])
        slowest = STILL * float(np.median(speed))
        if slowest <= 0.0:
            return None
        pauses = [_longest_run(motion.speed < slowest) for motion in motions]
        moving = np.flatnonzero(speed >= slowest)
        kept = moving[:: max(1, len(moving) // MOST_MOMENTS)]
        place = np.concatenate([motion.place for motion in motions])
        direction = np.concatenate([motion.direction for motion in motions])
        moments = Motion(place[kept], direction[kept], speed[kept])
        ends = np.cumsum([len(motion.speed) for motion in motions])
        episode = np.searchsorted(ends, kept, side="right")
        farthest = _distance_of_others(moments.place, episode)
        return cls(moments, max(pauses) * senses.spec.dt, farthest, columns, senses)

    @classmethod
    def found(cls, learned: Mapping[str, NDArray[Any]], senses: StreamScaler) -> Self | None:
        """Restore what ``named`` returned; None where it is absent."""
        columns = position_columns(senses.spec)
        if MOMENTS not in learned or not len(columns):
            return None
        size = len(columns)
        moments = np.asarray(learned[MOMENTS], np.float64)
        if moments.ndim != 2 or moments.shape[1] != 2 * size + 1:
            raise ValueError(f"{MOMENTS} should have {2 * size + 1} columns, got {moments.shape}")
        motion = Motion(moments[:, :size], moments[:, size:-1], moments[:, -1])
        pause, farthest = np.asarray(learned[LIMITS], np.float64)
        return cls(motion, float(pause), float(farthest), columns, senses)

    def named(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        place, direction, speed = self.moments
        moments = np.hstack([place, direction, speed[:, None]])
        return {
            MOMENTS: moments.astype(np.float32),
            LIMITS: np.array([self.longest_pause, self.farthest]),
        }

    @property
    def slowest(self) -> float:
        """Speed under which nothing moves."""
        return STILL * float(np.median(self.moments.speed))

    def pace(self, rows: NDArray[np.floating[Any]]) -> float:
        """Return the pace of rows (T, D); 0 where they stand still, NaN where they are too few."""
        motion = motion_in(self.senses, self.columns, rows)
        moving = motion.speed >= self.slowest
        if len(motion.speed) < 2:
            return np.nan
        if not moving.any():
            return 0.0
        step = max(1, int(moving.sum()) // MOST_QUERIES)
        query = Motion(*(part[moving][::step] for part in motion))
        place, direction, speed = self.moments
        apart = _distances(query.place, place)
        turned = 1.0 - query.direction @ direction.T
        nearest = np.argpartition(apart + TURNING * turned, NEAREST - 1, axis=1)[:, :NEAREST]
        expected = np.median(speed[nearest], axis=1)
        return float(np.median(query.speed / expected))

    def is_elsewhere(self, rows: NDArray[np.floating[Any]]) -> bool:
        """Return whether rows (T, D) are at places where no healthy episode was."""
        place = motion_in(self.senses, self.columns, rows).place
        if not len(place):
            return False
        place = place[:: max(1, len(place) // MOST_QUERIES)]
        return bool(np.median(_distances(place, self.moments.place).min(axis=1)) > self.farthest)

    def stands_still(self, rows: NDArray[np.floating[Any]]) -> bool:
        """Return whether rows (T, D) end in a pause that is longer than any healthy one."""
        motion = motion_in(self.senses, self.columns, rows)
        moves = np.flatnonzero(motion.speed >= self.slowest)
        still = len(motion.speed)
        if len(moves):
            still -= int(moves[-1]) + 1
        return still * self.senses.spec.dt > LONGER * self.longest_pause + PAUSE_S


def motion_in(
    senses: StreamScaler, columns: NDArray[np.intp], stream: NDArray[np.floating[Any]]
) -> Motion:
    """Return the motion of an episode (T, D), without its first rows."""
    lag = rows_apart(senses.spec.dt)
    scaled = (stream[:, columns] - senses.mean[columns]) / senses.spread[columns]
    scaled = np.nan_to_num(scaled.astype(np.float64))
    change = (scaled[lag:] - scaled[:-lag]) / (lag * senses.spec.dt)
    speed = np.linalg.norm(change, axis=1)
    direction = change / np.maximum(speed, np.finfo(np.float64).tiny)[:, None]
    return Motion(scaled[lag:], direction, speed)


def _distances(places: Floats, others: Floats) -> Floats:
    """Return the mean squared distance (N, M) of places (N, J) from others (M, J)."""
    return np.asarray(((places[:, None] - others) ** 2).mean(axis=2))


def _distance_of_others(places: Floats, episode: NDArray[np.intp]) -> float:
    """Return the usual distance of places (N, J) from the nearest one of another episode (N,)."""
    step = max(1, len(places) // MOST_QUERIES)
    apart = _distances(places[::step], places)
    apart[episode[::step, None] == episode] = np.inf
    nearest = apart.min(axis=1)
    return float(np.quantile(nearest, FARTHEST))


def _longest_run(mask: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True in a mask (T,)."""
    return max((stop - start for start, stop in spans(mask)), default=0)
