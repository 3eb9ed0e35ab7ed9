"""Options beside their fields: what is typed, what is quick, what is refused, and what the help says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from asm_gym.scripts.command import OptionsError, parse
from asm_gym.scripts.options import check_options, fixed, help_text, option, shortened


def even(number: int) -> None:
    if number % 2:
        raise ValueError(f"sizes must be even, got {number}")


@dataclass(frozen=True)
class Options:
    """What the tests take."""

    file: Path = option(positional=True, metavar="FILE")
    """The file."""
    count: int = option(100, quick=4, least=1)
    """How many."""
    sizes: tuple[int, ...] = option((8, 16), quick=(2,), least=1, check=even)
    """How large."""
    fruit: tuple[str, ...] = option((), known=("apple", "pear"))
    """What to eat."""
    how: Literal["raw", "baked"] = option("raw")
    """How to eat."""
    rate: float | None = option(None, least=0, metavar="HZ")
    """How often."""
    quick: bool = False
    """Little."""
    hidden: int = fixed(50, quick=5, least=1)
    """Set in Python only."""

    def __post_init__(self) -> None:
        check_options(self)


def typed(*argv: str) -> Options:
    found = parse("try", Options, argv)
    assert found is not None
    return found


def test_quick_shortens_what_was_not_asked_for_and_says_so():
    assert typed("x") == Options(Path("x"))
    quick = typed("x", "--quick", "--count", "100", "--sizes", "6", "8")
    assert (quick.count, quick.sizes, quick.hidden) == (100, (6, 8), 5)
    assert shortened(quick) == "--quick: hidden 5"
    assert shortened(typed("x", "--quick")) == "--quick: count 4, sizes 2, hidden 5"
    assert shortened(typed("x")) == ""


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["x", "--count", "0"], "count must be at least 1, got 0"),
        (["x", "--sizes"], "the number of sizes must be at least 1, got 0"),
        (["x", "--sizes", "2", "3"], "sizes must be even, got 3"),
        (["x", "--fruit", "aple"], "unknown fruit 'aple'; known: apple, pear; did you mean 'apple'?"),
        (["x", "--rate", "-1"], "rate must be at least 0, got -1.0"),
        (["x", "--how", "boiled"], "boiled"),
        (["x", "--hidden", "3"], "--hidden"),
        (["--count", "3"], "FILE"),
    ],
)
def test_what_will_not_do_is_refused_in_a_line(argv, said):
    with pytest.raises((OptionsError, ValueError)) as refused:
        typed(*argv)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_set_in_python_is_checked_too():
    with pytest.raises(ValueError, match="hidden must be at least 1, got 0"):
        Options(Path("x"), hidden=0)


def test_help_says_names_defaults_choices_and_what_is_shortened(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    said = help_text("asm-gym try", Options, "What it does.")
    assert said.startswith("usage: asm-gym try FILE [OPTIONS]\n\nWhat it does.\n\n  FILE\n      The file. Required.\n")
    assert "  --count N\n      How many. Default: 100.\n" in said
    assert "  --sizes N ...\n      How large. Default: 8 16.\n" in said
    assert "  --fruit NAME ...\n      What to eat. One of apple, pear.\n" in said
    assert "  --how {raw,baked}\n      How to eat. Default: raw.\n" in said
    assert "  --rate HZ\n      How often.\n" in said
    assert said.endswith("  --quick\n      Little. Unless asked otherwise: count 4, sizes 2, hidden 5.\n")
