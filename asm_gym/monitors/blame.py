"""Blame: the smallest set of channels that makes a row usual, if completed from all others.

    E_S = min_δ (y - A_S δ)ᵀ P (y - A_S δ) = E - hᵀ (A_Sᵀ P A_S)⁻¹ h,  h = A_Sᵀ P y

y and P are of ``memory.completion``. A_S says what the channels S change in y: their values now and
before, and their products with others, which are linear in either factor. Channels are added to S, each
time the one that explains most, until E_S is usual.

What is beyond doubt is blamed first, and left out of all predictions: a value outside of its learned
range, which no prediction from it survives, and a reading that repeats for longer than any learned.

Sources: Alcala and Qin 2009 (Automatica 45(7)) for contributions by reconstruction; Akaike 1974 (IEEE Trans. Automat.
Contr. 19(6)) for the cost of a number that is chosen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import ONE_THREAD
from asm_gym.memory.completion import FARTHEST, Completion

Floats = NDArray[np.float64]
Row = NDArray[np.floating[Any]]  # (D,)
Rows = NDArray[np.floating[Any]]  # (T, D), the newest last

JUDGED_ROWS = 3  # newest rows that a blame rests on
OUTSIDE = 0.1  # least distance of a value outside of its range, in widths of the range
OUTSIDE_NOISE = 6.0  # and in standard deviations of its noise
EXPLAINED = 0.1  # share of the excess of energy over earlier rows that a row may keep
LEAST_EXCESS = 20.0  # of energy, under which nothing is to be explained
MOST_BLAMED = 3  # channels
REMEMBERED = 64  # rows that may tell a repeating reading from others
FURTHER_EXCESS = 150.0  # under which nothing is explained beside what is certain
LEAST_SHARE = 0.2  # in the largest one, of a channel that is suspected then
COST = 2.0  # of each number that an explanation may choose, in energy: Akaike's criterion
CANDIDATES = 24  # channels that are tried otherwise, those with the most energy of their own


class _LiftedRows(NamedTuple):
    """Rows as the completion reads them."""

    y: Floats  # (K, Y) centred
    standard: Floats  # (K, D)


class _Directions(NamedTuple):
    """What some channels change in y."""

    entries: NDArray[np.intp]  # (n,) of y
    changes: Floats  # A (n, k) of these entries


class Blame:
    """Finds the channels that an alarm points to.

    Args:
        completion: of the memory that raised the alarm.
    """

    def __init__(self, completion: Completion) -> None:
        self.completion = completion
        spec = completion.spec
        senses = len(spec.sensory)
        self._now = np.zeros(spec.size, np.intp)  # entry of y of each column's value
        self._now[spec.sensory] = np.arange(senses)
        self._now[spec.commanded] = 2 * senses + np.arange(len(spec.commanded))
        self._is_sensed = np.isin(np.arange(spec.size), spec.sensory)
        squares = [first for first, second in completion.products.tolist() if first == second]
        self._freedom = 1 + self._is_sensed + np.isin(np.arange(spec.size), squares)
        self._first_product = 2 * senses + len(spec.commanded)
        with ONE_THREAD:
            _ = completion.precision  # an alarm must not wait for it

    def __call__(self, rows: Rows, shares: Row) -> tuple[int, ...]:
        """Return the columns that the newest row points to, the likeliest first; none if it lacks a number.

        Args:
            rows: (T, D) up to the first row in alarm, at best ``REMEMBERED``; some numbers may lack.
            shares: (D,) of the numbers in its surprise.
        """
        if not np.isfinite(rows[-1]).all():
            return ()
        recent = rows[-REMEMBERED:].astype(np.float64)
        certain = self._outside(recent[-1])
        certain += [column for column in self._repeating(recent, shares) if column not in certain]
        with ONE_THREAD:
            return tuple(certain + self._explaining(recent, certain, shares))[:MOST_BLAMED]

    def deviations(self, rows: Rows, columns: Sequence[int], most: int) -> Floats:
        """Return how far columns are from what explains rows (1 + T, D) best, in their units.

        Args:
            rows: of one stretch.
            columns: (n,) that are at fault together.
            most: rows that are looked at, evenly spaced.

        Returns:
            (at most ``most``, n).
        """
        completion = self.completion
        lifted = self._lifted(rows.astype(np.float64))
        firsts = np.cumsum([0, *(self._freedom[column] for column in columns[:-1])])
        found = []
        with ONE_THREAD:
            for row in range(0, len(lifted.y), max(1, len(lifted.y) // most)):
                directions = self._directions(lifted.standard[row], (), columns)
                A, stiffness = directions.changes, self._stiffness(directions)
                h = A.T @ (completion.precision[directions.entries] @ lifted.y[row])
                found.append(np.linalg.solve(stiffness, h)[firsts])
        spread = completion.senses.spread[list(columns)]
        return np.array(found[:most]) * spread

    def repeating(self, rows: Rows) -> list[int]:
        """Return the columns that repeat their reading up to the end of rows (T, D) for longer than any learned."""
        return self._repeating(rows, np.zeros(rows.shape[1]))

    def _stiffness(self, directions: _Directions) -> Floats:
        """Return Aᵀ P A (k, k)."""
        entries = directions.entries
        block = self.completion.precision[np.ix_(entries, entries)]
        return directions.changes.T @ block @ directions.changes

    def _outside(self, row: Floats) -> list[int]:
        """Return the columns whose value is outside of its range, the farthest first."""
        least, most, _ = self.completion.usual
        width = np.maximum(most - least, self.completion.senses.spread)
        distance = np.maximum(least - row, row - most)
        noise = self.completion.spec.noise
        outside = distance > np.maximum(OUTSIDE * (most - least), OUTSIDE_NOISE * noise)
        outside &= distance > np.finfo(np.float32).eps * np.abs(row)
        ranges = np.where(outside, distance / width, 0.0)
        farthest_first = np.argsort(-ranges, kind="stable")
        return farthest_first[: int(outside.sum())].tolist()

    def _repeating(self, rows: Rows, shares: Row) -> list[int]:
        """Return the columns that repeat a reading for longer than any learned, the most surprising first."""
        changed = rows[1:] != rows[:-1]
        since = np.argmax(changed[::-1], axis=0) + 1  # rows with the newest reading
        since[~changed.any(axis=0)] = len(rows)
        longest = self.completion.usual[2]
        repeating = np.flatnonzero((since > longest) & (since >= 2))
        return repeating[np.argsort(-shares[repeating], kind="stable")].tolist()

    def _explaining(self, rows: Rows, certain: list[int], shares: Row) -> list[int]:
        """Return the fewest columns that, beside those that are certain, make rows (T, D) usual."""
        now = self._lifted(rows[-JUDGED_ROWS - 1 :])
        before = self._lifted(rows[:-JUDGED_ROWS][-JUDGED_ROWS - 1 :])

        def excess(columns: list[int]) -> float:
            usual = self._left(before, certain, columns)
            return self._left(now, certain, columns) - usual

        def cost(columns: list[int]) -> float:
            free = sum(self._freedom[column] for column in columns)
            return excess(columns) + COST * free * len(now.y)

        found: list[int] = []
        left = excess(found)
        enough = max(EXPLAINED * left, LEAST_EXCESS)
        if certain:
            enough = max(enough, FURTHER_EXCESS)
        if left <= enough and not certain:
            suspects = np.flatnonzero(shares >= LEAST_SHARE * shares.max()).tolist()
            return [min(suspects, key=lambda column: cost([column]))]
        while left > enough and len(certain) + len(found) < MOST_BLAMED:
            tried = self._candidates(now.y, [*certain, *found])
            if not tried:
                break
            best = min(tried, key=lambda column: cost([*found, column]))
            found.append(best)
            left = excess(found)
        return found

    def _lifted(self, rows: Rows) -> _LiftedRows:
        """Return rows (1 + K, D) in both forms, without the first."""
        completion = self.completion
        standard = (rows - completion.senses.mean) / completion.senses.spread
        standard = np.clip(np.nan_to_num(standard), -FARTHEST, FARTHEST)
        y = completion.lift(rows) - completion.centre
        return _LiftedRows(y[1:], standard[1:])

    def _candidates(self, rows: Floats, known: Sequence[int]) -> list[int]:
        """Return columns whose own value and command bear the most energy in rows (K, Y)."""
        forces = rows @ self.completion.precision
        own = forces[:, self._now] ** 2 / np.diag(self.completion.precision)[self._now]
        energy = own.sum(axis=0)
        likeliest = np.argsort(-energy, kind="stable")[: CANDIDATES + len(known)]
        return [column for column in likeliest.tolist() if column not in known]

    def _left(self, rows: _LiftedRows, left_out: Sequence[int], changed: Sequence[int]) -> float:
        """Return the energy of rows without what some columns explain."""
        P = self.completion.precision
        total = 0.0
        for y, x in zip(rows.y, rows.standard, strict=True):
            force = P @ y
            total += float(y @ force)
            directions = self._directions(x, left_out, changed)
            if not directions.changes.size:
                continue
            A = directions.changes
            h = A.T @ force[directions.entries]
            total -= float(h @ np.linalg.solve(self._stiffness(directions), h))
        return total

    def _directions(
        self, x: Floats, left_out: Sequence[int], changed: Sequence[int]
    ) -> _Directions:
        """Return what columns change in y where the numbers are x (D,): any entry of those left out."""
        completion = self.completion
        free = np.zeros(completion.spec.size, np.bool_)
        free[list(left_out)] = True
        is_free = completion.involved(free)
        columns = list(np.eye(len(is_free))[is_free])
        for column in changed:
            columns += self._changes(x, column, is_free)
        if not columns:
            return _Directions(np.zeros(0, np.intp), np.zeros((0, 0)))
        A = np.stack(columns, axis=1)
        entries = np.flatnonzero(A.any(axis=1))
        return _Directions(entries, A[entries])

    def _changes(self, x: Floats, column: int, is_free: NDArray[np.bool_]) -> list[Floats]:
        """Return the changes (Y,) of y by a column's value, the value before, and its square."""
        size = len(is_free)
        value = np.zeros(size)
        value[self._now[column]] = 1.0
        if not self._is_sensed[column]:
            return [value]
        before = np.zeros(size)
        before[len(self.completion.spec.sensory) + self._now[column]] = 1.0
        first, second = self.completion.products.T
        entries = self._first_product + np.arange(len(first))
        as_first = (first == column) & ~is_free[entries]
        as_second = (second == column) & ~is_free[entries]
        is_square = as_first & as_second
        value[entries[as_first]] = x[second[as_first]]
        value[entries[as_second]] = x[first[as_second]]
        value[entries[is_square]] = 0.0
        changes = [value, before]
        if is_square.any():
            square = np.zeros(size)
            square[entries[is_square]] = 1.0
            changes.append(square)
        return changes


class FollowedBlame:
    """Follows the rows of one robot, to blame columns at the first row of each alarm.

    Args:
        monitor: that raises the alarms; one without ``blame_`` leaves its shares as they are.
    """

    def __init__(self, monitor: Any) -> None:
        self._blame: Blame | None = getattr(monitor, "blame_", None)
        self.begin()

    def begin(self) -> None:
        """Forget the rows before: they are not the past of those that follow."""
        self._rows: deque[Row] = deque(maxlen=REMEMBERED)
        self._was_alarm = False

    def add(self, row: Row) -> None:
        """Take up the next row (D,)."""
        self._rows.append(row)

    def columns(self, shares: Floats) -> tuple[int, ...]:
        """Return what blame points to in the newest row, by the shares (D,) of its numbers; empty without blame."""
        if self._blame is None:
            return ()
        return self._blame(np.array(self._rows), shares)

    def shares(self, row: Row, alarm: bool, shares: Floats) -> Floats:
        """Return the shares (D,) of a row's numbers in its surprise, by blame in the first row of an alarm.

        Args:
            row: (D,) the next one.
            alarm: whether it is in alarm.
            shares: (D,) by the monitor.
        """
        self.add(row)
        is_first = alarm and not self._was_alarm
        self._was_alarm = alarm
        if not is_first:
            return shares
        return reattributed(shares, self.columns(shares))


def reattributed(shares: Floats, blamed: Sequence[int]) -> Floats:
    """Return shares (D,) of the same sum in the columns that are blamed alone, half as much in each next one."""
    if not blamed:
        return shares
    weights = 0.5 ** np.arange(len(blamed))
    new = np.zeros_like(shares)
    new[list(blamed)] = shares.sum() * weights / weights.sum()
    return new
