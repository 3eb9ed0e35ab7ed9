"""Habituation: surprise relative to what is usual in a context.

    log ŝ_t = min(max(w c_t + b, l), h)          Δw ∝ (τ - [log s_t < w c_t + b]) c_tᵀ

A hand that meets an object is often wrong about when; one that moves freely hardly ever is. ŝ is the surprise below
which a share τ of nominal rows in such a context stays. The rule is local, and is the gradient of the quantile loss.
l and h are the limits of nominal episodes, so that a fault cannot excuse itself by changing the context.

Sources: Yu and Dayan 2005 (Neuron 46(4)) for surprise relative to expected uncertainty; Koenker and Bassett 1978 for
the quantile loss; Romano et al. 2019 (NeurIPS) for quantiles of a context under a conformal threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled

USUAL = 0.95
"""τ."""

UPDATES, PASSES = 1000, 12
"""Largest number of batches, and of passes over the rows."""

FEWEST = 40
"""Smallest number of batches."""

BATCH = 512
RATE = 1e-2

STEPS_PER_NUMBER = 8
"""With fewer nominal rows for each number of a context, nothing is learned."""

EXTREME = 0.005
"""Share of nominal rows below l, and above h."""


class Habituation(NamedTuple):
    """What is usual in a context."""

    weights: NDArray[np.float64]  # (C + 1,) w, then b
    span: NDArray[np.float64]  # (2,) l and h


def usual_levels(contexts: Sequence[Array], levels: Sequence[Array], rng: np.random.Generator) -> Habituation:
    """Learn from nominal episodes.

    Args:
        contexts: (T, C) of each.
        levels: (T,) log s of each.
        rng: draws the order of rows.
    """
    context, level = np.concatenate(contexts), np.concatenate(levels)
    w, _ = np.split(habituate(context, level, rng), [-1])
    drive = context @ w
    low, high = np.quantile(drive, (EXTREME, 1.0 - EXTREME))
    b = np.quantile(level - np.clip(drive, low, high), USUAL)
    return Habituation(np.append(w, b).astype(np.float64), np.array([low + b, high + b]))


def habituate(context: Array, level: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return w, then b (C + 1,), from contexts (N, C) and log s (N,) of nominal rows."""
    w, b = np.zeros(context.shape[1], np.float32), np.array([np.quantile(level, USUAL)], np.float32)
    weights, bias = Synapse(w), Synapse(b)
    updates = max(FEWEST, min(UPDATES, PASSES * len(level) // BATCH))
    for n, rows in zip(range(updates), shuffled(len(level), BATCH, rng), strict=False):
        c, rate = context[rows], cosine_decay(RATE, n / updates)
        pull = (USUAL - (level[rows] < c @ w + b)).astype(np.float32)
        weights.learn(pull @ c / np.float32(len(rows)), rate)
        bias.learn(pull.mean(keepdims=True), rate)
    return np.concatenate([w, b])
