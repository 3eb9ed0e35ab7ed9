"""Join messages of several publishers of one robot into rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple


class _Message(NamedTuple):
    """The newest message of a publisher."""

    arrival: float  # [s]
    leads: bool  # it may make a row
    values: Mapping[str, Any]  # by name


class Publishers:
    """Join messages that hold different numbers.

    A row is a message of most numbers, with the newest of the others.

    Args:
        silence: after which the numbers of a publisher are missing [s].
    """

    def __init__(self, silence: float) -> None:
        self.silence = silence
        self._newest: dict[frozenset[str], _Message] = {}  # by its numbers

    def row(
        self, message: Mapping[str, Any], numbers: Iterable[str], now: float, leads: bool = True
    ) -> dict[str, Any] | None:
        """Return the row that a message makes, or None.

        A message with some of the numbers of another one is of the same publisher, and lacks the
        others.

        Args:
            message: values by name.
            numbers: the names that are read.
            now: when it came [s].
            leads: it may make a row.
        """
        own = frozenset(numbers)
        for others in self._newest:
            if others & own:
                own |= others
        for names, other in list(self._newest.items()):
            if names & own or now - other.arrival > self.silence:
                del self._newest[names]
        self._newest[own] = _Message(now, leads, message)

        leaders = [names for names, other in self._newest.items() if other.leads]
        if own != max(leaders, key=len, default=None):
            return None
        row: dict[str, Any] = {}
        for other in self._newest.values():
            row |= other.values
        return row
