"""Many arrays and numbers as four arrays, which a compiled call takes faster than the many.

Arrays of one kind lie end to end, each at the beginning of a line of the cache. A record says by name where each is,
and holds the numbers. In a compiled function, for ``learned`` of two arrays and a number:

    at = learned.at[0]
    product = at.scale * matrix(learned.singles, at.weights) @ vector(learned.singles, at.rates)

Its type depends on names and kinds alone, not on sizes, so that code compiled for one memory serves all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import inner

KINDS = np.float32, np.float64, np.int64
LINE = 64  # bytes


class Layout(NamedTuple):
    """Arrays of whatever shape, by name, and numbers."""

    singles: NDArray[np.float32]
    doubles: NDArray[np.float64]
    places: NDArray[np.int64]
    at: NDArray[Any]  # (1,) a record: of each array its beginning, rows and columns; the numbers

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Lay out arrays of float32, float64 and integers; a vector is a matrix of one row."""
        flat: list[list[NDArray[Any]]] = [[np.zeros(0, kind)] for kind in KINDS]
        ends, places = [0] * len(KINDS), {}
        for name, array in arrays.items():
            k = KINDS.index(array.dtype.type)
            places[name] = ends[k], int(np.prod(array.shape[:-1])), array.shape[-1]
            flat[k] += [np.ravel(array), np.zeros(-array.size % (LINE // array.itemsize), KINDS[k])]
            ends[k] += flat[k][-2].size + flat[k][-1].size
        kinds = [(name, np.int64, (3,)) for name in places]
        fields: Any = [*kinds, *((name, np.asarray(number).dtype) for name, number in numbers.items())]
        singles, doubles, integers = map(np.concatenate, flat)
        return cls(singles, doubles, integers, np.array([(*places.values(), *numbers.values())], fields))


@inner
def matrix(flat: Any, place: Any) -> Any:
    """Return the matrix of a ``Layout`` that is at ``place``."""
    begin, rows, columns = place[0], place[1], place[2]
    return flat[begin : begin + rows * columns].reshape((rows, columns))


@inner
def vector(flat: Any, place: Any) -> Any:
    """Return the vector of a ``Layout`` that is at ``place``."""
    return flat[place[0] : place[0] + place[1] * place[2]]
