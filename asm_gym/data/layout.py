"""How to read logs that do not name their channels as this package does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from glob import escape
from typing import Any

from asm_gym.data.names import is_clock, is_command, is_label
from asm_gym.episode import Episode
from asm_gym.spec import MOTOR, StreamSpec


@dataclass(frozen=True)
class LogLayout:
    """How to read logs; most are arguments of ``Episode.from_table``.

    Args:
        spec: of the memory that is to read them.
        rate: rows a second [Hz].
        action: patterns of the columns that were commanded.
        channels: patterns of the columns that are read; all where empty.
        labels: patterns of the columns that say what is wrong, beside those that are called so.
        columns: names of the columns of files without a header.
        join: the files of a folder are parts of one recording.
        by_name: without an ``action``, columns that are called so were commanded.
    """

    spec: StreamSpec | None = None
    rate: float | None = None
    action: Sequence[str] = ()
    channels: Sequence[str] = ()
    labels: Sequence[str] = ()
    columns: Sequence[str] = ()
    join: bool = False
    by_name: bool = False

    def episode(self, columns: Any) -> Episode:
        """Return the episode of a table; it is a success, for somebody handed it over as one."""
        chosen = self.spec or (list(self.channels) if self.channels else None)
        read = partial(Episode.from_table, columns, chosen, self.rate, labels=self.labels, success=True)
        found = read(action=() if self.spec else self.action)
        if self.spec or self.action or not self.by_name:
            return found
        channels = found.spec.channels
        named = [escape(c.name) for c in channels if c.group != MOTOR and is_command(c.name)]
        return read(action=named) if 0 < len(named) < len(channels) else found

    def keeps(self, name: str) -> bool:
        """Tell whether the words of a column say a time or a label."""
        return is_clock(name) or is_label(name, self.labels)
