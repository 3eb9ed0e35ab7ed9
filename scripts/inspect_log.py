"""What a log is, before anything is learned from it: its clock, its columns, and what is done with each.

A table of columns: unit, range, noise, resolution, how often one repeats itself, what is missing; and a picture of
them all. Exit code 1: it cannot be read as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console

from asm_gym.data.inspection import Inspection, inspected
from asm_gym.data.logs import LogLayout, read_tables
from asm_gym.data.reader_notes import noted
from asm_gym.evaluation import figures
from asm_gym.scripts.command import BAD_NEWS, DONE, Checked, option, run
from asm_gym.validation import check_number

FORMATS = {"from": "{:.4g}", "to": "{:.4g}", "noise": "{:.2g}", "resolution": "{:.2g}", "repeats": "{:.0%}"}
"""How the facts are printed; others as they are."""


@dataclass(frozen=True)
class Args(Checked):
    """What a log is."""

    log: Path = option(positional=True, metavar="LOG")
    """A file or a folder, as asm-gym fit reads it."""
    out: Path = option(Path("runs/inspect"), metavar="FOLDER")
    """Folder of the pictures."""
    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows a second, where the log has no clock."""
    columns: tuple[str, ...] = option((), metavar="NAME")
    """Names of the columns of files without a header."""
    logs: int = option(3, least=1)
    """How many logs of a folder are shown."""


def inspect(args: Args, console: Console) -> int:
    """Read, print a table a log, and draw a picture of each."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    with noted() as notes:
        tables = read_tables(args.log, LogLayout(None, args.rate, columns=args.columns))
        found = [inspected(name, columns, args.rate) for name, columns in islice(tables, args.logs)]
        more = next(tables, None) is not None
    for log in found:
        picture = figures.save(figures.log_figure(log), args.out / f"{Path(log.name).stem or 'log'}.png")
        for line in [log.caption(), *table(log.facts), *(f"- {line}" for line in log.remarks()), f"Wrote {picture}"]:
            say(line)
    for line in [*(f"Note: {note}." for note in notes), *(differences(found[0], other) for other in found[1:])]:
        if line:
            say(line)
    if more:
        say(f"There are more logs; these are the first {args.logs}.")
    return BAD_NEWS if any(log.clock.trouble for log in found) else DONE


def table(facts: list[dict[str, Any]]) -> list[str]:
    """Return a line a column, however narrow the console: a table with borders would fold away what matters."""
    headings = [h for h in facts[0] if any(row[h] for row in facts)] if facts else []
    rows = [headings, *([_cell(heading, row[heading]) for heading in headings] for row in facts)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def _cell(heading: str, fact: Any) -> str:
    known = fact == fact and (fact or heading in ("from", "to"))  # words have no range: NaN
    return FORMATS.get(heading, "{}").format(fact) if known else ""


def differences(first: Inspection, other: Inspection) -> str:
    """Say why two logs of a folder could not be learned from together; empty where they can."""
    mine, theirs = ({c.name for c in log.columns if c.read} for log in (first, other))
    if mine != theirs:
        return f"{other.name} has other columns than {first.name}: {', '.join(sorted(mine ^ theirs)[:6])}"
    if first.clock.rate and other.clock.rate and abs(first.clock.rate / other.clock.rate - 1) > 0.01:
        return f"{other.name} comes at {other.clock.rate:.5g} Hz and {first.name} at {first.clock.rate:.5g}: say --rate"
    return ""


main = partial(run, "inspect", Args, inspect)

if __name__ == "__main__":
    raise SystemExit(main())
