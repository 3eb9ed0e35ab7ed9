"""Edits of the simulator's numbers that add up, end in any order, and leave nothing behind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Change = Callable[[Any], Any]


class Edit:
    """One party's change of one entry; made by ``SimulatorEdits.edit``."""

    def __init__(self, entry: _Entry) -> None:
        self._entry = entry
        self._change: Change = lambda value: value

    def change(self, change: Change) -> None:
        """From now on the entry is ``change(value)``, where ``value`` is what those who came before make of it."""
        self._change = change
        self._entry.write()

    def release(self) -> None:
        """Ends this party's change; with the last one the entry is what it was, to the bit."""
        self._entry.leave(self)


class _Entry:
    """A number, or a row of them, that somebody edits."""

    def __init__(self, array: NDArray[Any], index: Any, forget: Callable[[], None]) -> None:
        self._array, self._index, self._forget = array, index, forget
        self._nominal = np.copy(array[index])
        self.edits: list[Edit] = []

    def write(self) -> None:
        value = np.copy(self._nominal)
        for edit in self.edits:
            value = edit._change(value)
        self._array[self._index] = value

    def leave(self, edit: Edit) -> None:
        self.edits.remove(edit)
        self.write()
        if not self.edits:
            self._forget()


class SimulatorEdits:
    """Knows the nominal value of everything that is edited now.

    Every change recomputes the entry from its nominal value, so that edits of one number compose, whichever begins or
    ends first, and nothing is left of them, not even rounding.
    """

    def __init__(self) -> None:
        self._entries: dict[tuple[int, str], _Entry] = {}

    def edit(self, array: NDArray[Any], index: Any) -> Edit:
        """A place in the queue of those who change ``array[index]``.

        Args:
            index: two parties must name one entry in the same way.
        """
        key = (array.__array_interface__["data"][0], repr(index))
        if key not in self._entries:
            self._entries[key] = _Entry(array, index, lambda: self._entries.__delitem__(key))
        entry = self._entries[key]
        edit = Edit(entry)
        entry.edits.append(edit)
        return edit

    def __len__(self) -> int:
        return len(self._entries)
