"""How large a lasting error of a sense a calibrated monitor sees, measured on healthy episodes.

    x'_t = x_t + a R      for a second from an onset on;   R: range of the sense, a: a share of it

An error is seen where it raises an alarm within that second; where an alarm came before it, nothing is known. A size
counts where k of P places show it and (k + 1)/(P + 2) >= 0.8 (Laplace's rule of succession): of five places, all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.torque.arm_features import position_columns, torque_columns

SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # a, of a range
RANGE = (0.05, 0.95)  # quantiles between which a sense ranges
PLACES = 5  # episodes in which errors are tried, in both directions
MOST = 0.8  # share of other places in which an error is expected to be seen
BEFORE_S = 3.0  # of a clip before the error [s]
LASTS_S = 1.0  # length of an error [s]


class Sight(NamedTuple):
    """The least lasting error of a sense that is seen in most places."""

    label: str
    unit: str
    size: float  # in this unit; inf where half of the range is not seen
    share: float  # of the range


def clip_of(episode: Episode) -> tuple[Episode, int]:
    """Return the rows about the middle of an episode, and the row among them in which an error begins."""
    dt = episode.spec.dt
    middle = len(episode) // 2
    start = max(0, middle - round(BEFORE_S / dt))
    rows = episode.stream[start : middle + round(LASTS_S / dt)]
    return Episode.from_stream(rows, episode.spec, success=True), middle - start


def first_alarm(score: Surprise, threshold: float, onset: int) -> int | None:
    """Return the row from the onset on that raises an alarm; None without, or where a row before it did."""
    is_over = score.value > threshold
    if is_over[:onset].any() or not is_over[onset:].any():
        return None
    return onset + int(is_over[onset:].argmax())


class Errors(NamedTuple):
    """Clips with lasting errors of senses: of C senses, A sizes, in P places and directions."""

    columns: NDArray[np.intp]  # (C,)
    sizes: NDArray[np.float64]  # (C, A)
    clips: list[Episode]  # C A P
    onsets: list[int]  # of each clip

    @classmethod
    def of(cls, episodes: Sequence[Episode], shares: Sequence[float]) -> Self:
        """Add errors of these shares of their range to torques and positions that vary."""
        spec = episodes[0].spec
        rows = np.concatenate([episode.stream for episode in episodes])
        low, high = np.quantile(rows, RANGE, axis=0)
        columns = np.union1d(torque_columns(spec), position_columns(spec)).astype(np.intp)
        columns = columns[(high - low)[columns] > 0]
        return cls.at(episodes, columns, np.outer((high - low)[columns], shares))

    @classmethod
    def at(
        cls,
        episodes: Sequence[Episode],
        columns: NDArray[np.intp],
        sizes: NDArray[np.float64],
    ) -> Self:
        """Add errors of these sizes (C, A) to columns (C,), at places in the middle of episodes."""
        spec = episodes[0].spec
        last = len(episodes) - 1
        chosen = np.unique(np.linspace(0, last, PLACES).round().astype(np.intp))
        places = [clip_of(episodes[n]) for n in chosen]
        clips = []
        onsets = []
        for column, column_sizes in zip(columns, sizes, strict=True):
            for size, sign, (clip, onset) in product(column_sizes, (-1, 1), places):
                stream = clip.stream.copy()
                stream[onset:, column] += sign * size
                clips.append(Episode.from_stream(stream, spec))
                onsets.append(onset)
        return cls(columns=columns, sizes=sizes, clips=clips, onsets=onsets)


def sights(monitor: CalibratedMonitor, episodes: Sequence[Episode]) -> list[Sight]:
    """Return what a calibrated monitor sees of each torque and position that varies in healthy episodes."""
    errors = Errors.of(episodes, SHARES)
    if not errors.clips:
        return []
    seen = _is_seen(monitor, errors)
    is_enough = expected_share(np.nan_to_num(seen)) >= MOST
    spec = monitor.spec
    return [
        _least(spec.labels[column], spec.units[column], of_column, own_sizes)
        for column, of_column, own_sizes in zip(
            errors.columns, is_enough, errors.sizes, strict=True
        )
    ]


def expected_share(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of other places in which errors (…, P) would be seen, by both directions at each place."""
    places = seen.shape[-1] / 2
    shown = seen.sum(axis=-1) / 2
    return np.asarray((shown + 1) / (places + 2))


def seen_again(
    monitor: CalibratedMonitor, sizes: Sequence[Sight], episodes: Sequence[Episode]
) -> NDArray[np.bool_]:
    """Return which errors (N,), of the sizes that a monitor says it sees, it sees in other episodes.

    Those that an alarm came before are left out.
    """
    finite = [sight for sight in sizes if math.isfinite(sight.size)]
    if not finite:
        return np.zeros(0, bool)
    columns = [monitor.spec.labels.index(sight.label) for sight in finite]
    each_size = np.array([[sight.size] for sight in finite])
    errors = Errors.at(episodes, np.array(columns, np.intp), each_size)
    seen = _is_seen(monitor, errors)
    return seen[np.isfinite(seen)] > 0


def _is_seen(monitor: CalibratedMonitor, errors: Errors) -> NDArray[np.float64]:
    """Return 1 for errors that raise an alarm, else 0 (C, A, P); NaN where an alarm came before."""
    seen = []
    for score, onset in zip(monitor.score_episodes(errors.clips), errors.onsets, strict=True):
        is_over = score.value > monitor.threshold
        if is_over[:onset].any():
            seen.append(math.nan)
        else:
            seen.append(float(is_over[onset:].any()))
    return np.reshape(seen, (*errors.sizes.shape, -1))


def _least(
    label: str, unit: str, is_enough: NDArray[np.bool_], sizes: NDArray[np.float64]
) -> Sight:
    """Return the least of sizes (A,) from which on all are seen in enough places (A,)."""
    is_too_small = np.flatnonzero(~is_enough)
    first = 0
    if len(is_too_small):
        first = int(is_too_small[-1]) + 1
    if first == len(sizes):
        return Sight(label, unit, size=math.inf, share=math.inf)
    return Sight(label, unit, size=float(sizes[first]), share=SHARES[first])
