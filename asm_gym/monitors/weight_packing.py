"""Weights of 8 bits with a scale a row.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact

A synapse that exists keeps a k of at least 1. ``packed`` loses nothing of arrays that ``rounded`` made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Arrays

BITS = ".bits"  # ends of the names of packed arrays: k (P, Q), and s (P, 1)
SCALE = ".scale"
WEIGHTS = ("V", "U", "W_S", "W_C", "W_D", "W_F")  # of association and of the temporal network
LARGEST_K = 127
SCALE_BITS = 10
ROUNDING = 1e-9  # of a quotient that should be whole


class PackedWeights(NamedTuple):
    """Weights W = s k."""

    bits: NDArray[np.int8]  # k (P, Q)
    scale: NDArray[np.float32]  # s (P, 1)

    @classmethod
    def of(cls, W: NDArray[np.float32]) -> Self:
        """Round weights (P, Q)."""
        largest = np.abs(W).max(axis=1, keepdims=True).astype(np.float64)
        fraction, exponent = np.frexp(largest / LARGEST_K)
        whole = np.ceil(np.ldexp(fraction, SCALE_BITS) - ROUNDING)
        scale = np.ldexp(whole, exponent - SCALE_BITS).astype(np.float32)
        k = np.rint(W / np.where(scale > 0, scale, np.float32(1)))
        k = np.where((k == 0) & (W != 0), np.sign(W), k)
        return cls(bits=k.astype(np.int8), scale=scale)

    @property
    def weights(self) -> NDArray[np.float32]:
        """W (P, Q)."""
        return self.scale * self.bits.astype(np.float32)


def rounded(arrays: Arrays) -> Arrays:
    """Return arrays whose weights ``packed`` stores in 8 bits. Raises ValueError where a weight is not finite."""
    kept = dict(arrays)
    for name in WEIGHTS:
        if name not in kept:
            continue
        if not np.isfinite(kept[name]).all():
            raise ValueError(f"{name} has weights that are not finite: fit the memory anew")
        kept[name] = PackedWeights.of(kept[name]).weights
    return kept


def packed(arrays: Arrays) -> Arrays:
    """Return the arrays as they are stored: weights in 8 bits where nothing is lost by it."""
    stored = dict(arrays)
    for name in WEIGHTS:
        W = arrays.get(name)
        if W is None or not np.isfinite(W).all():
            continue
        small = PackedWeights.of(W)
        if small.weights.tobytes() == W.tobytes():
            del stored[name]
            stored[name + BITS] = small.bits
            stored[name + SCALE] = small.scale
    return stored


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return what ``packed`` was given. Raises ValueError for parts that do not fit."""
    kept: dict[str, NDArray[Any]] = {}
    for stored_name, array in arrays.items():
        name = stored_name.removesuffix(BITS)
        if stored_name != name:
            scale = arrays.get(name + SCALE, np.zeros(0))
            if array.dtype != np.int8 or array.ndim != 2 or scale.shape != (len(array), 1):
                raise ValueError(
                    f"{name} of 8 bits should have a scale for each of its rows, got {scale.shape}"
                )
            kept[name] = PackedWeights(array, scale).weights
        elif not name.endswith(SCALE):
            kept[name] = array
    return kept
