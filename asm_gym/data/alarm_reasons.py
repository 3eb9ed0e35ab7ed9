"""Why a row is an alarm, and which of its numbers the alarm points to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Row = NDArray[np.floating[Any]]  # (D,)

SURPRISING = "surprise"
MISSING_DATA = "missing data"
NOT_FINITE = "not finite"
LATE = "late"

MOST_SHOWN = 1000.0  # thresholds, above which a number tells a reader nothing more


def thresholds_shown(excess: float) -> str:
    """Return surprise in thresholds as a reader sees it; ``inf`` for missing numbers."""
    if MOST_SHOWN < excess < math.inf:
        return f"> {MOST_SHOWN:.0f}"
    return f"{excess:.2f}"


def reason(row: Row) -> str:
    """Return why a row (D,) whose surprise is over the threshold is an alarm."""
    if np.isnan(row).any():
        return MISSING_DATA
    if np.isfinite(row).all():
        return SURPRISING
    return NOT_FINITE


def blamed(row: Row, shares: Row) -> int | None:
    """Return the number of a row (D,) that an alarm points to, by their shares (D,); None if all miss."""
    if np.isnan(row).all():
        return None
    broken = ~np.isfinite(row)
    if broken.any():
        return int(np.argmax(broken))
    return int(np.argmax(shares))
