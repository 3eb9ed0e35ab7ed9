"""Tables, and how they are written as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.markup import escape
from rich.table import Table as RichTable

from asm_gym.evaluation.statistics import Share

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Table:
    """A table: one heading per column, and rows as long as the headings; the first cell of a row names it."""

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(
                    f"the table has {len(self.headings)} columns, but a row of {len(row)}: {list(row)}"
                )

    def __rich__(self) -> RichTable:
        """Return the table for a terminal; rich calls this."""
        made = RichTable(title=escape(self.caption))
        for n, heading in enumerate(self.headings):
            made.add_column(escape(heading), justify="right" if n else "left", overflow="fold")
        for row in self.rows:
            made.add_row(*(escape(str(cell)) for cell in row))
        return made


def tabulate(
    caption: str, columns: Mapping[str, Callable[[Subject], str]], subjects: Iterable[Subject]
) -> Table:
    """Make a row for each subject; ``columns`` hold the function of a cell by heading."""
    rows = [tuple(cell(subject) for cell in columns.values()) for subject in subjects]
    return Table(caption, list(columns), rows)


def markdown(table: Table) -> str:
    """Return the caption, and a table of pipes and dashes."""
    lines = [table.headings, ["---"] * len(table.headings), *table.rows]
    return "\n".join(
        [table.caption, "", *("| " + " | ".join(map(str, cells)) + " |" for cells in lines)]
    )


def count(share: Share | None) -> str:
    """Format as ``k of n``."""
    return "" if share is None else f"{share.k} of {share.n}"


def percent(share: Share | None) -> str:
    """Format as a percentage; none of none as nothing."""
    return f"{100 * share.value:.0f} %" if share is not None and share.n else ""
