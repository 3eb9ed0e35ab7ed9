"""How far each number of a stream goes in healthy motion, and how often.

    R (8, D)    the quantiles ``QUANTILES`` of all healthy rows, the greatest change in a row, and, of a commanded
                target, its greatest distance from what it commands:   max_t |u_t - (s x_{t-1} + o)|

Unlike ``contact_limits.healthy_forces`` no episode is left out: a robot that stops where healthy motion went would stop
healthy motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import TARGET, ActionMeaning
from asm_gym.spec import StreamSpec

Floats = NDArray[np.floating[Any]]

QUANTILES = np.array([0.0, 0.001, 0.01, 0.99, 0.999, 1.0])
CHANGE = 6  # row of the greatest change
# Row of a target's greatest distance; 0 where the number is no target whose sense is known.
LEAD = 7


def healthy_ranges(
    streams: Sequence[Floats], spec: StreamSpec, meaning: ActionMeaning | None = None
) -> NDArray[np.float32]:
    """Return R (8, D) of healthy streams (T, D).

    Args:
        streams: of healthy episodes.
        spec: of the streams.
        meaning: of their actions, which names the sense of each target; None if unknown.
    """
    rows = np.concatenate(streams)
    changes = np.concatenate([np.abs(np.diff(stream, axis=0)) for stream in streams])
    lead = np.zeros(spec.size)
    if meaning is not None and len(meaning.means) == len(spec.motor):
        lead[spec.motor] = _greatest_lead(streams, spec, meaning)
    quantiles = np.nanquantile(rows, QUANTILES, axis=0)
    greatest_change = np.nanmax(changes, axis=0)
    return np.vstack([quantiles, greatest_change, lead]).astype(np.float32)


def _greatest_lead(
    streams: Sequence[Floats], spec: StreamSpec, meaning: ActionMeaning
) -> NDArray[np.float64]:
    """Return the greatest distance (A,) of each commanded target from its sense, a row before."""
    greatest = np.zeros(len(spec.motor))
    for stream in streams:
        sensed = np.stack([meaning.sensed_target(row) for row in stream[:-1]])
        targets = stream[1:, spec.motor]
        distance = np.abs(targets - sensed).max(axis=0)
        greatest = np.maximum(greatest, np.nan_to_num(distance))
    is_target = np.array(meaning.means) == TARGET
    return np.where(is_target, greatest, 0.0)


def share_beyond(ranges: Floats, column: int, low: float, high: float) -> float:
    """Return the share of healthy rows below ``low`` or above ``high``, by the quantiles of a column."""
    values = np.maximum.accumulate(ranges[: len(QUANTILES), column].astype(np.float64))
    below = np.interp(low, values, QUANTILES, left=0.0, right=1.0)
    up_to = np.interp(high, values, QUANTILES, left=0.0, right=1.0)
    return float(below + 1.0 - up_to)
