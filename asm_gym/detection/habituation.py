"""Habituation: how much surprise is usual in a context, learned so that what is usual need not alarm.

    log ŝ_t = min(max(w c_t + b, l), h)          Δw ∝ (τ - [log s_t < w c_t + b]) c_tᵀ

A hand that meets an object is often wrong about when; one that moves freely hardly ever is. ŝ is the surprise that a
share τ of nominal steps in a context like this one stays below. The rule is local, and follows the gradient of the
quantile loss.

What a fault does to the context must not excuse the fault: l and h are how far nominal episodes went.

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
"""Batches learned from, and passes over the steps, at most: a context has more numbers than few episodes tell of."""

FEWEST = 40
BATCH = 512
RATE = 1e-2

STEPS_PER_NUMBER = 8
"""With fewer nominal steps than that for each number of a context, nothing is learned of what is usual in it."""

EXTREME = 0.005
"""Share of nominal steps beyond l, and beyond h."""


class Habituation(NamedTuple):
    """What is usual in a context."""

    weights: NDArray[np.float64]  # (C + 1,) w, then b
    span: NDArray[np.float64]  # (2,) l and h


def usual_levels(contexts: Sequence[Array], levels: Sequence[Array], rng: np.random.Generator) -> Habituation:
    """From nominal episodes.

    Args:
        contexts: (T, C) each.
        levels: (T,) log s.
    """
    context, level = np.concatenate(contexts), np.concatenate(levels)
    w, _ = np.split(habituate(context, level, rng), [-1])
    drive = context @ w
    low, high = np.quantile(drive, (EXTREME, 1.0 - EXTREME))
    b = np.quantile(level - np.clip(drive, low, high), USUAL)
    return Habituation(np.append(w, b).astype(np.float64), np.array([low + b, high + b]))


def usual(found: Habituation, context: Array) -> NDArray[np.float64]:
    """log ŝ (N,) in contexts (N, C)."""
    level: NDArray[np.float64] = np.clip(context @ found.weights[:-1] + found.weights[-1], *found.span)
    return level


def habituate(context: Array, level: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """(C + 1,) w, then b, from N nominal steps.

    Args:
        context: (N, C).
        level: (N,) log s.
    """
    w, b = np.zeros(context.shape[1], np.float32), np.array([np.quantile(level, USUAL)], np.float32)
    rows, bias = Synapse(w), Synapse(b)
    updates = max(FEWEST, min(UPDATES, PASSES * len(level) // BATCH))
    for n, chosen in zip(range(updates), shuffled(len(level), BATCH, rng), strict=False):
        c, rate = context[chosen], cosine_decay(RATE, n / updates)
        pull = (USUAL - (level[chosen] < c @ w + b)).astype(np.float32)
        rows.learn(pull @ c / np.float32(len(chosen)), rate)
        bias.learn(pull.mean(keepdims=True), rate)
    return np.concatenate([w, b])
