"""Tables, and how they are written as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.table import Table as RichTable

from asm_gym.evaluation.statistics import Share

Subject = TypeVar("Subject")
FORMULA = "=+-@\t\r"  # what a cell that a spreadsheet takes for a formula begins with
FEWEST_SHOWN = 2  # columns, however narrow a terminal is
COLUMN_BORDER = 3  # characters beside the text of each column


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

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table for a terminal, without the last columns where words would break; rich calls this."""
        widths = self._widths(options.max_width - 1)
        table = RichTable(title=escape(self.caption))
        for heading, width in zip(self.headings, widths, strict=False):
            table.add_column(escape(heading), width=width, justify="right", overflow="fold")
        table.columns[0].justify = "left"
        for row in self.rows:
            table.add_row(*(escape(str(cell)) for cell in row[: len(widths)]))
        yield table
        left_out = self.headings[len(widths) :]
        if left_out:
            yield f"A wider terminal also shows: {escape(', '.join(left_out))}."

    def _widths(self, available: int) -> list[int]:
        """Return the widths of the columns that fit, so that each has room for its longest word."""
        columns = [list(map(str, cells)) for cells in zip(self.headings, *self.rows, strict=True)]
        widths = [max(map(_longest_word, cells)) for cells in columns]
        while len(widths) > FEWEST_SHOWN and _table_width(widths) > available:
            widths.pop()
        for _ in range(available - _table_width(widths)):
            more = [_extra_lines(*column) for column in zip(columns, widths, strict=False)]
            if not any(more):
                break
            widths[more.index(max(more))] += 1
        return widths


def _longest_word(text: str) -> int:
    return max(map(cell_len, text.split()), default=1)


def _extra_lines(cells: Sequence[str], width: int) -> int:
    """Return how many lines cells take beyond one each, about."""
    return sum(max(math.ceil(cell_len(cell) / width) - 1, 0) for cell in cells)


def _table_width(widths: Sequence[int]) -> int:
    return sum(width + COLUMN_BORDER for width in widths)


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
