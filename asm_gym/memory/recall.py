"""Recall: express a skill from a cue, with the senses or from memory alone.

    online    every row is predicted, then read; a missing sense is inferred from the rest of the row
    offline   the predictions stand in for the senses and the actions

Sources: Tang, Barron and Bogacz 2023 (NeurIPS) for online and offline recall by temporal predictive coding; Mahajan et
al. 2025 (Neural Computation 38(1)) for skills.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.temporal import Step, TemporalNetwork
from asm_gym.scaling import StreamScaler
from asm_gym.validation import check_number

MOST_STEPS = 1_000_000  # largest number of rows recalled at once


class Recalled(NamedTuple):
    """Predictions of T rows of B streams; standardised, float32."""

    senses: Array  # (T, B, S) x̂_t, before x_t was sensed
    commands: Array  # (T, B, A) â_t, before a_t was commanded
    carried: Array  # (B, I) c_T, to carry on with


def follow(network: TemporalNetwork, c: Array, senses: Array, commands: Array) -> Recalled:
    """Recall online from ``c`` (B, I), with senses (T, B, S), NaN where missing, and commands and 1 (T, B, A + 1)."""
    steps = []
    for x, u in zip(senses, commands, strict=True):
        seen = np.isfinite(x)
        known = np.where(seen, x, np.float32(0))
        step = network.follow(c, u, known, seen.astype(np.float32))
        steps.append(step)
        c = step.carried
    return _stacked(steps, network)


def run_on(network: TemporalNetwork, c: Array, steps: int) -> Recalled:
    """Recall ``steps`` rows offline from the carried state ``c`` (B, I)."""
    recalled = []
    for _ in range(steps):
        step = network.run_on(c)
        recalled.append(step)
        c = step.carried
    return _stacked(recalled, network)


def to_rows(reader: StreamScaler, recalled: Recalled) -> NDArray[np.float64]:
    """Return the predictions (T, B, D) in the units of the stream."""
    T, B, _ = recalled.senses.shape
    spec = reader.spec
    standard = np.zeros((T, B, spec.size))
    standard[:, :, spec.sensory] = recalled.senses[:, :, : len(spec.sensory)]
    standard[:, :, spec.commanded] = recalled.commands
    return reader.mean + reader.spread * standard


def continued(
    network: TemporalNetwork, reader: StreamScaler, cue: NDArray[np.floating[Any]], steps: int
) -> NDArray[np.float64]:
    """Return the (steps, D) rows after a cue (T, D), in the units of the stream. Raises as ``check_cue`` does."""
    rows = check_cue(reader, cue, steps)
    lag = reader.lag
    # Every l-th row follows from those l before: l interleaved streams, recalled side by side.
    reading = reader.read_episode(rows[len(rows) % lag :])
    senses = reading.senses.reshape(-1, lag, reading.senses.shape[1])
    commands = reading.commands.reshape(-1, lag, reading.commands.shape[1])
    cued = follow(network, network.at_rest(lag), senses, commands)
    recalled = run_on(network, cued.carried, -(-steps // lag))
    return to_rows(reader, recalled).reshape(-1, reader.spec.size)[:steps]


def check_cue(
    reader: StreamScaler, cue: NDArray[np.floating[Any]], steps: int
) -> NDArray[np.float64]:
    """Return the cue (T, D) as floats. Raises ValueError unless ``steps`` rows can be recalled from it."""
    check_number("steps", steps, low=1, high=MOST_STEPS, whole=True)
    rows = np.asarray(cue, np.float64)
    least = 2 * reader.lag
    if rows.ndim != 2:
        raise ValueError(f"a cue has the shape (T, {reader.spec.size}), got {rows.shape}")
    reader.spec.check_row(rows)
    if len(rows) < least:
        raise ValueError(f"a cue needs at least {least} rows to contain motion, got {len(rows)}")
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        row, column = bad[0]
        raise ValueError(
            f"cue row {row}, {reader.spec.labels[column]} must be finite, got {rows[row, column]}"
        )
    return rows


def _stacked(steps: Sequence[Step], network: TemporalNetwork) -> Recalled:
    expected = np.stack([s.expected for s in steps])
    S = expected.shape[2] - network.motor
    return Recalled(expected[:, :, :S], expected[:, :, S:], steps[-1].carried)
