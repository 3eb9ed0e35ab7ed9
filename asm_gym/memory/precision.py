"""Precision by context: the expected variance of each error, given the hidden units.

    log σ²_t = min(max(W_S f(h_t) + b_S, l), h)          ΔW_S ∝ (ε²/σ² - 1) f(h_t)ᵀ

f(h) are the units that made the prediction, ε is its error. The rule is the gradient of the Gaussian log likelihood,
and each synapse uses only its own two ends. It is learned after the other weights, on errors of rows that they have
not learned. l and h are the limits of nominal contexts, so that a fault cannot excuse itself by an unusual context.

Source: Friston 2005 (Phil. Trans. R. Soc. B) for the maximum-likelihood precision.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, kernel, outward
from asm_gym.memory.learning import Synapse, coincidence, cosine_decay

SMALLEST, LARGEST = np.float32(-12.0), np.float32(8.0)
"""Bounds of log σ²: errors of 0.25 % of a channel's spread, and of 55 times its spread."""

EXTREME = 0.0005
"""Share of nominal rows below l, and above h."""

LARGEST_RATIO = 30.0
"""Clips ε²/σ² while learning (5.5 σ), so that one contact does not undo a thousand steps."""

PRECISION_EPOCHS = 20
BATCH = 64
BATCHES = 250
"""Largest number of batches in an epoch; with many rows the batches are larger."""

RATE = 1e-3


@kernel
def log_variance(f: Array, W_S: Array, b_S: Array, span_S: Array) -> Array:
    """Return log σ² (B, X) in the context ``f`` (B, H), within ``span_S`` (2, X)."""
    out = outward(f, W_S)
    for n in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[n, i] = min(max(out[n, i] + b_S[i], span_S[0, i]), span_S[1, i])
    return out


def unbounded(size: int) -> Array:
    """Return the widest limits (2, X) for ``size`` X."""
    return np.repeat(np.array([[SMALLEST], [LARGEST]]), size, axis=1)


def usual_span(f: Array, W_S: Array, b_S: Array) -> Array:
    """Return l and h (2, X), the limits of log σ² in nominal contexts (N, H)."""
    found: Array = np.quantile(log_variance(f, W_S, b_S, unbounded(len(b_S))), (EXTREME, 1.0 - EXTREME), axis=0)
    return found.astype(np.float32)


def precision_change(f: Array, error: Array, W_S: Array, b_S: Array) -> tuple[Array, Array]:
    """Return the change of ``W_S`` (X, H) and ``b_S`` (X,) for contexts ``f`` (B, H) and errors (B, X)."""
    excess = np.minimum(error**2 * np.exp(-log_variance(f, W_S, b_S, unbounded(len(b_S)))), np.float32(LARGEST_RATIO))
    excess -= np.float32(1.0)
    return coincidence(excess, f), excess.mean(axis=0)


def learn_precision(
    f: Array,
    error: Array,
    W_S: Array,
    b_S: Array,
    rng: np.random.Generator,
    tick: Callable[[], None] = lambda: None,
    rate: float = RATE,
) -> None:
    """Fit ``W_S`` and ``b_S`` in place to contexts ``f`` (N, H) and the errors (N, X) in them."""
    W_S[:] = 0.0
    b_S[:] = np.clip(np.log(np.mean(error**2, axis=0) + 1e-12), SMALLEST, LARGEST)
    context, bias = Synapse(W_S), Synapse(b_S)
    for epoch in range(PRECISION_EPOCHS):
        order: NDArray[np.intp] = rng.permutation(len(f))
        for rows in np.array_split(order, max(1, min(BATCHES, len(order) // BATCH))):
            change, bias_change = precision_change(f[rows], error[rows], W_S, b_S)
            context.learn(change, cosine_decay(rate, epoch / PRECISION_EPOCHS))
            bias.learn(bias_change, cosine_decay(rate, epoch / PRECISION_EPOCHS))
        tick()
