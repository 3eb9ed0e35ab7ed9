"""Readout: name the skill that is running from the memory's units; nothing else depends on it.

    r_t = [f(h_t), f(μ_t)]
    p_t = softmax(W_K r_t + b_K)             ΔW_K ∝ n_k (1_k - p_t) r_tᵀ
    L_t = (1 - λ) L_{t-1} + log p_t          the named skill has the largest L

h are the units of ``association``, μ is the state of the temporal network. n_k gives rare skills as much weight as
frequent ones. L forgets, so that a change of skill is followed.

Source: Wald and Wolfowitz 1948 for adding up log likelihoods.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, inner_kernel, outward
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled

UPDATES = 6000  # batches
BATCH = 512  # rows of a batch
RATE = 1e-2  # largest step size
KEPT = np.float32(0.9)  # 1 - λ
SMALLEST = np.float32(1e-6)  # smallest p whose logarithm is taken


def certainty(units: Array, W_K: Array, b_K: Array) -> NDArray[np.float32]:
    """Return p (B, K) for firing rates (B, M)."""
    drive = units @ W_K.T + b_K
    strength = np.exp(drive - drive.max(axis=1, keepdims=True))
    return (strength / strength.sum(axis=1, keepdims=True)).astype(np.float32)


@inner_kernel
def add_up(L: Array, units: Array, state: Array, W_K: Array, b_K: Array) -> Array:
    """Return L_t (B, K) from L_{t-1}, f(h) (B, M) and f(μ) (B, H), which is not used where W_K has M columns only."""
    M = units.shape[1]
    rates = np.empty((L.shape[0], W_K.shape[1]), units.dtype)
    for n in range(L.shape[0]):
        for i in range(W_K.shape[1]):
            rates[n, i] = units[n, i] if i < M else state[n, i - M]
    drives = outward(rates, W_K)
    evidence = np.empty_like(L)
    for n in range(L.shape[0]):
        drive = drives[n]
        most = np.float32(-np.inf)
        for k in range(len(b_K)):
            drive[k] += b_K[k]
            most = max(most, drive[k])
        total = np.float32(0)
        for k in range(len(b_K)):
            drive[k] = np.exp(drive[k] - most)
            total += drive[k]
        for k in range(len(b_K)):
            evidence[n, k] = KEPT * L[n, k] + np.log(drive[k] / total + SMALLEST)
    return evidence


def learn_readout(
    rates: Callable[[NDArray[np.intp]], Array],
    skill: NDArray[np.intp],
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return W_K (K, M) and b_K (K,) learned from N rows whose ``skill`` (N,), each below ``count``, is known.

    ``rates`` returns the firing rates (B, M) of the rows of B indices, as all of them at once might not fit.
    """
    W_K = np.zeros((count, rates(np.arange(1)).shape[1]), np.float32)
    b_K = np.zeros(count, np.float32)
    weights = Synapse(W_K)
    bias = Synapse(b_K)
    frequency = np.bincount(skill, minlength=count)
    rarity = (len(skill) / (count * frequency)).astype(np.float32)  # (K,) n
    for n, rows in zip(range(UPDATES), shuffled(len(skill), BATCH, rng), strict=False):
        f = np.ascontiguousarray(rates(rows), np.float32)
        error = np.eye(count, dtype=np.float32)[skill[rows]] - certainty(f, W_K, b_K)
        error *= rarity[skill[rows], None]
        rate = cosine_decay(RATE, n / UPDATES)
        weights.learn(error.T @ f / np.float32(len(rows)), rate)
        bias.learn(error.mean(axis=0), rate)
    return W_K, b_K
