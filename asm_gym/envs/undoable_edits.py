"""Edits of the simulator's numbers that add up, end in any order, and leave nothing behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

Change = Callable[[Any], Any]


class _Entry:
    """An edited number, or row of numbers: its nominal value, and the changes of it in force."""

    def __init__(self, array: NDArray[Any], index: Any) -> None:
        self.array = array
        self.index = index
        self.nominal = np.copy(array[index])
        self.changes: dict[object, Change] = {}

    def write(self) -> None:
        value = np.copy(self.nominal)
        for change in self.changes.values():
            value = change(value)
        self.array[self.index] = value


class SimulatorEdits:
    """Nominal values of everything that is edited now, from which each change recomputes an entry."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, str], _Entry] = {}

    @contextmanager
    def edit(self, array: NDArray[Any], *indices: Any) -> Iterator[Callable[[Change], None]]:
        """Edit entries of an array alike while the block runs; yield a function that sets the change of their values.

        Two parties must name one entry in the same way.
        """
        party = object()
        entries: dict[tuple[int, str], _Entry] = {}
        for index in indices:
            key = (array.__array_interface__["data"][0], repr(index))
            entries[key] = self._entries.setdefault(key, _Entry(array, index))
            entries[key].changes[party] = _unchanged

        def change(rule: Change) -> None:
            for entry in entries.values():
                entry.changes[party] = rule
                entry.write()

        try:
            yield change
        finally:
            for key, entry in entries.items():
                del entry.changes[party]
                entry.write()
                if not entry.changes:
                    del self._entries[key]

    def __len__(self) -> int:
        return len(self._entries)


def _unchanged(value: Any) -> Any:
    return value
