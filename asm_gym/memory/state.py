"""What the memory carries from row to row.

Association compares each row with that of l rows before, so that l rows and those before them are kept; the state of
the temporal network is inferred anew every l rows, and carried in between. l is 1 at a control rate (``senses``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import activate
from asm_gym.memory.network import Network
from asm_gym.scaling import ScaledRows

Rows = NDArray[np.float64]


class MemoryState(NamedTuple):
    """Where the memory is, one entry a stream; a value, never changed in place."""

    hidden: NDArray[np.float32]  # (B, H) the inferred state z
    expected: NDArray[np.float32]  # (B, H) f(μ), of the state that was expected then
    before: Rows  # (B, l, D) the rows seen last, the oldest first
    earlier: Rows  # (B, l, D) those before
    steps: NDArray[np.int64]  # (B,) how many rows were seen
    skill: NDArray[np.float32]  # (B, K) L, what speaks for each skill; K is 0 where none has a name


def at_start(batch: int, hidden: int, lag: int, size: int, skills: int) -> MemoryState:
    """Before the first row, of ``size`` numbers."""
    z, rows = np.zeros((batch, hidden), np.float32), np.zeros((batch, lag, size))
    return MemoryState(z, z, rows, rows, np.zeros(batch, np.int64), np.zeros((batch, skills), np.float32))


def past(state: MemoryState, rows: Rows) -> tuple[Rows, Rows]:
    """What ``rows`` (B, D) are compared with: those l rows before, and as long before those. At first nothing moves."""
    before, earlier, lag = state.before[:, 0], state.earlier[:, 0], state.before.shape[1]
    if state.steps.min() < 2 * lag:
        before = np.where(state.steps[:, None] >= lag, before, rows)
        earlier = np.where(state.steps[:, None] >= 2 * lag, earlier, before)
    return before, earlier


def carry_on(
    network: Network, state: MemoryState, reading: ScaledRows
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """z and f(μ) (B, H) after a row, which are as they were in streams whose turn it is not."""
    due = state.steps % state.before.shape[1] == 0
    if not due.any():
        return state.hidden, state.expected
    if due.all():
        mu, z = network.follow(state.hidden, reading.commands, reading.senses, reading.seen)
        return z, activate(mu)
    hidden, expected = state.hidden.copy(), state.expected.copy()
    mu, hidden[due] = network.follow(hidden[due], reading.commands[due], reading.senses[due], reading.seen[due])
    expected[due] = activate(mu)
    return hidden, expected


def newest(rows: Rows, row: Rows) -> Rows:
    """(B, l, D) without the oldest of the rows, and with this one (B, D)."""
    return row[:, None] if rows.shape[1] == 1 else np.concatenate([rows[:, 1:], row[:, None]], axis=1)
