"""Weights in 8 bits, and symmetric matrices by one half: what a shipped memory is kept in.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact

A synapse that exists keeps a k of at least 1. ``rounded`` makes weights such; then nothing is lost by packing them, and
a monitor that was calibrated so is the same when it is read. Nothing else is packed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BITS, SCALE, HALF = ".bits", ".scale", ".half"
"""Ends of the names of what is packed."""

WEIGHTS = "V", "U", "W_S", "W_C", "W_D", "W_F"
"""Of association and of the traces' network. What is linear in closed form cancels, and is kept as it is."""

MOST = 127
FINE = 10
"""Bits of a scale."""

Found = dict[str, NDArray[Any]]


def rounded(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """The same, whose weights are of 8 bits."""
    return {n: _of(*_split(a)) if _is_weight(n, a) else a for n, a in arrays.items()}


def packed(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """The same in less space, as far as nothing is lost."""
    found: Found = {}
    for name, array in arrays.items():
        if _is_weight(name, array) and _of(*(parts := _split(array))).tobytes() == array.tobytes():
            found |= {name + BITS: parts[0], name + SCALE: parts[1]}
        elif (
            array.ndim == 2
            and len(array) > 1
            and array.shape[0] == array.shape[1]
            and array.tobytes() == array.T.tobytes()
        ):
            found[name + HALF] = array[np.tril_indices(len(array))]
        else:
            found[name] = array
    return found


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """What ``packed`` was given. Raises ValueError where parts do not fit together."""
    found: Found = {}
    for name, array in arrays.items():
        own = name.rpartition(".")[0]
        if name.endswith(BITS):
            scale = arrays.get(own + SCALE, np.zeros(0))
            if array.dtype != np.int8 or array.ndim != 2 or scale.shape != (len(array), 1):
                raise ValueError(f"{own} of 8 bits should have a scale for each of its rows, got {scale.shape}")
            found[own] = _of(array, scale)
        elif name.endswith(HALF):
            size = round((np.sqrt(8 * array.size + 1) - 1) / 2)
            if array.ndim != 1 or size * (size + 1) // 2 != array.size:
                raise ValueError(f"{array.size} numbers are no half of a symmetric {own}")
            found[own] = np.zeros((size, size), array.dtype)
            found[own][np.tril_indices(size)] = array
            found[own].T[np.tril_indices(size)] = array
        elif not name.endswith(SCALE):
            found[name] = array
    return found


def _is_weight(name: str, array: NDArray[Any]) -> bool:
    return name in WEIGHTS and array.ndim == 2 and array.size > 0 and array.dtype == np.float32


def _split(W: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """k (P, Q) and s (P, 1)."""
    fraction, exponent = np.frexp(np.abs(W).max(axis=1, keepdims=True).astype(np.float64) / MOST)
    scale = np.ldexp(np.ceil(np.ldexp(fraction, FINE) - 1e-9), exponent - FINE).astype(np.float32)
    k = np.rint(W / np.where(scale > 0, scale, np.float32(1)))
    return np.where((k == 0) & (W != 0), np.sign(W), k).astype(np.int8), scale


def _of(bits: NDArray[np.int8], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    return scale * bits.astype(np.float32)
