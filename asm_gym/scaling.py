r"""What of a stream row the memory reads: values and their changes.

The temporal network senses both the value, which says where in a skill the robot is, and the change, which says what is
happening now (generalised coordinates of motion: Friston 2008, PLOS Comput Biol 4(11)). Association predicts the change
of every channel from all values before and all other changes.

    s_t = [v_t, Δ_t,slow]      v_t = (x_t - m) / σ      Δ_t = (x_t - x_{t-l}) / σ_Δ      slow:  σ_Δ < 0.3 σ
    a_t = [v_{t-l}, Δ_t, Δ_{t-l},slow, u_t, 1]

l is 1 at a robot's control rate. Where rows come faster, motion between two of them is less than sensor noise, and
the change is taken over the l rows of a twentieth of a second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.readings import resolution
from asm_gym.spec import CARRIED_CHANNEL, HANDLED, StreamSpec

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rows = NDArray[np.floating[Any]]

SLOW = 0.3  # a channel is slow where a step's change is under this share of its spread
LAPSE = 0.05  # time over which a change is taken, where rows come faster [s]
FEWEST_VALUES = 5  # a channel of fewer different values is a flag or a mode
RESOLUTION_ROWS = 10_000  # about so many rows tell the resolution of each channel

# Precision of what a handled object does where it may begin to move with the hand, or stop: as that
# of a row at a knock (``detection.benign_events``).
EXPECTED = 0.1

# Where standardised numbers are cut off, so that no finite row overflows; nothing is predicted
# from such a number.
FARTHEST_NUMBER = 1e3


class ScaledRows(NamedTuple):
    """Rows of B streams, as the memory reads them; S numbers are sensed, X changes judged."""

    senses: NDArray[np.float32]  # (B, S) standardised; 0 where unseen
    seen: NDArray[np.float32]  # (B, S) 1 where there was something to read, else 0
    commands: NDArray[np.float32]  # (B, A + 1) standardised, then a constant 1
    inputs: NDArray[np.float32]  # (B, I) of association; 0 where unseen or cut off
    changes: NDArray[np.float32]  # (B, X) what is judged; 0 where unseen
    whole: NDArray[np.float32]  # (B, 1) 1 where nothing was unseen in any of the three rows, else 0
    precision: NDArray[np.float32]  # (B, X) of changes, by what they happen in; see ``expectation``
    finite: NDArray[np.bool_]  # (B, D)


class RowScale(NamedTuple):
    """How compiled code reads rows of a stream: the scale of each column, and what the columns are."""

    mean: Floats  # (D,) of the training rows [unit of each channel]
    spread: Floats  # (D,) their standard deviation
    change: Floats  # (D,) standard deviation of the change over ``lag`` rows
    sensory: Ints  # (X,) columns that are sensed
    commanded: Ints  # (A,) columns that are commanded
    slow: Ints  # (S - X,) columns whose change is sensed too
    carried: Ints  # (D,) column that says how the object of a column moves; -1 for other columns


@dataclass(frozen=True, eq=False)
class StreamScaler:
    """Standardises rows of a stream."""

    spec: StreamSpec
    mean: Floats  # (D,) of the training rows [unit of each channel]
    spread: Floats  # (D,) their standard deviation
    change: Floats  # (D,) standard deviation of the change over ``lag`` rows
    lag: int = 1  # l

    @classmethod
    def fit(cls, spec: StreamSpec, streams: Sequence[NDArray[np.float32]], lag: int = 1) -> Self:
        """Learn the scale from training episodes (T, D) of more than ``lag`` rows each."""
        rows = np.concatenate(streams).astype(np.float64)  # (N, D)
        parts = [stream[lag:].astype(np.float64) - stream[:-lag] for stream in streams]
        changes = np.concatenate(parts)  # (M, D)
        mean = rows.mean(axis=0)
        spread = _spread(rows, mean, spec.noise)
        change = np.maximum(changes.std(axis=0), _least_change(streams, spec.noise))
        change = np.where(change > 0, change, spread)
        return cls(spec, mean, spread, change, lag)

    @classmethod
    def of(cls, spec: StreamSpec, arrays: Mapping[str, Any], lag: int = 1) -> Self:
        """Return the scaler whose ``arrays`` a file kept."""
        return cls(spec, arrays["mean"], arrays["spread"], arrays["change"], lag)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to keep in a file."""
        return {"mean": self.mean, "spread": self.spread, "change": self.change}

    @cached_property
    def slow(self) -> NDArray[np.intp]:
        """(S - X,) columns of the stream whose change is sensed too."""
        slow = self.change < SLOW * self.spread
        slow[self.spec.commanded] = False
        return np.flatnonzero(slow)

    @cached_property
    def row_scale(self) -> RowScale:
        """The scale for compiled code, which takes writable arrays of one type only."""
        return RowScale(
            mean=np.array(self.mean, np.float64),
            spread=np.array(self.spread, np.float64),
            change=np.array(self.change, np.float64),
            sensory=self.spec.sensory.copy(),
            commanded=self.spec.commanded.copy(),
            slow=self.slow,
            carried=carried_columns(self.spec),
        )

    @cached_property
    def size(self) -> int:
        """S, how many numbers are sensed: the values, and the changes of slow channels."""
        return len(self.spec.sensory) + len(self.slow)

    @cached_property
    def changes(self) -> slice:
        """Columns of the X changes among the I inputs."""
        return slice(self.spec.size, self.spec.size + len(self.spec.sensory))

    @cached_property
    def groups(self) -> NDArray[np.intp]:
        """(X,) the group of each change, by number; where all are of one group, every number is its own."""
        sensory_names = np.array(self.spec.groups)[self.spec.sensory]
        _, groups = np.unique(sensory_names, return_inverse=True)
        if not groups.any():  # one group, of number 0
            return np.arange(len(groups))
        return groups.astype(np.intp)

    @cached_property
    def inputs(self) -> int:
        """I, how many numbers association reads: those before, all changes, the command and a constant."""
        return self.spec.size + self.size + len(self.spec.commanded) + 1

    def read_episode(self, stream: Rows) -> ScaledRows:
        """Read all rows of an episode (T, D); nothing has moved before the first ``lag``."""
        lag = self.lag
        before = np.concatenate([stream[:lag], stream[:-lag]])  # (T, D), ``lag`` rows before
        earlier = np.concatenate([before[:lag], before[:-lag]])  # (T, D), 2 ``lag`` rows before
        return self.read(stream, before, earlier)

    def read(self, rows: Rows, before: Rows, earlier: Rows) -> ScaledRows:
        """Read rows (B, D), those ``lag`` rows before, and as long before those; what is not finite is unseen."""
        return read_rows(
            rows=np.ascontiguousarray(rows, np.float64),
            before=np.ascontiguousarray(before, np.float64),
            earlier=np.ascontiguousarray(earlier, np.float64),
            scale=self.row_scale,
        )


def carried_columns(spec: StreamSpec) -> Ints:
    """Return for each column (D,) of the group ``HANDLED`` its column of ``CARRIED_CHANNEL``; -1 for all others."""
    columns = np.full(spec.size, -1, np.intp)
    for channel in spec.channels:
        prefix = channel.name.removesuffix(CARRIED_CHANNEL)
        if channel.group != HANDLED or prefix == channel.name:
            continue
        for other in spec.channels:
            if other.group == HANDLED and other.name.startswith(prefix):
                columns[spec.slices[other.name]] = spec.slices[channel.name].start
    return columns


@inner
def expectation(number: float, before: float, earlier: float) -> float:
    """Return the precision of what an object does, by how it moves in the last three rows.

    0: no object is tracked in one of them. ``EXPECTED``: fingers moved at it, so that it may begin to move with the
    hand, or stop. Else 1.
    """
    least = min(number, before, earlier)
    if least < 0.0:
        return 0.0
    if is_undecided(number) or is_undecided(before) or is_undecided(earlier):
        return EXPECTED
    return 1.0


@inner
def is_undecided(carried: float) -> bool:
    """Return whether an object neither moves with the hand nor rests."""
    return 0.0 < carried < 1.0


@inner
def _cut_off(number: float) -> float:
    """Return the number cut off at ±``FARTHEST_NUMBER``; 0 for NaN, as two infinite numbers make."""
    if np.isnan(number):
        return 0.0
    return min(max(number, -FARTHEST_NUMBER), FARTHEST_NUMBER)


@inner
def _zero_if_extreme(number: float) -> float:
    """Return the number; 0 where it is not known, or so large that it would be cut off."""
    if abs(number) < FARTHEST_NUMBER:
        return number
    return 0.0


@inner
def _standardised(number: float, mean: float, spread: float) -> float:
    """Return a number in standard deviations from the mean; 0 where it is unseen."""
    if np.isfinite(number):
        return _cut_off((number - mean) / spread)
    return 0.0


@inner
def _changed(number: float, before: float, change: float) -> float:
    """Return a change in standard deviations; 0 where either number is unseen."""
    if np.isfinite(number) and np.isfinite(before):
        return _cut_off((number - before) / change)
    return 0.0


@compiled
def read_rows(rows: Floats, before: Floats, earlier: Floats, scale: RowScale) -> ScaledRows:
    """Read rows (B, D), see ``StreamScaler.read``."""
    mean = scale.mean
    spread = scale.spread
    change = scale.change
    B, D = rows.shape
    X = len(scale.sensory)
    L = len(scale.slow)
    A = len(scale.commanded)
    senses = np.zeros((B, X + L), np.float32)
    seen = np.zeros((B, X + L), np.float32)
    commands = np.ones((B, A + 1), np.float32)
    inputs = np.ones((B, D + X + L + A + 1), np.float32)
    changes = np.zeros((B, X), np.float32)
    whole = np.ones((B, 1), np.float32)
    precision = np.ones((B, X), np.float32)
    finite = np.zeros((B, D), np.bool_)
    for n in range(B):
        for i in range(D):
            finite[n, i] = np.isfinite(rows[n, i])
            was_finite = np.isfinite(before[n, i]) and np.isfinite(earlier[n, i])
            if not (finite[n, i] and was_finite):
                whole[n, 0] = 0.0
            inputs[n, i] = _zero_if_extreme((before[n, i] - mean[i]) / spread[i])

        for j in range(X):
            i = scale.sensory[j]
            value = rows[n, i]
            last = before[n, i]
            seen[n, j] = finite[n, i]
            senses[n, j] = _standardised(value, mean[i], spread[i])
            changes[n, j] = _changed(value, last, change[i])
            inputs[n, D + j] = _zero_if_extreme((value - last) / change[i])

        for j in range(L):
            i = scale.slow[j]
            k = X + j
            value = rows[n, i]
            last = before[n, i]
            seen[n, k] = finite[n, i] and np.isfinite(last)
            senses[n, k] = _changed(value, last, change[i])
            inputs[n, D + k] = _zero_if_extreme((last - earlier[n, i]) / change[i])

        for j in range(A):
            i = scale.commanded[j]
            commands[n, j] = _standardised(rows[n, i], mean[i], spread[i])
            inputs[n, D + X + L + j] = _zero_if_extreme(commands[n, j])
        expect_events(scale, rows[n], before[n], earlier[n], inputs[n], precision[n])
    return ScaledRows(
        senses=senses,
        seen=seen,
        commands=commands,
        inputs=inputs,
        changes=changes,
        whole=whole,
        precision=precision,
        finite=finite,
    )


@inner
def expect_events(
    scale: RowScale, row: Any, before: Any, earlier: Any, inputs: Any, precision: Any
) -> None:
    """Write the precision (X,) of changes of handled objects, and 0 for inputs (I,) that predict nothing.

    These are all changes of an object of which nothing was known before, and of the number that says how it moves.
    """
    D = len(row)
    X = len(scale.sensory)
    for j in range(X):
        i = scale.sensory[j]
        c = scale.carried[i]
        if c < 0:
            continue
        if i != c:
            precision[j] = expectation(row[c], before[c], earlier[c])
        else:
            precision[j] = 0.0  # what the tracker says of itself is a context
        if precision[j] == 0.0:
            inputs[D + j] = 0.0
    for j in range(len(scale.slow)):
        i = scale.slow[j]
        c = scale.carried[i]
        if c >= 0 and (i == c or before[c] < 0.0 or earlier[c] < 0.0):
            inputs[D + X + j] = 0.0


def rows_apart(dt: float) -> int:
    """Return the lag l of a change, where rows come every ``dt`` seconds."""
    return max(1, round(LAPSE / dt))


def _spread(
    rows: NDArray[np.float64], mean: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the standard deviations (D,); of a constant column its sensor noise, or 1 where that is 0."""
    spread = rows.std(axis=0)
    constant = spread <= 1e-6 * np.abs(mean)  # the rounding of float32 is not a signal
    fallback: NDArray[np.float64] = np.where(noise > 0, noise, 1.0)
    return np.where(constant, fallback, np.maximum(spread, noise))


def _least_change(
    streams: Sequence[NDArray[np.float32]], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the least spread of changes (D,): √2 of half the noise, and of the spread of rounding.

    Otherwise a channel that moves once in a thousand rows, by its resolution, would surprise each time.
    """
    episodes = max(1, RESOLUTION_ROWS // max(1, len(streams[0])))
    resolutions = [_resolutions(stream[:RESOLUTION_ROWS]) for stream in streams[:episodes]]
    rounding = np.max(resolutions, axis=0) / np.sqrt(12.0)  # spread of a uniform rounding error
    return np.sqrt(2.0) * np.maximum(noise / 2, rounding)


def _resolutions(stream: NDArray[np.float32]) -> list[float]:
    """Return the resolution of each channel (D,) of a stream (T, D); 0 for a flag or a mode."""
    resolutions = [0.0] * stream.shape[1]
    for column, values in enumerate(stream.T):
        if len(np.unique(values)) >= FEWEST_VALUES:
            resolutions[column] = resolution(values)
    return resolutions
