"""Whitening: errors of equal variance without correlation, each bounded.

    whitened   e_t = M ε_t/σ_t,   M = ((1 - λ) C + λ tr(C)/X I)^(-½),   C = E[(ε/σ)(ε/σ)ᵀ] over nominal steps
    bounded    ẽ_i = e_i / √(1 + e_i²/ν²)                               |ẽ_i| < ν, however large e_i

Sources: Kessy et al. 2018 (ZCA whitening); Lange et al. 1989 (errors weighted as under a t distribution).
"""

from __future__ import annotations

import numpy as np

from asm_gym.detection.base import Array, Floats
from asm_gym.memory.linear import check_inputs, gram


def whitening(errors: Array, shrinkage: float = 0.01) -> Floats:
    """Return the symmetric (ZCA) matrix M (X, X) that makes ``errors`` (N, X) of nominal rows white.

    Above a ``shrinkage`` λ of 0 constant channels and copies of channels are no trouble. Raises ValueError where X is
    too large.
    """
    check_inputs(errors.shape[1])
    exact = np.asarray(errors, np.float64)
    covariance = gram(exact) / len(exact)  # (X, X)
    scale = float(np.trace(covariance)) / len(covariance)
    target = (scale if scale > 0 else 1.0) * np.eye(len(covariance))
    values, vectors = np.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * target)
    matrix: Floats = (vectors / np.sqrt(values)) @ vectors.T
    return matrix


def bounded(errors: Array, bound: float) -> Floats:
    """Return the errors, none beyond ν = ``bound`` standard deviations."""
    exact = np.asarray(errors, np.float64)
    pulled: Floats = exact / np.sqrt(1.0 + (exact / bound) ** 2)
    return pulled
