"""What was commanded in a log: which columns, by their names, and whether one of them is itself feedback.

    e_t    = x_t - [x_{t-1}, …, u_{t-1}, …, 1] A                                              what no past told
    R²     = 1 - |u_t - [u_{t-1}, …, 1, e_t, e_{t-1}] B|² / |u_t - [u_{t-1}, …, 1] C|²      three rows back

by ridge regression on the first half of a log, and R² on the second. A plan knows nothing of an innovation; the output
of a controller answers it, and so it answers a push, which a memory that is told of it then takes for intended.

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
"""Under so many nobody can tell."""


def feedback(episodes: Sequence[Episode]) -> dict[str, float]:
    """R² by the label of each command that answers the senses; those under ``REACTS`` are left out."""
    spec = episodes[0].spec
    if not len(spec.motor) or sum(len(e) for e in episodes) < LEAST_ROWS:
        return {}
    whole = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    middle, width = whole.mean(axis=0), np.maximum(whole.std(axis=0), 1e-9)
    streams = [(e.stream - middle) / width for e in episodes]
    halves = [[s[: len(s) // 2] for s in streams], [s[len(s) // 2 :] for s in streams]]
    learned, tested = ([(s[:, spec.sensory], s[:, spec.motor]) for s in half if len(s) > 3 * LAGS] for half in halves)
    A = _ridge(*(np.concatenate(part) for part in zip(*(_next_row(x, u) for x, u in learned), strict=True)))
    rows = []
    for part in (learned, tested):
        answers = [_answers(x, u, A) for x, u in part]
        rows.append([np.concatenate(same) for same in zip(*answers, strict=True)])
    (plan, told, wanted), (plan_t, told_t, wanted_t) = rows
    left = ((wanted_t - plan_t @ _ridge(plan, wanted)) ** 2).sum(axis=0)
    less = ((wanted_t - told_t @ _ridge(told, wanted)) ** 2).sum(axis=0)
    share = np.where(left > 1e-9 * len(wanted_t), 1 - less / np.maximum(left, 1e-300), 0.0)
    named = [spec.labels[i] for i in spec.motor]
    return {n: float(r) for n, r in zip(named, share, strict=True) if r > REACTS}


def _next_row(x: Floats, u: Floats) -> tuple[Floats, Floats]:
    """What a row of senses is expected from (N, I), and what it is (N, X)."""
    past = [part[LAGS - k : len(part) - k] for part in (x, u) for k in range(1, LAGS + 1)]
    return np.hstack([*past, np.ones((len(x) - LAGS, 1))]), x[LAGS:]


def _answers(x: Floats, u: Floats, A: Floats) -> tuple[Floats, Floats, Floats]:
    """From what a plan (N, I) and a controller (N, I + 2 X) goes on, and how it did (N, U)."""
    inputs, now = _next_row(x, u)
    e = now - inputs @ A  # (T - LAGS, X)
    plan = inputs[1:, LAGS * x.shape[1] :]
    return plan, np.hstack([plan, e[1:], e[:-1]]), u[LAGS + 1 :]


def _ridge(inputs: Floats, wanted: Floats) -> Floats:
    gram = inputs.T @ inputs / len(inputs) + PENALTY * np.eye(inputs.shape[1])
    return np.asarray(np.linalg.solve(gram, inputs.T @ wanted / len(inputs)))
