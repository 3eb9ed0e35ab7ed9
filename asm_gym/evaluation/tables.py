"""Tables: their columns, each a heading and a function of a row's subject, and how they are written as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from rich.console import Console, ConsoleOptions, RenderResult
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
                raise ValueError(f"the table has {len(self.headings)} columns, but a row of {len(row)}: {list(row)}")


class Column(NamedTuple, Generic[Subject]):
    """A heading, and the function that gives its cell."""

    heading: str
    cell: Callable[[Subject], str]


def tabulate(caption: str, columns: Sequence[Column[Subject]], subjects: Iterable[Subject]) -> Table:
    """Make a row for each subject."""
    rows = [tuple(column.cell(subject) for column in columns) for subject in subjects]
    return Table(caption, [column.heading for column in columns], rows)


@dataclass(frozen=True)
class ConsoleTable:
    """A table for a terminal: the first ``left`` columns to the left, numbers to the right; ``plain`` has no rules.

    A terminal that is too narrow for the words of a row gets one line per cell.
    """

    table: Table
    left: int = 1
    plain: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render; rich calls this."""
        style: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)} if self.plain else {}
        made = RichTable(title=escape(self.table.caption), **style)
        columns = zip(self.table.headings, *self.table.rows, strict=True)
        widest = [max(map(len, " ".join(map(str, cells)).split() or [""])) for cells in columns]  # word of each column
        if sum(widest) + 3 * len(widest) + 1 > options.max_width:
            yield self._list()
            return
        for i, (heading, width) in enumerate(zip(self.table.headings, widest, strict=True)):
            made.add_column(escape(heading), justify="left" if i < self.left else "right", min_width=width)
        for row in self.table.rows:
            made.add_row(*(escape(str(cell)) for cell in row))
        yield made

    def _list(self) -> str:
        """Return a paragraph per row: its name, then a line for each cell that is not empty."""
        paragraphs = [f"[italic]{escape(self.table.caption)}[/]"]
        for row in self.table.rows:
            cells = zip(self.table.headings[self.left :], row[self.left :], strict=True)
            lines = [f"  {escape(heading)}: {escape(str(cell))}" for heading, cell in cells if str(cell)]
            name = ", ".join(map(str, row[: self.left]))
            paragraphs.append("\n".join([f"[bold]{escape(name)}[/]", *lines]))
        return "\n".join(paragraphs)


def markdown(table: Table) -> str:
    """Return the caption, and a table of pipes and dashes."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(map(str, cells)) + " |"

    rule = line(["---"] * len(table.headings))
    return "\n".join([table.caption, "", line(table.headings), rule, *map(line, table.rows)])


def number(value: float, digits: int) -> str:
    """Format a number; NaN as nothing."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def count(share: Share | None) -> str:
    """Format as ``k of n``."""
    return "" if share is None else f"{share.k} of {share.n}"


def count_within(share: Share) -> str:
    """Format as ``k of n`` with its interval."""
    low, high = share.interval
    return f"{count(share)} ({100 * low:.0f}–{100 * high:.0f} %)" if share.n else ""


def percent(share: Share | None) -> str:
    """Format as a percentage; none of none as nothing."""
    return f"{100 * share.value:.0f} %" if share is not None and share.n else ""
