"""Tables, and how they are written as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.markup import escape
from rich.table import Table as RichTable

from asm_gym.evaluation.statistics import Share

Subject = TypeVar("Subject")
FORMULA = "=+-@\t\r"  # what a cell that a spreadsheet takes for a formula begins with


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
                    f"the table has {len(self.headings)} columns, but a row of {len(row)}: "
                    f"{list(row)}"
                )

    def __rich__(self) -> RichTable:
        """Return the table for a terminal; rich calls this."""
        shown = RichTable(title=escape(self.caption))
        for heading in self.headings:
            shown.add_column(escape(heading), justify="right", overflow="fold")
        shown.columns[0].justify = "left"
        for row in self.rows:
            shown.add_row(*(escape(str(cell)) for cell in row))
        return shown


def tabulate(
    caption: str, columns: Mapping[str, Callable[[Subject], str]], subjects: Iterable[Subject]
) -> Table:
    """Make a row for each subject; ``columns`` hold the function of a cell by heading."""
    rows = [tuple(cell(subject) for cell in columns.values()) for subject in subjects]
    return Table(caption, list(columns), rows)


def markdown(table: Table) -> str:
    """Return the caption, and a table of pipes and dashes."""
    rows = (table.headings, ["---"] * len(table.headings), *table.rows)
    lines = ["| " + " | ".join(map(str, cells)) + " |" for cells in rows]
    return "\n".join([table.caption, "", *lines])


def count(share: Share | None) -> str:
    """Format as ``k of n``; empty without a share."""
    if share is None:
        return ""
    return f"{share.k} of {share.n}"


def percent(share: Share | None) -> str:
    """Format as a percentage; empty without a share, or for none of none."""
    if share is None or not share.n:
        return ""
    return f"{100 * share.value:.0f} %"


def plain_cell(text: str) -> str:
    """Return a cell of CSV that no spreadsheet takes for a formula: a name that looks like one is quoted."""
    if text.startswith(tuple(FORMULA)):
        return f"'{text}"
    return text
