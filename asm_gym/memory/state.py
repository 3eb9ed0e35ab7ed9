"""What the memory carries from row to row.

Association compares each row with that of l rows before, so that l rows and those before them are kept; the temporal
network takes up every l-th row. l is 1 at a control rate (``senses``).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.scaling import ScaledRows

Rows = NDArray[np.float64]

UNSURE = np.float32(0.1)
"""What an error counts of itself in the first rows that something came before, but nothing before that: whoever begins
in mid-motion does not know how it moved, and is wrong."""


class MemoryState(NamedTuple):
    """Where the memory is, one entry a stream; a value, never changed in place."""

    traces: NDArray[np.float32]  # (B, I) c, of what was sensed and done; or the state z that settled on it
    expected: NDArray[np.float32]  # (B, H) f(μ), of the state that was expected then
    before: Rows  # (B, l, D) the rows seen last, the oldest first
    earlier: Rows  # (B, l, D) those before
    steps: NDArray[np.int64]  # (B,) how many rows were seen
    skill: NDArray[np.float32]  # (B, K) L, what speaks for each skill; K is 0 where none has a name


def at_start(batch: int, network: TemporalNetwork, lag: int, size: int, skills: int) -> MemoryState:
    """Before the first row, of ``size`` numbers."""
    state, rows = np.zeros((batch, network.hidden_size), np.float32), np.zeros((batch, lag, size))
    named = np.zeros((batch, skills), np.float32)
    return MemoryState(network.at_rest(batch), state, rows, rows, np.zeros(batch, np.int64), named)


class Remembers(Protocol):
    """Any state that holds the rows before."""

    @property
    def before(self) -> Rows:
        """(B, l, D) the rows seen last, the oldest first."""

    @property
    def earlier(self) -> Rows:
        """(B, l, D) those before."""

    @property
    def steps(self) -> NDArray[np.int64]:
        """(B,) how many rows were seen."""


def past(state: Remembers, rows: Rows) -> tuple[Rows, Rows]:
    """What ``rows`` (B, D) are compared with: those l rows before, and as long before those. At first nothing moves."""
    before, earlier, lag = state.before[:, 0], state.earlier[:, 0], state.before.shape[1]
    if state.steps.min() < 2 * lag:
        before = np.where(state.steps[:, None] >= lag, before, rows)
        earlier = np.where(state.steps[:, None] >= 2 * lag, earlier, before)
    return before, earlier


def sure(steps: NDArray[np.int64], lag: int) -> NDArray[np.float32]:
    """(B, 1) what errors count of themselves after so many rows: nothing while no change is known."""
    return np.where(steps < lag, np.float32(0), np.where(steps < 2 * lag, UNSURE, np.float32(1)))[:, None]


def carry_on(
    network: TemporalNetwork, state: MemoryState, row: ScaledRows
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """c and f(μ) after a row, which are as they were in streams whose turn it is not."""
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
    """(B, l, D) without the oldest of the rows, and with this one (B, D)."""
    return row[:, None] if rows.shape[1] == 1 else np.concatenate([rows[:, 1:], row[:, None]], axis=1)
