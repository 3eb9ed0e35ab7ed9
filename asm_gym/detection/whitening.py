"""Whitening: errors of equal variance without correlation, each bounded.

    whitened   e_t = M ε_t/σ_t,   M = ((1 - λ) C + λ tr(C)/X I)^(-½),   C = E[(ε/σ)(ε/σ)ᵀ] over nominal steps
    bounded    ẽ_i = e_i / √(1 + e_i²/ν²)                               |ẽ_i| < ν, however large e_i

Sources: Kessy et al. 2018 (ZCA whitening); Lange et al. 1989 (errors weighted as under a t distribution).
"""

from __future__ import annotations

import numpy as np

from asm_gym.detection.base import Array, Floats
from asm_gym.memory.linear import gram

MOST_ERRORS = 8192  # their covariance takes 0.5 GiB, and its eigenvectors minutes


def whitening(errors: Array, shrinkage: float = 0.01) -> Floats:
    """Return the symmetric (ZCA) matrix M (X, X) that makes ``errors`` (N, X) white and turns them least.

    Args:
        errors: normalised errors of nominal rows, of mean 0.
        shrinkage: λ in [0, 1]. Above 0 constant channels and copies of channels are no trouble.

    Raises:
        ValueError: too many errors, or shrinkage out of range.
    """
    if errors.shape[1] > MOST_ERRORS:
        raise ValueError(
            f"every error is weighed against every other in whitening, at most {MOST_ERRORS} of them, but this stream "
            f"makes {errors.shape[1]}: leave channels out, or reduce them before"
        )
    if not 0.0 <= shrinkage <= 1.0:
        raise ValueError(f"shrinkage must be in [0, 1], got {shrinkage}")
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
