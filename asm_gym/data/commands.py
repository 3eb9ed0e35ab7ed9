"""Find commands in a log that answer the senses: the output of a controller, which holds a push already.

    e_t    = x_t - [x_{t-1}, …, u_{t-1}, …, 1] A                                              innovation of the senses
    R²     = 1 - |u_t - [u_{t-1}, …, 1, e_t, e_{t-1}] B|² / |u_t - [u_{t-1}, …, 1] C|²      three rows back

by ridge regression on the first half of a log, and R² on the second. A plan does not depend on an innovation.

Source: Granger 1969 (Econometrica), of causality in the mean, on innovations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode

Floats = NDArray[np.float64]

REACTS = 0.3
"""R² from which on a command is taken for feedback: of plans it was 0.09 at most, of controllers 0.5 and more."""

LAGS = 3
PENALTY = 1e-7
"""Of standardised inputs."""

LEAST_ROWS = 1000
"""Under so many rows nothing can be told."""


def feedback(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return R² by the label of each command that answers the senses; those under ``REACTS`` are left out."""
    spec = episodes[0].spec
    if not len(spec.motor) or sum(len(e) for e in episodes) < LEAST_ROWS:
        return {}
    whole = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    middle, width = whole.mean(axis=0), np.maximum(whole.std(axis=0), 1e-9)
    streams = [(e.stream - middle) / width for e in episodes]
    halves = [[s[: len(s) // 2] for s in streams], [s[len(s) // 2 :] for s in streams]]
    learned, tested = ([(s[:, spec.sensory], s[:, spec.motor]) for s in half if len(s) > 3 * LAGS] for half in halves)
    A = _ridge(*_stacked([_next_row(x, u) for x, u in learned]))
    plan, answer, command = _stacked([_inputs(x, u, A) for x, u in learned])
    plan_t, answer_t, command_t = _stacked([_inputs(x, u, A) for x, u in tested])
    without = ((command_t - plan_t @ _ridge(plan, command)) ** 2).sum(axis=0)
    within = ((command_t - answer_t @ _ridge(answer, command)) ** 2).sum(axis=0)
    R2 = np.where(without > 1e-9 * len(command_t), 1 - within / np.maximum(without, 1e-300), 0.0)
    return {spec.labels[i]: float(r) for i, r in zip(spec.motor, R2, strict=True) if r > REACTS}


def _stacked(parts: Sequence[tuple[Floats, ...]]) -> list[Floats]:
    return [np.concatenate(same) for same in zip(*parts, strict=True)]


def _next_row(x: Floats, u: Floats) -> tuple[Floats, Floats]:
    """What a row of senses is predicted from (N, I), and the row (N, X)."""
    past = [part[LAGS - k : len(part) - k] for part in (x, u) for k in range(1, LAGS + 1)]
    return np.hstack([*past, np.ones((len(x) - LAGS, 1))]), x[LAGS:]


def _inputs(x: Floats, u: Floats, A: Floats) -> tuple[Floats, Floats, Floats]:
    """What a plan (N, I) and a controller (N, I + 2 X) depend on, and the command (N, U)."""
    inputs, now = _next_row(x, u)
    e = now - inputs @ A  # (T - LAGS, X)
    plan = inputs[1:, LAGS * x.shape[1] :]
    return plan, np.hstack([plan, e[1:], e[:-1]]), u[LAGS + 1 :]


def _ridge(inputs: Floats, outputs: Floats) -> Floats:
    gram = inputs.T @ inputs / len(inputs) + PENALTY * np.eye(inputs.shape[1])
    return np.asarray(np.linalg.solve(gram, inputs.T @ outputs / len(inputs)))
