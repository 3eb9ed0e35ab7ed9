"""A memory in little space: weights of 8 bits with a scale a row, covariances by a root of 16 bits.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact
    C    = s² K Kᵀ,    K of 16 bits, with zeros above its diagonal; s a power of 2, so that the product is exact, too

A synapse that exists keeps a k of at least 1. ``rounded`` makes such arrays, of which ``packed`` loses nothing, so that
a memory that was calibrated after rounding is the same when it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BITS, SCALE, ROOT = ".bits", ".scale", ".root"
"""Ends of the names of packed arrays."""

WEIGHTS = "V", "U", "W_S", "W_C", "W_D", "W_F"
"""Of association and of the traces' network."""

COVARIANCES = "completion_covariance", "moments"
"""A root keeps their smallest directions, on which solutions with them depend."""

LARGEST = 127
SCALE_BITS = 10
FAINT = 1e-6
"""Share of the mean variance that a direction without any is given."""

Arrays = dict[str, NDArray[Any]]


def rounded(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return arrays that ``packed`` stores without loss. Raises ValueError where a weight is not finite."""
    found: Arrays = dict(arrays)
    for name in found.keys() & set(WEIGHTS):
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{name} has weights that are not finite: fit the memory anew")
        found[name] = _weights(*_quantised(found[name]))
    for name in found.keys() & set(COVARIANCES):
        C = found[name]
        if np.trace(C) > 0 and _exact_root(C) is None:
            found[name] = _squared(*_root(C + FAINT * np.trace(C) / len(C) * np.eye(len(C))))
    return found


def packed(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the arrays as they are stored: weights and covariances in fewer bits, where nothing is lost by it."""
    found: Arrays = {}
    for name, array in arrays.items():
        if name in WEIGHTS and np.isfinite(array).all():
            k, scale = _quantised(array)
            if _weights(k, scale).tobytes() == array.tobytes():
                found |= {name + BITS: k, name + SCALE: scale}
                continue
        root = _exact_root(array) if name in COVARIANCES else None
        found |= {name: array} if root is None else {name + ROOT: root[0][np.tril_indices(len(array))]}
        found |= {} if root is None else {name + SCALE: root[1]}
    return found


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return what ``packed`` was given. Raises ValueError for parts that do not fit."""
    found: Arrays = {}
    for name, array in arrays.items():
        own = name.removesuffix(BITS).removesuffix(ROOT)
        scale = arrays.get(own + SCALE, np.zeros(0))
        if name.endswith(BITS):
            if array.dtype != np.int8 or array.ndim != 2 or scale.shape != (len(array), 1):
                raise ValueError(f"{own} of 8 bits should have a scale for each of its rows, got {scale.shape}")
            found[own] = _weights(array, scale)
        elif name.endswith(ROOT):
            size = round((np.sqrt(8 * array.size + 1) - 1) / 2)
            if array.dtype != np.int16 or scale.shape != () or array.shape != (size * (size + 1) // 2,):
                raise ValueError(f"the root of {own} should be half a matrix of 16 bits with one scale")
            K = np.zeros((size, size), np.int16)
            K[np.tril_indices(size)] = array
            found[own] = _squared(K, scale)
        elif not name.endswith(SCALE):
            found[name] = array
    return found


def _quantised(W: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Return k (P, Q) and s (P, 1)."""
    fraction, exponent = np.frexp(np.abs(W).max(axis=1, keepdims=True).astype(np.float64) / LARGEST)
    scale = np.ldexp(np.ceil(np.ldexp(fraction, SCALE_BITS) - 1e-9), exponent - SCALE_BITS).astype(np.float32)
    k = np.rint(W / np.where(scale > 0, scale, np.float32(1)))
    return np.where((k == 0) & (W != 0), np.sign(W), k).astype(np.int8), scale


def _weights(k: NDArray[np.int8], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    return scale * k.astype(np.float32)


def _root(C: NDArray[np.floating[Any]]) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Return K (N, N) and s, of a positive definite C."""
    L = np.linalg.cholesky(np.asarray(C, np.float64))
    scale = np.exp2(np.ceil(np.log2(np.abs(L).max())) - 15)
    K = np.clip(np.rint(L / scale), -32767, 32767)
    np.fill_diagonal(K, np.maximum(np.diag(K), 1))
    return K.astype(np.int16), np.asarray(scale)


def _squared(K: NDArray[np.int16], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return C (N, N), exact for any order of its sums: they are of whole numbers below 2⁵³."""
    exact = K.astype(np.float64)
    C: NDArray[np.float64] = (exact @ exact.T) * scale**2
    return C


def _exact_root(C: NDArray[Any]) -> tuple[NDArray[np.int16], NDArray[np.float64]] | None:
    """Return the root that gives C to the last bit; None where there is none."""
    try:
        found = _root(C)
    except np.linalg.LinAlgError:
        return None
    return found if C.dtype == np.float64 and np.array_equal(_squared(*found), C) else None
