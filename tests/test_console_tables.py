"""Tables of a terminal: no word is cut, however narrow it is."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

from asm_gym.evaluation.tables import ConsoleTable, Table

HEADINGS = ("guard", "harm of hostile policies avoided", "in the worst cell", "untrained ones", "healthy [episodes]")
ROWS = [("policy alone", "0.0 %", "1", "2", ""), ("default", "99.7 %", "91.8 %", "3", "1156 of 1200")]


def _printed(width: int, plain: bool) -> str:
    console = Console(width=width, color_system=None)
    with console.capture() as caught:
        console.print(ConsoleTable(Table("Harm avoided", HEADINGS, ROWS), plain=plain))
    return caught.get()


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("width", range(44, 140, 8))
def test_no_word_is_cut_and_no_line_is_longer_than_the_terminal(width: int, plain: bool) -> None:
    text = _printed(width, plain)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    said = set(re.findall(r"[\w.\[\]]+", text))
    assert {
        word for cells in (HEADINGS[1:], *ROWS) for cell in cells for word in re.findall(r"[\w.\[\]]+", cell)
    } <= said
    assert "99.7 %" in text, "a number stands beside its unit"


def test_a_narrow_terminal_gets_a_line_for_each_cell() -> None:
    assert "  in the worst cell: 91.8 %" in _printed(44, False).splitlines()
    assert "healthy [episodes]: \n" not in _printed(44, False), "an empty cell says nothing"


def test_a_wide_terminal_gets_a_line_for_each_row() -> None:
    row = ["default", "99.7", "%", "91.8", "%", "3", "1156", "of", "1200"]
    assert row in [line.split() for line in _printed(200, True).splitlines()]


def test_a_heading_of_two_lines_is_as_wide_as_the_longer_one() -> None:
    table = Table("Delays", ("", "delay [ms]\nmedian, 95 %"), [("push", "50, 100")])
    console = Console(width=80, color_system=None)
    with console.capture() as caught:
        console.print(ConsoleTable(table, plain=True))
    assert [line.rstrip() for line in caught.get().splitlines()[1:]] == [
        "        delay [ms]",
        "      median, 95 %",
        "push       50, 100",
    ]
