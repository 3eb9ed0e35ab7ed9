"""Tables: their columns, each a heading and a function of what a row is about, and how they are written as text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.table import Table as RichTable

from asm_gym.evaluation.statistics import Share

Subject = TypeVar("Subject")
WITH_UNIT = re.compile(r"(?<=\d) (?=[%A-Za-zµ°]{1,3}\b|%)")
"""The space between a number and its unit, which no line ends at."""


@dataclass(frozen=True)
class Table:
    """A table: one heading a column, and rows as long as the headings; the first cell of a row names it."""

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"the table has {len(self.headings)} columns, but a row of {len(row)}: {list(row)}")


class Column(NamedTuple, Generic[Subject]):
    """A heading, and the cell beneath it of whatever a row is about."""

    heading: str
    cell: Callable[[Subject], str]


def tabulate(caption: str, columns: Sequence[Column[Subject]], subjects: Iterable[Subject]) -> Table:
    """A row for each subject."""
    rows = [tuple(column.cell(subject) for column in columns) for subject in subjects]
    return Table(caption, [column.heading for column in columns], rows)


@dataclass(frozen=True)
class ConsoleTable:
    """For a terminal: the caption on top, the first ``left`` columns to the left, numbers to the right.

    Columns stand side by side where the terminal is wide enough for every word, else each cell has a line of its own.
    ``plain`` is without rules.
    """

    table: Table
    left: int = 1
    plain: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Called by rich when it is printed."""
        style: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)} if self.plain else {}
        made = RichTable(title=escape(self.table.caption), **style)
        columns = list(zip(self.table.headings, *self.table.rows, strict=True))
        rules = 2 * len(columns) if self.plain else 3 * len(columns) + 1
        widths = _widths([list(map(str, cells)) for cells in columns], self.left, options.max_width - rules)
        if widths is None:
            yield self._listed()
            return
        for i, (heading, width) in enumerate(zip(self.table.headings, widths, strict=True)):
            made.add_column(escape(heading), justify="left" if i < self.left else "right", width=width)
        for row in self.table.rows:
            made.add_row(*(escape(str(cell)) for cell in row))
        yield made

    def _listed(self) -> str:
        """A paragraph for each row: what names it, then a line for each cell that says something."""
        paragraphs = [f"[italic]{escape(self.table.caption)}[/]"]
        for row in self.table.rows:
            name = ", ".join(str(cell) for cell in row[: self.left])
            cells = zip(self.table.headings[self.left :], row[self.left :], strict=True)
            said = [f"  {escape(heading)}: {escape(str(cell))}" for heading, cell in cells if str(cell)]
            paragraphs.append("\n".join([f"[bold]{escape(name)}[/]", *said]))
        return "\n".join(paragraphs)


def _widths(columns: Sequence[Sequence[str]], left: int, room: int) -> list[int] | None:
    """How wide each column is so that no word is cut and few lines are needed; None where there is no room."""
    most = [max(cell_len(line) for cell in cells for line in cell.split("\n")) for cells in columns]
    words = [[word for cell in cells for word in WITH_UNIT.sub("_", cell).split() or [""]] for cells in columns]
    widths = [max(map(cell_len, these)) for these in words]
    widths[:left] = most[:left]
    if sum(widths) > room:
        return None
    for _ in range(min(room, sum(most)) - sum(widths)):
        tightest = max(range(len(widths)), key=lambda i: most[i] / max(widths[i], 1))
        widths[tightest] += 1
    return widths


def markdown(table: Table) -> str:
    """The caption, and a table of pipes and dashes."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(map(str, cells)) + " |"

    rule = line(["---"] * len(table.headings))
    return "\n".join([table.caption, "", line(table.headings), rule, *map(line, table.rows)])


def number(value: float, digits: int) -> str:
    """Empty where there is none."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def count(share: Share | None) -> str:
    """``k of n``."""
    return "" if share is None else f"{share.k} of {share.n}"


def count_within(share: Share) -> str:
    """``k of n`` with its interval."""
    low, high = share.interval
    return f"{count(share)} ({100 * low:.0f}–{100 * high:.0f} %)" if share.n else ""


def percent(share: Share | None) -> str:
    """Empty where there is nothing to take a share of."""
    return f"{100 * share.value:.0f} %" if share is not None and share.n else ""
