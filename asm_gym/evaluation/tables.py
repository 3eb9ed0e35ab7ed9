"""Tables: their columns, each a heading and a function of a row's subject, and how they are written as text."""

from __future__ import annotations

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
    """A table for a terminal; one that is too narrow for the words of a row gets one line per cell."""

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render; rich calls this."""
        headings, rows = self.table.headings, self.table.rows
        columns = zip(headings, *rows, strict=True)
        widest = [max(map(len, " ".join(map(str, cells)).split() or [""])) for cells in columns]  # word of each column
        if sum(widest) + 3 * len(widest) + 1 > options.max_width:
            paragraphs = [f"[italic]{escape(self.table.caption)}[/]"]
            for name, *cells in rows:
                paragraphs.append(f"[bold]{escape(str(name))}[/]")
                named = zip(headings[1:], cells, strict=True)
                paragraphs += [f"  {escape(heading)}: {escape(str(cell))}" for heading, cell in named if str(cell)]
            yield "\n".join(paragraphs)
            return
        made = RichTable(title=escape(self.table.caption))
        for heading, width in zip(headings, widest, strict=True):
            how: Any = "right" if made.columns else "left"
            made.add_column(escape(heading), justify=how, min_width=width)
        for row in rows:
            made.add_row(*(escape(str(cell)) for cell in row))
        yield made


def markdown(table: Table) -> str:
    """Return the caption, and a table of pipes and dashes."""
    lines = [table.headings, ["---"] * len(table.headings), *table.rows]
    return "\n".join([table.caption, "", *("| " + " | ".join(map(str, cells)) + " |" for cells in lines)])


def count(share: Share | None) -> str:
    """Format as ``k of n``."""
    return "" if share is None else f"{share.k} of {share.n}"


def percent(share: Share | None) -> str:
    """Format as a percentage; none of none as nothing."""
    return f"{100 * share.value:.0f} %" if share is not None and share.n else ""
