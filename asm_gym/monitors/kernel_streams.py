"""Whole streams through the row kernel, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import one_thread_for
from asm_gym.detection.alarm_rule import JUDGED
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.monitor_state import MonitorState
from asm_gym.monitors.row_kernel import RowKernel, observe_rows, unwritten
from asm_gym.monitors.stream_model import first_of

Rows = NDArray[np.floating[Any]]


def observe_streams(
    kernel: RowKernel, state: MonitorState, streams: Sequence[Rows]
) -> list[tuple[Surprise, NDArray[np.float64]]]:
    """Return the surprise of each stream, and by what knocks and stops have divided it (T,).

    Args:
        kernel: of the memory.
        state: before the first rows.
        streams: (T, D) each, the longest first.
    """
    judged = [np.empty(len(stream), JUDGED) for stream in streams]
    attribution = [np.empty(stream.shape) for stream in streams]
    start = 0
    for stop in sorted({len(stream) for stream in streams} - {0}):
        count = sum(len(stream) >= stop for stream in streams)
        rows = np.stack([stream[start:stop] for stream in streams[:count]], axis=1)
        judged_rows = np.empty(rows.shape[:2], JUDGED)
        shares = np.empty(rows.shape)
        running = first_of(state, count)
        state = _observe_block(kernel, running, rows.astype(np.float64), judged_rows, shares)
        for n in range(count):
            judged[n][start:stop] = judged_rows[:, n]
            attribution[n][start:stop] = shares[:, n]
        start = stop

    found = []
    for own, share in zip(judged, attribution, strict=True):
        found.append((kernel.surprise(own, share), own["divisor"].copy()))
    return found


def _observe_block(
    kernel: RowKernel,
    state: MonitorState,
    rows: NDArray[np.float64],
    judged: Any,
    attribution: NDArray[np.float64],
) -> MonitorState:
    """Observe rows (T, B, D) of B streams; write ``judged`` (T, B) and ``attribution`` (T, B, D), return the state."""
    newest = unwritten(state)
    other = unwritten(state)
    bound = kernel.bound(state, newest)
    forth = kernel.bound(newest, other)
    back = kernel.bound(other, newest)
    with one_thread_for(rows.shape[1]):
        for t in range(len(rows)):
            observe_rows(bound, rows[t], judged[t], attribution[t])
            bound = back if t % 2 else forth
    return newest if len(rows) % 2 else other
