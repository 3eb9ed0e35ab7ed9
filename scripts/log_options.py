"""Options of the commands that read logs; they override what the reader decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from asm_gym.data.columns import LogLayout
from asm_gym.data.reader_notes import UNREAD
from asm_gym.scripts.command import DONE, REFUSED, Checked, option
from asm_gym.validation import check_number


@dataclass(frozen=True, kw_only=True)
class LogOptions(Checked):
    """How logs are read."""

    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows of a log per second; by default from its clock."""
    clock: str = option("", metavar="COLUMN")
    """Column of times, optionally with a unit, as in 'tick [ms]'; by default the steadiest."""
    channels: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns to read: names, or patterns such as 'q*'; by default all sensor readings and commands."""
    ignore: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns to leave out: names, or patterns."""
    label: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns that mark faulty rows, beside those with usual names; marked rows are not learned from."""
    columns: tuple[str, ...] = option((), metavar="NAME")
    """Names of the columns of files without a header."""
    like: Path | None = option(None, metavar="FILE")
    """Log of one robot: of a folder with logs of several robots, read only those with its columns and its rate."""

    def layout(self, **more: Any) -> LogLayout:
        """Return how to read logs; ``more`` are other fields of it."""
        said = {
            "channels": self.channels,
            "labels": self.label,
            "columns": self.columns,
            "ignore": self.ignore,
        }
        return LogLayout(
            **{"rate": self.rate, "clock": self.clock, "like": self.like} | said | more
        )


def ended(notes: Sequence[str], code: int = DONE) -> int:
    """Return the exit code of a command that read logs: ``REFUSED`` where a file of them could not be read."""
    return REFUSED if any(UNREAD in line for line in notes) else code
