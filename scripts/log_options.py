"""Options of the commands that read logs: what they say always wins over what the reader would decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from asm_gym.data.columns import LogLayout
from asm_gym.data.reader_notes import UNREAD
from asm_gym.scripts.command import DONE, REFUSED, Checked, option
from asm_gym.validation import check_number


@dataclass(frozen=True, kw_only=True)
class LogOptions(Checked):
    """How logs are read."""

    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows of logs a second; by default their clock tells."""
    clock: str = option("", metavar="COLUMN")
    """Column of times, perhaps with a unit, as in 'tick [ms]'; by default the steadiest."""
    channels: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns that are read: names, or patterns such as 'q*'; by default all that sense."""
    ignore: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns that are left out: names, or patterns."""
    label: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns that mark what is wrong, beside those called so; marked rows are not learned from."""
    columns: tuple[str, ...] = option((), metavar="NAME")
    """Names of the columns of files without a header."""

    def layout(self, **more: Any) -> LogLayout:
        """Return how to read logs; ``more`` are other fields of it."""
        said = {"channels": self.channels, "labels": self.label, "columns": self.columns, "ignore": self.ignore}
        return LogLayout(**{"rate": self.rate, "clock": self.clock} | said | more)


def ended(notes: Sequence[str], code: int = DONE) -> int:
    """Return the exit code of a command that read logs: ``REFUSED`` where a file of them could not be read."""
    return REFUSED if any(UNREAD in line for line in notes) else code
