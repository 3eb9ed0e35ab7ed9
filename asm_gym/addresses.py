"""Arrays handed to compiled code by where they lie: sixty of them take 9 µs to hand over, and a table of them none."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from asm_gym.compilation import compiled


def table(parts: Iterable[NDArray[Any] | int]) -> NDArray[np.int64]:
    """(N, 4) where each array lies, and its shape; a whole number stands for itself.

    Whoever keeps the table keeps the arrays, and none of them may be exchanged for another.
    """
    found: list[tuple[int, ...]] = []
    for part in parts:
        if isinstance(part, int):
            found.append((part, 0, 0, 0))
            continue
        if not part.flags.c_contiguous:
            raise ValueError(f"an array of shape {part.shape} does not lie in one piece")
        found.append((part.ctypes.data, *part.shape, *(0,) * (3 - part.ndim)))
    return np.array(found, np.int64)


def _address(context: Any, address: Any) -> Any:
    """What lies at an address, for compiled code."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), code


_at: Any = intrinsic(_address)


@compiled
def floats1(t: Any, k: int) -> Any:
    """(n,) numbers."""
    return carray(_at(t[k, 0]), (t[k, 1],), np.float64)


@compiled
def floats2(t: Any, k: int) -> Any:
    """(n, m) numbers."""
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.float64)


@compiled
def floats3(t: Any, k: int) -> Any:
    """(n, m, k) numbers."""
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2], t[k, 3]), np.float64)


@compiled
def whole1(t: Any, k: int) -> Any:
    """(n,) whole numbers."""
    return carray(_at(t[k, 0]), (t[k, 1],), np.int64)


@compiled
def whole2(t: Any, k: int) -> Any:
    """(n, m) whole numbers."""
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.int64)


@compiled
def shorts1(t: Any, k: int) -> Any:
    """(n,) whole numbers of 32 bits."""
    return carray(_at(t[k, 0]), (t[k, 1],), np.int32)


@compiled
def flags1(t: Any, k: int) -> Any:
    """(n,) booleans."""
    return carray(_at(t[k, 0]), (t[k, 1],), np.bool_)


@compiled
def flags2(t: Any, k: int) -> Any:
    """(n, m) booleans."""
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.bool_)


@compiled
def singles1(t: Any, k: int) -> Any:
    """(n,) of single precision."""
    return carray(_at(t[k, 0]), (t[k, 1],), np.float32)


@compiled
def singles2(t: Any, k: int) -> Any:
    """(n, m) of single precision."""
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.float32)
