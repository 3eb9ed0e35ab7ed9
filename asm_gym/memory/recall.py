"""Recall: a skill is expressed from a cue, along with the senses or from memory alone.

    h_t = W_H f(z_{t-1}) + b_U,   â_t = W_A f(h_t)                        the action that belongs to the state
    online    μ_t = h_t + W_U a_t,   x̂_t = W_F f(μ_t) + b_F,   z_t inferred from the true x_t
    offline   μ_t = h_t + W_U â_t,   x̂_t = W_F f(μ_t) + b_F,   z_t = μ_t

Offline the predictions stand in for what is not sensed. An x̂_t that is fed back is what μ_t predicts, so that its error
is 0 and inference leaves the state where it is: z_t = μ_t is the fixed point, not a short cut.

Sources: Tang, Barron and Bogacz 2023 (NeurIPS) for online and offline recall by temporal predictive coding; Mahajan et
al. 2025 (Neural Computation 38(1)) for skills.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, outward
from asm_gym.memory.inference import motor_prediction, sense
from asm_gym.memory.network import Network
from asm_gym.scaling import StreamScaler


class Recalled(NamedTuple):
    """What was expected of T steps of B streams; standardised, float32."""

    senses: Array  # (T, B, S) x̂_t, expected before x_t was sensed
    commands: Array  # (T, B, A) â_t, expected before a_t was commanded
    hidden: Array  # (T, B, H) z_t, the state carried on


def at_rest(network: Network, batch: int) -> Array:
    """The state (B, H) before the first row."""
    return np.zeros((batch, network.hidden_size), np.float32)


def follow(network: Network, z: Array, senses: Array, commands: Array) -> Recalled:
    """Online recall: every row is expected, then sensed.

    Args:
        z: (B, H) the state before the first row.
        senses: (T, B, S) as a ``ScaledRows`` has them; not a number where unseen.
        commands: (T, B, A + 1), the last one a constant 1.
    """
    w, steps = network.weights, []
    for x, u in zip(senses, commands, strict=True):
        seen = np.isfinite(x)
        _, action = motor_prediction(z, w)
        mu, z = network.follow(z, u, np.where(seen, x, np.float32(0)), seen.astype(np.float32))
        steps.append((sense(mu, w.W_F, w.b_F), action, z))
    return _stacked(steps)


def run_on(network: Network, z: Array, steps: int) -> Recalled:
    """Offline recall: ``steps`` rows from the state ``z`` (B, H) on, each from what was expected of the one before."""
    w, made = network.weights, []
    for _ in range(steps):
        h, action = motor_prediction(z, w)
        z = h + outward(action, np.ascontiguousarray(w.W_U[:, :-1]))
        made.append((sense(z, w.W_F, w.b_F), action, z))
    return _stacked(made)


def to_rows(reader: StreamScaler, recalled: Recalled) -> NDArray[np.float64]:
    """What was expected, (T, B, D) in the units of the stream."""
    T, B, _ = recalled.senses.shape
    sensory, motor = reader.spec.sensory, reader.spec.motor
    standard = np.zeros((T, B, reader.spec.size))
    standard[:, :, sensory] = recalled.senses[:, :, : len(sensory)]
    standard[:, :, motor] = recalled.commands
    rows: NDArray[np.float64] = reader.mean + reader.spread * standard
    return rows


def continued(
    network: Network, reader: StreamScaler, cue: NDArray[np.floating[Any]], steps: int
) -> NDArray[np.float64]:
    """(steps, D) rows that come after a cue (T, D), in the units of the stream. Raises as ``check_cue`` does."""
    rows, lag = check_cue(reader, cue, steps), reader.lag
    # Every l-th row follows from those l apart: as many threads of rows, recalled side by side.
    reading = reader.read_episode(rows[len(rows) % lag :])
    senses, commands = (x.reshape(-1, lag, x.shape[1]) for x in (reading.senses, reading.commands))
    cued = follow(network, at_rest(network, lag), senses, commands)
    recalled = to_rows(reader, run_on(network, cued.hidden[-1], -(-steps // lag)))
    return recalled.reshape(-1, reader.spec.size)[:steps]


def check_cue(reader: StreamScaler, cue: NDArray[np.floating[Any]], steps: int) -> NDArray[np.float64]:
    """The cue (T, D) to recall ``steps`` rows from. Raises ValueError unless it can be recalled from."""
    rows, least = np.asarray(cue, np.float64), 2 * reader.lag
    if rows.ndim != 2:
        raise ValueError(f"a cue has the shape (T, {reader.spec.size}), got {rows.shape}")
    reader.spec.check_row(rows)
    if len(rows) < least:
        raise ValueError(f"a cue must be at least {least} rows long, or nothing in it moves, got {len(rows)}")
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        row, column = bad[0]
        raise ValueError(f"cue row {row}, {reader.spec.labels[column]} must be finite, got {rows[row, column]}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    return rows


def _stacked(steps: list[tuple[Array, Array, Array]]) -> Recalled:
    return Recalled(*(np.stack(parts) for parts in zip(*steps, strict=True)))
