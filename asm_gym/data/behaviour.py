"""Tell by its values what a column is: a counter, a second clock, an angle that turns over, a code for missing data.

counter        whole numbers that rise by one and the same step, but for lost rows and where they begin anew
second clock   max |x - (a + b t)| <= PACE range(x), and x never falls
angle          |x_i - x_{i-1} ∓ P| < P/4 at every jump, and x reaches both ends of a turn of P = 360 or 2π
code           whole numbers at an end of the range that repeat, CODE_APART ranges away from all others
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
PACE = 2e-3  # how far a second clock is off a straight line, as a share of its range
CODE_APART = 5.0  # how many ranges of all others a code for missing data is away from them
CODES_AT_MOST = 0.5  # share of rows that may hold one
LEAST_CODE = 99.0  # a code is at least so large


def known(values: NDArray[Any]) -> Floats:
    """Return the numbers of a column that are finite."""
    return np.asarray(values[np.isfinite(values)], np.float64)


def is_constant(values: NDArray[Any]) -> bool:
    """Tell whether a column holds numbers, and never moves."""
    found = known(values)
    return len(found) > 0 and bool((found == found[0]).all())


def counts(values: NDArray[Any], fewest: int = FEWEST) -> bool:
    """Tell whether a column (T,) counts: rows, messages, ticks of a controller; it may lose some, and begin anew."""
    found = known(values)
    if len(found) < fewest or len(found) < len(values) or (found != np.rint(found)).any():
        return False
    steps = np.diff(found)
    if len(rises := steps[steps != 0]) > 1 and len(rises) < len(steps) and (rises == rises[0]).all() and rises[0] > 0:
        return len(np.unique(found)) > 2  # an index, of episodes or of cycles
    usual = float(np.median(steps))
    if usual <= 0 or np.mean(steps == usual) < STEADY:
        return False
    forward = steps[steps > 0]
    anew = np.flatnonzero(steps < 0)  # it wraps, or begins again: near its least number
    return bool((forward % usual == 0).all() and (found[anew + 1] <= found.min() + usual * (FEWEST + 1)).all())


def follows(values: NDArray[Any], times: Floats) -> bool:
    """Tell whether a column (T,) is a second clock: it goes on as ``times`` (T,) do."""
    if len(values) < FEWEST or not np.isfinite(values).all() or not np.isfinite(times).all():
        return False
    since = values.astype(np.float64) - float(values[0])
    span = float(np.ptp(since))
    if not span or (np.diff(since) < 0).any():
        return False
    slope, offset = np.polyfit(times - times.mean(), since, 1)
    return float(np.abs(since - offset - slope * (times - times.mean())).max()) <= PACE * span


def turn_of(values: NDArray[Any], unit: str) -> float:
    """Return the length of a turn of a column (T,) that holds an angle which turns over, 360 or 2π; else 0."""
    found = known(values)
    for turn in [TURN[unit]] if unit in TURN else [] if unit else [360.0, TAU]:
        if len(found) < FEWEST or np.ptp(found) > 1.01 * turn:
            continue
        steps = np.diff(found)
        jumps = np.abs(steps) > 0.6 * turn
        ends = (-turn / 2, turn / 2) if found.min() < -0.05 * turn else (0.0, turn)
        reached = found.min() - ends[0] < 0.1 * turn and ends[1] - found.max() < 0.1 * turn
        smooth = np.abs(steps - turn * np.rint(steps / turn))
        if jumps.any() and reached and len(np.unique(found)) > FEWEST and (smooth < 0.25 * turn).all():
            return turn
    return 0.0


def code_of(values: NDArray[Any]) -> float:
    """Return the number that stands for missing data in a column (T,), such as -99999; NaN where there is none."""
    found = known(values)
    for code in (found.min(), found.max()) if len(found) else ():
        others = found[found != code]
        often = len(found) - len(others)
        whole = (code == np.rint(code) and abs(code) >= LEAST_CODE) or abs(code) > 1e30
        if not whole or not 2 <= often <= CODES_AT_MOST * len(values):
            continue
        if float(np.abs(others - code).min()) > CODE_APART * float(np.ptp(others)) > 0:
            return float(code)
    return math.nan
