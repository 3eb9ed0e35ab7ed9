"""Readout: what skill the latent state says is running, for people to read; nothing depends on it.

    p_t = softmax(W_K c_t + b_K)          ΔW_K ∝ (1_k - p_t) c_tᵀ

c is the running mean of the states that were expected. The delta rule is local. Names come from whoever knows them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled

UPDATES = 2000
BATCH = 512
RATE = 1e-2


def certainty(context: Array, W_K: Array, b_K: Array) -> NDArray[np.float32]:
    """p (B, K) for contexts (B, C)."""
    drive = context @ W_K.T + b_K
    strength = np.exp(drive - drive.max(axis=1, keepdims=True))
    shares: NDArray[np.float32] = (strength / strength.sum(axis=1, keepdims=True)).astype(np.float32)
    return shares


def learn_readout(
    context: Array, skill: NDArray[np.intp], count: int, rng: np.random.Generator, updates: int = UPDATES
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """W_K (K, C) and b_K (K,) from N steps whose skill is known.

    Args:
        context: (N, C).
        skill: (N,) each below ``count``.
        count: K.
        updates: batches learned from.
    """
    W_K, b_K = np.zeros((count, context.shape[1]), np.float32), np.zeros(count, np.float32)
    weights, bias = Synapse(W_K), Synapse(b_K)
    for n, chosen in zip(range(updates), shuffled(len(skill), BATCH, rng), strict=False):
        c = np.ascontiguousarray(context[chosen], np.float32)
        error = np.eye(count, dtype=np.float32)[skill[chosen]] - certainty(c, W_K, b_K)
        rate = cosine_decay(RATE, n / updates)
        weights.learn(error.T @ c / np.float32(len(chosen)), rate)
        bias.learn(error.mean(axis=0), rate)
    return W_K, b_K
