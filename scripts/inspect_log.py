"""Show how a log is read before learning from it: its clock, its columns, and the role of each.

It prints a table of columns (range, noise, resolution, repeated and missing readings) and draws them all. Exit code 1:
the log cannot be read as it is, or not with the others of its folder.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data.inspection import Inspection, inspected
from asm_gym.data.logs import LIKE, Source, first_tables, read_tables
from asm_gym.data.reader_notes import noted
from asm_gym.data.tables import Columns
from asm_gym.evaluation import figures
from asm_gym.scripts.command import BAD_NEWS, DONE, option, run
from asm_gym.scripts.log_options import LogOptions, ended

FORMATS = {
    "from": "{:.4g}",
    "to": "{:.4g}",
    "noise": "{:.2g}",
    "resolution": "{:.2g}",
    "repeats": "{:.0%}",
}
"""How the facts are printed; others as they are."""


@dataclass(frozen=True, kw_only=True)
class Args(LogOptions):
    """Options of an inspection."""

    log: Path = option(positional=True, metavar="LOG")
    """A file or a folder, as asm-gym fit reads it."""
    out: Path = option(Path("runs/inspect"), metavar="FOLDER")
    """Folder of the pictures."""
    logs: int = option(3, least=1)
    """Number of logs of a folder to draw; each other log gets one line."""


def inspect(args: Args, console: Console) -> int:
    """Read, print the table of the first log and a line of every other, and draw pictures."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    known, trouble, first = set[str](), False, None
    with noted() as notes:
        layout = args.layout()
        sources, tables = first_tables(read_tables(args.log, layout))
        for n, source in enumerate(sources):
            columns, nominal = table_of_source(source), replace(layout, nominal=source.rate)
            if source.episode is not None:  # its stream is what it is
                nominal = replace(nominal, channels=("*",))
            log = inspected(
                source.name, columns, nominal, [t for t in tables if t is not source.columns]
            )
            trouble = trouble or bool(log.trouble) or not log.rate
            say(log.caption())
            lines = [
                *(table(log.facts) if first is None else []),
                *(f"- {line}" for line in log.remarks()),
            ]
            for line in lines:
                if line not in known:  # of many logs what is alike is said once
                    say(line)
            known.update(line for line in lines if line.startswith("- "))
            if n < args.logs:
                name = (
                    source.name.replace(Path(source.file).suffix, "").replace(os.sep, "_") or "log"
                )
                picture = figures.save(figures.log_figure(log), args.out / f"{name}.png")
                say(f"Wrote {picture}")
            if first is not None and (line := differences(first, log)):
                trouble = True
                say(line)
            first = first or log
    for note in notes:
        say(f"Note: {note}.")
    return ended(notes, BAD_NEWS if trouble else DONE)


def table_of_source(source: Source) -> Columns:
    """Return the columns of a recording; of an episode, its stream."""
    if source.episode is None:
        return source.columns
    stream, spec = source.episode.stream, source.episode.spec
    rows = {label: stream[:, k] for k, label in enumerate(spec.labels)}
    return {"time": np.arange(len(stream)) * spec.dt} | rows


def table(facts: list[dict[str, Any]]) -> list[str]:
    """Return a line a column, however narrow the console: a table with borders would fold away what matters."""
    headings = [h for h in facts[0] if any(row[h] for row in facts)] if facts else []
    rows = [headings, *([_cell(heading, row[heading]) for heading in headings] for row in facts)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _cell(heading: str, fact: Any) -> str:
    known = fact == fact and (fact or heading in ("from", "to"))  # words have no range: NaN
    return FORMATS.get(heading, "{}").format(fact) if known else ""


def differences(first: Inspection, other: Inspection) -> str:
    """Say why two logs of a folder could not be learned from together; empty where they can."""
    mine, theirs = ({c.name for c in log.columns if c.read} for log in (first, other))
    if mine != theirs:
        return f"{other.name} has other columns than {first.name}: {', '.join(sorted(mine ^ theirs)[:6])}; {LIKE}"
    if first.rate and other.rate and abs(first.rate / other.rate - 1) > 0.01:
        return f"{other.name} comes at {other.rate:.5g} Hz and {first.name} at {first.rate:.5g}: say --rate; {LIKE}"
    return ""


main = partial(run, "inspect", Args, inspect)
