"""What a column of numbers does: it stands, counts, follows a clock, turns over, or marks missing data.

constant        never moves
counter         whole numbers that rise by one step, but for lost rows and where they begin anew
second clock    max |x - (a + b t)| <= STRAIGHT range(x), and x never falls
wrapped angle   |x_i - x_{i-1} ∓ P| < P/4 at each jump; x reaches both ends of a turn P
sentinel        an end of the range that repeats, SENTINEL_APART ranges away from all others
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import TAU, TURN

Floats = NDArray[np.float64]

FEWEST_JUDGED_ROWS = 8  # rows from which on a column is judged
STEADY = 0.9  # share of steps that must be the usual one in a counter
STRAIGHT = 2e-3  # how far a second clock is off a straight line, as a share of its range
SENTINEL_APART = 5.0  # ranges of all other numbers between these and a sentinel
MOST_SENTINELS = 0.5  # share of rows that may hold a sentinel
LEAST_SENTINEL = 99.0  # size of a sentinel that may stand in a row of sentinels
SINGLE = 0.8  # share of a smaller sentinel that must stand in single rows


def finite(values: NDArray[Any]) -> Floats:
    """Return the finite numbers of a column."""
    return np.asarray(values[np.isfinite(values)], np.float64)


def are_whole(numbers: NDArray[Any]) -> bool:
    """Return whether all numbers are whole."""
    return bool((numbers == np.rint(numbers)).all())


def is_constant(values: NDArray[Any]) -> bool:
    """Return whether a column (T,) holds numbers and never moves."""
    numbers = finite(values)
    if not len(numbers):
        return False
    return bool(np.ptp(numbers) == 0.0)


def counts(values: NDArray[Any], fewest: int = FEWEST_JUDGED_ROWS) -> bool:
    """Return whether a column (T,) counts rows, messages or ticks.

    A counter may lose rows, wrap and begin anew. An index of episodes counts too: it rises by one
    after several rows.
    """
    numbers = finite(values)
    lacks_some = len(numbers) < len(values)
    if lacks_some or len(numbers) < fewest or not are_whole(numbers):
        return False

    steps = np.diff(numbers)
    changes = steps[steps != 0]
    rests = 1 < len(changes) < len(steps)
    if rests and changes[0] > 0 and is_constant(changes):
        return len(np.unique(numbers)) > 2

    usual = np.median(steps)
    usual_share = np.mean(steps == usual)
    if usual <= 0 or usual_share < STEADY:
        return False

    rises = steps[steps > 0]
    skips_whole_steps = (rises % usual == 0).all()
    starts = numbers[1:][steps < 0]
    highest_start = numbers.min() + usual * (FEWEST_JUDGED_ROWS + 1)
    begins_low = (starts <= highest_start).all()
    return bool(skips_whole_steps and begins_low)


def is_second_clock(values: NDArray[Any], times: Floats) -> bool:
    """Return whether a column (T,) goes on as ``times`` (T,) do."""
    is_known = np.isfinite(values) & np.isfinite(times)
    if len(values) < FEWEST_JUDGED_ROWS or not is_known.all():
        return False

    since = values.astype(np.float64) - float(values[0])
    span = np.ptp(since)
    falls = np.diff(since) < 0
    if span == 0 or falls.any():
        return False

    centred = times - times.mean()
    slope, offset = np.polyfit(centred, since, 1)
    off_line = since - offset - slope * centred
    farthest = np.abs(off_line).max()
    return bool(farthest <= STRAIGHT * span)


def wrap_period(values: NDArray[Any], unit: str) -> float:
    """Return the turn of a column (T,) that holds an angle which turns over, 360 or 2π; else 0."""
    turns = [360.0, TAU]
    if unit:
        turns = [turn for name, turn in TURN.items() if name == unit]
    angle = finite(values)
    for turn in turns:
        if _turns_over(angle, turn):
            return turn
    return 0.0


def _turns_over(angle: Floats, turn: float) -> bool:
    """Return whether an angle (T,) jumps by a turn from one end of it to the other."""
    if len(np.unique(angle)) <= FEWEST_JUDGED_ROWS:
        return False
    lowest = angle.min()
    highest = angle.max()
    start = 0.0
    if lowest < -0.05 * turn:
        start = -turn / 2
    end = start + turn
    margin = 0.1 * turn
    reaches_ends = lowest - start < margin and end - highest < margin
    is_longer = highest - lowest > 1.01 * turn
    if is_longer or not reaches_ends:
        return False

    steps = np.diff(angle)
    jumps = np.abs(steps) > 0.6 * turn
    turns = np.rint(steps / turn)
    without_turns = np.abs(steps - turn * turns)
    is_smooth = without_turns < 0.25 * turn
    return bool(jumps.any() and is_smooth.all())


def missing_value_sentinel(values: NDArray[Any]) -> float:
    """Return the number that stands for missing data in a column (T,), such as -99999; else NaN.

    A small one must stand in single rows: a sense that rests at a stop does so for long.
    """
    numbers = finite(values)
    if not len(numbers):
        return math.nan
    for sentinel in (numbers.min(), numbers.max()):
        others = numbers[numbers != sentinel]
        count = len(numbers) - len(others)
        if not 2 <= count <= MOST_SENTINELS * len(values):
            continue
        spread = np.ptp(others)
        distance = np.abs(others - sentinel).min()
        is_apart = spread > 0 and distance > SENTINEL_APART * spread
        is_large = abs(sentinel) >= LEAST_SENTINEL
        if is_apart and (is_large or _stands_alone(values == sentinel)):
            return float(sentinel)
    return math.nan


def _stands_alone(is_sentinel: NDArray[np.bool_]) -> bool:
    """Return whether a sentinel stands often, and mostly in single rows."""
    rows = np.flatnonzero(is_sentinel)
    if len(rows) < FEWEST_JUDGED_ROWS:
        return False
    single_share = np.mean(np.diff(rows) > 1)
    return bool(single_share >= SINGLE)
