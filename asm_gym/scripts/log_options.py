"""Options of the commands that read logs; they override what the reader decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from asm_gym.data.reader_notes import UNREAD
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_file import read_schema
from asm_gym.data.schema_inference import SchemaHints
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
    schema: Path | None = option(None, metavar="FILE")
    """Schema of the logs, written by asm-gym inspect --schema and edited; by default it is inferred."""

    def hints(self, action: Sequence[str] = ()) -> SchemaHints:
        """Return what the user says of the logs; ``action`` are patterns of the commands."""
        return SchemaHints(
            rate=self.rate,
            clock=self.clock,
            channels=self.channels,
            action=action,
            labels=self.label,
            ignore=self.ignore,
            columns=self.columns,
        )

    def given_schema(self) -> LogSchema | None:
        """Return the schema that the user names; None without one.

        Raises:
            OSError: there is no such file.
            ValueError: it is damaged, or options stand beside it that it holds itself.
        """
        if self.schema is None:
            return None
        if self.channels:
            raise ValueError(
                "--channels and --schema exclude each other: the schema names the roles"
            )
        return read_schema(self.schema)


def exit_code_of_reading(notes: Sequence[str], otherwise: int = DONE) -> int:
    """Return ``REFUSED`` where one of the readers' notes is of a file that could not be read, else ``otherwise``."""
    if any(UNREAD in note for note in notes):
        return REFUSED
    return otherwise
