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

from asm_gym.data.names import TAU, TURN

Floats = NDArray[np.float64]

FEWEST = 8  # rows from which on a column is judged
STEADY = 0.9  # share of steps that must be the usual one in a counter
STRAIGHT = 2e-3  # how far a second clock is off a straight line, as a share of its range
SENTINEL_APART = 5.0  # ranges of all other numbers between these and a sentinel
MOST_SENTINELS = 0.5  # share of rows that may hold a sentinel
LEAST_SENTINEL = 99.0  # size of a sentinel that may stand in a row of sentinels
SINGLE = 0.8  # share of a smaller sentinel that must stand in single rows


def finite(values: NDArray[Any]) -> Floats:
    """Return the finite numbers of a column."""
    return np.asarray(values[np.isfinite(values)], np.float64)


def is_constant(values: NDArray[Any]) -> bool:
    """Return whether a column (T,) holds numbers and never moves."""
    numbers = finite(values)
    return len(numbers) > 0 and bool((numbers == numbers[0]).all())


def counts(values: NDArray[Any], fewest: int = FEWEST) -> bool:
    """Return whether a column (T,) counts rows, messages or ticks.

    A counter may lose rows, wrap and begin anew. An index of episodes counts too: it rises by one
    after several rows.
    """
    numbers = finite(values)
    if len(numbers) < max(fewest, len(values)) or (numbers != np.rint(numbers)).any():
        return False

    steps = np.diff(numbers)
    changes = steps[steps != 0]
    if 1 < len(changes) < len(steps) and changes[0] > 0 and (changes == changes[0]).all():
        return len(np.unique(numbers)) > 2

    usual = float(np.median(steps))
    if usual <= 0 or np.mean(steps == usual) < STEADY:
        return False
    begins_anew = np.flatnonzero(steps < 0) + 1
    near_least = numbers[begins_anew] <= numbers.min() + usual * (FEWEST + 1)
    return bool((steps[steps > 0] % usual == 0).all() and near_least.all())


def is_second_clock(values: NDArray[Any], times: Floats) -> bool:
    """Return whether a column (T,) goes on as ``times`` (T,) do."""
    if len(values) < FEWEST or not np.isfinite(values).all() or not np.isfinite(times).all():
        return False
    since = values.astype(np.float64) - float(values[0])
    span = float(np.ptp(since))
    if span == 0 or (np.diff(since) < 0).any():
        return False
    centred = times - times.mean()
    slope, offset = np.polyfit(centred, since, 1)
    return float(np.abs(since - offset - slope * centred).max()) <= STRAIGHT * span


def wrap_period(values: NDArray[Any], unit: str) -> float:
    """Return the turn of a column (T,) that holds an angle which turns over, 360 or 2π; else 0."""
    turns = [360.0, TAU]
    if unit:
        turns = [TURN[unit]] if unit in TURN else []
    for turn in turns:
        if _turns_over(finite(values), turn):
            return turn
    return 0.0


def _turns_over(angle: Floats, turn: float) -> bool:
    """Return whether an angle (T,) jumps by a turn from one end of it to the other."""
    if len(angle) < FEWEST or np.ptp(angle) > 1.01 * turn or len(np.unique(angle)) <= FEWEST:
        return False
    steps = np.diff(angle)
    if not (np.abs(steps) > 0.6 * turn).any():
        return False
    low = 0.0
    if angle.min() < -0.05 * turn:
        low = -turn / 2
    reaches_ends = angle.min() - low < 0.1 * turn and low + turn - angle.max() < 0.1 * turn
    between_turns = np.abs(steps - turn * np.rint(steps / turn))
    return bool(reaches_ends and (between_turns < 0.25 * turn).all())


def missing_value_sentinel(values: NDArray[Any]) -> float:
    """Return the number that stands for missing data in a column (T,), such as -99999; else NaN.

    A small one must stand in single rows: a sense that rests at a stop does so for long.
    """
    numbers = finite(values)
    if not len(numbers):
        return math.nan
    for sentinel in (float(numbers.min()), float(numbers.max())):
        others = numbers[numbers != sentinel]
        count = len(numbers) - len(others)
        if not 2 <= count <= MOST_SENTINELS * len(values):
            continue
        spread = float(np.ptp(others))
        if spread == 0 or np.abs(others - sentinel).min() <= SENTINEL_APART * spread:
            continue
        alone = np.mean(np.diff(np.flatnonzero(values == sentinel)) > 1) >= SINGLE
        if abs(sentinel) >= LEAST_SENTINEL or (count >= FEWEST and alone):
            return sentinel
    return math.nan
