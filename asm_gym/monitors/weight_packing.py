"""A memory in little space: weights of 8 bits, covariances by a root of 16, symmetric matrices by one half.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact
    C    = s² K Kᵀ,    K of 16 bits, with zeros above its diagonal; s a power of 2, so that the product is exact, too

A synapse that exists keeps a k of at least 1. ``rounded`` makes a memory such, and keeps 16 bits of other large arrays;
then nothing is lost by packing it, and a monitor that was calibrated so is the same when it is read. The bytes of a
number lie apart, first those that differ least, so that a wheel takes less of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BITS, SCALE, HALF, ROOT, PLANES = ".bits", ".scale", ".half", ".root", ".planes"
"""Ends of the names of what is packed."""

WEIGHTS = "V", "U", "W_S", "W_C", "W_D", "W_F"
"""Of association and of the traces' network."""

COVARIANCES = "completion_covariance", "moments"
"""What is solved with them is wrong by as much as their smallest directions are, which a root keeps."""

SHORTENED = "D", "whitening"
"""Of which ``SHORT`` bits are kept. What is linear in closed form cancels, and would not stand 8."""

MOST = 127
FINE = 10
"""Bits of a scale."""

SHORT = 16
FAINT = 1e-6
"""A direction that no row ever went is taken to have this share of the mean variance."""

APART = "f4", "f8", "i2"
WORTH = 512
"""Smaller arrays are left as they are [bytes]."""

Found = dict[str, NDArray[Any]]


def rounded(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """The same in fewer bits. Raises ValueError where a weight is not finite, for which no integer stands."""
    found: Found = {}
    for name, array in arrays.items():
        if name in WEIGHTS and not np.isfinite(array).all():
            raise ValueError(
                f"{name} has weights that are not finite, for which no integer stands: fit the memory anew"
            )
        if _is_weight(name, array):
            found[name] = _of(*_split(array))
        elif name in COVARIANCES and np.trace(array) > 0 and _root_of(name, array) is None:
            found[name] = _square(*_root(array + FAINT * np.trace(array) / len(array) * np.eye(len(array))))
        elif name in SHORTENED:
            found[name] = _short((array + array.T) / 2 if name == "whitening" else array)
        else:
            found[name] = array
    return found


def packed(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """The same in less space, as far as nothing is lost."""
    found: Found = {}
    for name, array in arrays.items():
        if _is_weight(name, array) and _of(*(parts := _split(array))).tobytes() == array.tobytes():
            found |= {name + BITS: parts[0], name + SCALE: parts[1]}
        elif _is_symmetric(array):
            low, root = np.tril_indices(len(array)), _root_of(name, array)
            found |= {name + HALF: array[low]} if root is None else {name + ROOT: root[0][low], name + SCALE: root[1]}
        else:
            found[name] = array
    return dict(_apart(*item) for item in found.items())


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> Found:
    """What ``packed`` was given. Raises ValueError where parts do not fit together."""
    parts = dict(_together(*item) for item in arrays.items())
    found: Found = {}
    for name, array in parts.items():
        own, dot, last = name.rpartition(".")
        end = dot + last  # a name without a dot is no part of anything
        scale = parts.get(own + SCALE, np.zeros(0))
        if end == BITS:
            if array.dtype != np.int8 or array.ndim != 2 or scale.shape != (len(array), 1):
                raise ValueError(f"{own} of 8 bits should have a scale for each of its rows, got {scale.shape}")
            found[own] = _of(array, scale)
        elif end in (HALF, ROOT):
            size = round((np.sqrt(8 * array.size + 1) - 1) / 2)
            if array.ndim != 1 or size * (size + 1) // 2 != array.size:
                raise ValueError(f"{array.size} numbers are no half of a symmetric {own}")
            whole = np.zeros((size, size), array.dtype)
            whole[np.tril_indices(size)] = array
            if end == ROOT:
                if array.dtype != np.int16 or scale.shape != ():
                    raise ValueError(f"the root of {own} should be of 16 bits with one scale, got {array.dtype}")
                found[own] = _square(whole, scale)
            else:
                whole.T[np.tril_indices(size)] = array
                found[own] = whole
        elif end != SCALE:
            found[name] = array
    return found


def _is_weight(name: str, array: NDArray[Any]) -> bool:
    fits = name in WEIGHTS and array.ndim == 2 and array.size > 0 and array.dtype == np.float32
    return fits and bool(np.isfinite(array).all())


def _is_symmetric(array: NDArray[Any]) -> bool:
    square = array.ndim == 2 and array.shape[0] == array.shape[1] > 1
    return square and array.tobytes() == array.T.tobytes()


def _split(W: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """k (P, Q) and s (P, 1)."""
    fraction, exponent = np.frexp(np.abs(W).max(axis=1, keepdims=True).astype(np.float64) / MOST)
    scale = np.ldexp(np.ceil(np.ldexp(fraction, FINE) - 1e-9), exponent - FINE).astype(np.float32)
    k = np.rint(W / np.where(scale > 0, scale, np.float32(1)))
    return np.where((k == 0) & (W != 0), np.sign(W), k).astype(np.int8), scale


def _of(bits: NDArray[np.int8], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    return scale * bits.astype(np.float32)


def _root(C: NDArray[np.floating[Any]]) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """K (N, N) and s, of a positive definite C."""
    L = np.linalg.cholesky(np.asarray(C, np.float64))
    scale = np.exp2(np.ceil(np.log2(np.abs(L).max())) - 15)
    K = np.clip(np.rint(L / scale), -32767, 32767)
    np.fill_diagonal(K, np.maximum(np.diag(K), 1))
    return K.astype(np.int16), np.asarray(scale)


def _square(K: NDArray[np.int16], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """C (N, N), whichever way its sums are formed: they are of whole numbers below 2⁵³."""
    exact = K.astype(np.float64)
    C: NDArray[np.float64] = (exact @ exact.T) * scale**2
    return C


def _root_of(name: str, C: NDArray[Any]) -> tuple[NDArray[np.int16], NDArray[np.float64]] | None:
    """The root that ``rounded`` has given C; None where it gave none."""
    if name not in COVARIANCES or C.dtype != np.float64:
        return None
    try:
        found = _root(C)
    except np.linalg.LinAlgError:
        return None
    return found if np.array_equal(_square(*found), C) else None


def _short(array: NDArray[Any]) -> NDArray[Any]:
    fraction, exponent = np.frexp(array)
    rounded: NDArray[Any] = np.ldexp(np.rint(np.ldexp(fraction, SHORT)), exponent - SHORT)
    return rounded


def _apart(name: str, array: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    """Bytes (itemsize, …) of a large array of numbers; of another layout than C's it would not come back the same."""
    if array.nbytes < WORTH or array.dtype.str[1:] not in APART or not array.flags.c_contiguous:
        return name, array
    planes = np.moveaxis(array.view(np.uint8).reshape(*array.shape, array.itemsize), -1, 0)
    return f"{name}{PLANES}{array.dtype.str[1:]}", np.ascontiguousarray(planes)


def _together(name: str, array: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    own, mark, kind = name.rpartition(PLANES)
    if not mark:
        return name, array
    if kind not in APART or array.dtype != np.uint8 or array.ndim < 2 or len(array) != int(kind[1]):
        raise ValueError(f"{own} should lie apart by the bytes of its numbers, got {array.dtype} {array.shape}")
    return own, np.ascontiguousarray(np.moveaxis(array, 0, -1)).view(f"<{kind}")[..., 0]
