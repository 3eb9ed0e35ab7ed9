"""Tables as text: for a terminal, and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table as ConsoleTable

from asm_gym.evaluation.report import Table


def console_table(table: Table, left: int = 1) -> ConsoleTable:
    """For a terminal: the caption on top, the first ``left`` columns to the left, numbers to the right."""
    made = ConsoleTable(title=escape(table.caption))
    for i, heading in enumerate(table.headings):
        made.add_column(escape(heading), justify="left" if i < left else "right", no_wrap=i < left)
    for row in table.rows:
        made.add_row(*(escape(str(cell)) for cell in row))
    return made


def markdown(table: Table) -> str:
    """The caption, and a table of pipes and dashes."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(map(str, cells)) + " |"

    rule = line(["---"] * len(table.headings))
    return "\n".join([table.caption, "", line(table.headings), rule, *map(line, table.rows)])
