"""Tables, and how they are written as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table as RichTable

from asm_gym.evaluation.statistics import Share

Subject = TypeVar("Subject")
FORMULA = "=+-@\t\r"  # what a cell that a spreadsheet takes for a formula begins with
FEWEST_SHOWN = 2  # columns, however narrow a terminal is
UNBOUNDED = 10_000  # width of a terminal in which no word breaks


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
        unbounded = options.update(max_width=UNBOUNDED)
        shown = len(self.headings)
        table = self._first(shown)
        while shown > FEWEST_SHOWN:
            if Measurement.get(console, unbounded, table).minimum <= options.max_width:
                break
            shown -= 1
            table = self._first(shown)
        yield table
        left_out = self.headings[shown:]
        if left_out:
            yield f"A wider terminal also shows: {escape(', '.join(left_out))}."

    def _first(self, shown: int) -> RichTable:
        """Return the first columns as rich draws them."""
        table = RichTable(title=escape(self.caption))
        for heading in self.headings[:shown]:
            table.add_column(escape(heading), justify="right", overflow="fold")
        table.columns[0].justify = "left"
        for row in self.rows:
            table.add_row(*(escape(str(cell)) for cell in row[:shown]))
        return table


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
    """Return a cell of CSV that no spreadsheet takes for a formula: it is quoted unless it is a number."""
    if text.startswith(tuple(FORMULA)) and not is_number(text):
        return f"'{text}"
    return text


def is_number(text: str) -> bool:
    """Return whether a text is a number, such as -1.5."""
    try:
        float(text)
    except ValueError:
        return False
    return True
