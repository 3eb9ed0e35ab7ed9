"""A memory in little space: weights of 8 bits with a scale a row.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact

A synapse that exists keeps a k of at least 1. ``packed`` loses nothing of arrays that ``rounded`` made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BITS, SCALE, ROOT = ".bits", ".scale", ".root"
"""Ends of the names of packed arrays; shipped memories also hold covariances C = s² K Kᵀ, by a root K of 16 bits."""
WEIGHTS = "V", "U", "W_S", "W_C", "W_D", "W_F"  # of association and of the traces' network
LARGEST = 127
SCALE_BITS = 10

Arrays = dict[str, NDArray[Any]]


def rounded(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return arrays whose weights ``packed`` stores in 8 bits. Raises ValueError where a weight is not finite."""
    found: Arrays = dict(arrays)
    for name in found.keys() & set(WEIGHTS):
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{name} has weights that are not finite: fit the memory anew")
        found[name] = _weights(*_quantised(found[name]))
    return found


def packed(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the arrays as they are stored: weights in 8 bits where nothing is lost by it."""
    found: Arrays = dict(arrays)
    for name in WEIGHTS:
        if name in arrays and np.isfinite(arrays[name]).all():
            k, scale = _quantised(arrays[name])
            if _weights(k, scale).tobytes() == arrays[name].tobytes():
                del found[name]
                found |= {name + BITS: k, name + SCALE: scale}
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
            K = np.zeros((size, size))
            K[np.tril_indices(size)] = array
            found[own] = (K @ K.T) * scale**2
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
