"""State of the memory between rows, and the row history that monitors share.

Association compares each row with the row l rows before, so l rows and the l rows before them are kept. The temporal
network takes every l-th row. At a control rate l is 1 (``asm_gym.scaling.rows_apart``).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.scaling import ScaledRows

Rows = NDArray[np.float64]

UNSURE = np.float32(0.1)
"""Weight of an error in rows l to 2l - 1: a stream that begins in mid-motion does not know its earlier changes."""


class MemoryState(NamedTuple):
    """State of B streams; a value, never changed in place."""

    traces: NDArray[np.float32]  # (B, I) c, the traces; or the state z of a settling network
    expected: NDArray[np.float32]  # (B, H) f(μ) of the last row
    before: Rows  # (B, l, D) the last rows, the oldest first
    earlier: Rows  # (B, l, D) the rows before those
    steps: NDArray[np.int64]  # (B,) rows so far
    skill: NDArray[np.float32]  # (B, K) L, evidence for each skill; K is 0 without named skills


def at_start(batch: int, network: TemporalNetwork, lag: int, size: int, skills: int) -> MemoryState:
    """Return the state before the first row, of ``size`` numbers."""
    state, rows = np.zeros((batch, network.hidden_size), np.float32), np.zeros((batch, lag, size))
    named = np.zeros((batch, skills), np.float32)
    return MemoryState(network.at_rest(batch), state, rows, rows, np.zeros(batch, np.int64), named)


class Remembers(Protocol):
    """A state with a row history."""

    @property
    def before(self) -> Rows:
        """(B, l, D) the last rows, the oldest first."""

    @property
    def earlier(self) -> Rows:
        """(B, l, D) the rows before those."""

    @property
    def steps(self) -> NDArray[np.int64]:
        """(B,) rows so far."""


def past(state: Remembers, rows: Rows) -> tuple[Rows, Rows]:
    """Return the rows l before ``rows`` (B, D), and 2l before; near the start the rows themselves: nothing moves."""
    before, earlier, lag = state.before[:, 0], state.earlier[:, 0], state.before.shape[1]
    if state.steps.min() < 2 * lag:
        before = np.where(state.steps[:, None] >= lag, before, rows)
        earlier = np.where(state.steps[:, None] >= 2 * lag, earlier, before)
    return before, earlier


def sure(steps: NDArray[np.int64], lag: int) -> NDArray[np.float32]:
    """Return the weight (B, 1) of errors after so many rows: 0 while no change is known, then ``UNSURE``, then 1."""
    return np.where(steps < lag, np.float32(0), np.where(steps < 2 * lag, UNSURE, np.float32(1)))[:, None]


def carry_on(
    network: TemporalNetwork, state: MemoryState, row: ScaledRows
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return c and f(μ) after a row; unchanged in streams where it is not an l-th row."""
    due = state.steps % state.before.shape[1] == 0
    if not due.any():
        return state.traces, state.expected
    if due.all():
        expected, traces = network.carry_on(state.traces, row.commands, row.senses, row.seen)
        return traces, expected
    traces, expected = state.traces.copy(), state.expected.copy()
    expected[due], traces[due] = network.carry_on(traces[due], row.commands[due], row.senses[due], row.seen[due])
    return traces, expected


def newest(rows: Rows, row: Rows) -> Rows:
    """Return the history (B, l, D) without its oldest row and with ``row`` (B, D) at the end."""
    return row[:, None] if rows.shape[1] == 1 else np.concatenate([rows[:, 1:], row[:, None]], axis=1)
