"""State of a monitor, and the rows that follow it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.monitor_protocol import State, Surprise
from asm_gym.monitors.stream_model import batch_of
from asm_gym.spec import StreamSpec
from asm_gym.validation import short_repr


class MonitorState(NamedTuple):
    """State of a monitor, one row a stream; a value, never changed in place."""

    model: State
    detection: State
    excuses: State = ()  # of knocks and stops
    values: State = ()  # of the monitor of values


def checked_rows(
    state: MonitorState, stream: NDArray[np.floating[Any]], spec: StreamSpec
) -> NDArray[np.float64]:
    """Return the next rows (B, D) after a state, in one piece.

    Raises:
        TypeError: the state is none of a monitor.
        ValueError: the rows are no numbers, or not as many as the state has streams.
    """
    if not isinstance(state, MonitorState):
        raise TypeError(
            f"state must be what initial_state or observe gave, got {short_repr(state)}"
        )
    try:
        rows = np.ascontiguousarray(stream, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"stream must be rows of numbers, got {short_repr(stream)}") from error
    shape = (batch_of(state), spec.size)
    if rows.shape != shape:
        spec.check_row(rows)
        raise ValueError(f"stream must have the shape {shape}, got {rows.shape}")
    return rows


def surprise_of_stream(steps: Sequence[Surprise], stream: int) -> Surprise:
    """Return the surprise over T steps of one of several streams that were observed together."""
    fields = {}
    for name in Surprise._fields:
        if getattr(steps[0], name) is not None:
            fields[name] = np.array([getattr(step, name)[stream] for step in steps])
    return Surprise(**fields)
