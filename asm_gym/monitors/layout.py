"""Many arrays and numbers as four arrays, which a compiled call takes faster than the many.

Arrays of one kind lie end to end, each at the beginning of a line of the cache. A record says by name where each is,
and holds the numbers. In a compiled function, for ``learned`` of two arrays and a number:

    at = learned.at[0]
    product = at.scale * matrix(learned.singles, at.weights) @ vector(learned.singles, at.rates)

Its type depends on names and kinds alone, not on sizes, so that code compiled for one memory serves all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import inner

LINE = 64  # bytes


class Layout(NamedTuple):
    """Arrays of whatever shape, by name, and numbers."""

    singles: NDArray[np.float32]
    doubles: NDArray[np.float64]
    integers: NDArray[np.int64]
    at: NDArray[Any]  # (1,) a record: of each array its beginning, rows and columns; the numbers

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any]) -> Layout:
        """Lay out arrays of float32, float64 and int64; a vector is a matrix of one row."""
        singles = _Line(np.float32)
        doubles = _Line(np.float64)
        integers = _Line(np.int64)
        line_of = {line.kind: line for line in (singles, doubles, integers)}

        fields: list[Any] = []
        values: list[Any] = []
        for name, array in arrays.items():
            fields.append((name, np.int64, (3,)))
            values.append(line_of[array.dtype].append(array))
        for name, number in numbers.items():
            fields.append((name, np.asarray(number).dtype))
            values.append(number)
        record = np.array([tuple(values)], np.dtype(fields))
        return cls(singles=singles.array, doubles=doubles.array, integers=integers.array, at=record)


class _Line:
    """Arrays of one kind, end to end."""

    def __init__(self, kind: type[np.generic]) -> None:
        self.kind = np.dtype(kind)
        self.array = np.zeros(0, kind)

    def append(self, array: NDArray[Any]) -> tuple[int, int, int]:
        """Add an array; return its beginning, rows and columns."""
        begin = len(self.array)
        padding = np.zeros(-array.size % (LINE // array.itemsize), self.kind)
        self.array = np.concatenate([self.array, np.ravel(array), padding])
        return begin, int(np.prod(array.shape[:-1])), array.shape[-1]


@inner
def matrix(flat: Any, place: Any) -> Any:
    """Return the matrix of a ``Layout`` that is at ``place``."""
    begin, rows, columns = place[0], place[1], place[2]
    return flat[begin : begin + rows * columns].reshape((rows, columns))


@inner
def vector(flat: Any, place: Any) -> Any:
    """Return the vector of a ``Layout`` that is at ``place``."""
    return flat[place[0] : place[0] + place[1] * place[2]]
