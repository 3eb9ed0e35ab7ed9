"""Show how a log is read before learning from it: its clock, its columns, and the role of each.

It prints a table of columns (range, noise, resolution, repeated and missing readings) and draws them all. Exit code 1:
the log cannot be read as it is, or not with the others of its folder.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data.inspection import inspect_log
from asm_gym.data.logs import Source, first_sources, read_sources
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_file import write_schema
from asm_gym.data.schema_inference import SchemaHints, infer_schema, recordings_in
from asm_gym.data.table_layout import Columns
from asm_gym.evaluation import figures
from asm_gym.scripts.command import BAD_NEWS, DONE, option, run
from asm_gym.scripts.log_options import LogOptions, exit_code_of_reading

DRAWN_LOGS = 3  # logs of a folder that are drawn; each other log gets one line
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
    schema: Path | None = option(None, metavar="FILE")
    """File to write the schema to, which says how the logs are read; edit it, and name it to fit and watch."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording, and how it is read.

    Args:
        source: where it was found; a log is cut where its clock begins anew.
        schema: how it is read.
        problem: why no schema can be inferred as the logs are; empty if one can.
    """

    source: Source
    schema: LogSchema
    problem: str = ""


def inspect(args: Args, console: Console) -> int:
    """Read, print the table of the first log and a line of every other, and draw pictures."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    printed: set[str] = set()  # remarks; one that holds for many logs is printed once
    exit_code = DONE
    with noted() as notes:
        for number, recording in enumerate(recordings(args)):
            source = recording.source
            columns = columns_of(source)
            log = inspect_log(source.name, columns, recording.schema, recording.problem)
            if log.trouble:
                exit_code = BAD_NEWS
            say(log.caption())
            if number == 0:
                for line in lines_of_table(log.facts()):
                    say(line)
            for remark in log.remarks():
                if remark not in printed:
                    say(f"- {remark}")
            printed.update(log.remarks())
            if number < DRAWN_LOGS:
                picture = args.out / f"{picture_name(source)}.png"
                figures.save(figures.log_figure(log), picture)
                say(f"Wrote {picture}")
            if number == 0 and args.schema is not None:
                write_schema(args.schema, recording.schema)
                say(f"Wrote {args.schema}. Next: asm-gym fit {args.log} --schema {args.schema}")
            if number == DRAWN_LOGS:
                say(f"Only the first {DRAWN_LOGS} logs are drawn.")
    for note in notes:
        say(f"Note: {note}.")
    return exit_code_of_reading(notes, exit_code)


def recordings(args: Args) -> Iterator[Recording]:
    """Yield the recordings, with the schema of the first of them."""
    hints = args.hints()
    sources, first = first_sources(read_sources(args.log, hints))
    schema = None
    problem = ""
    if first:
        hints = replace(hints, stated_rate=first[0].stated_rate)
        tables = [source.columns for source in first]
        try:
            schema = infer_schema(tables, hints)
        except ValueError as error:
            problem = str(error)
            # Any rate goes without the clock; the schema says none.
            schema = infer_schema(tables, replace(hints, clock="", rate=1.0))
            schema = replace(schema, rate=0.0)
    for source in sources:
        if source.episode is not None or schema is None:
            own = infer_schema([columns_of(source)], SchemaHints(channels=("*",)))
            yield Recording(source=source, schema=own)
            continue
        parts = recordings_in(source.columns, schema.clock)
        for number, part in enumerate(parts, 1):
            name = source.name
            if len(parts) > 1:
                name = f"{source.name} part {number}"
            part_source = replace(source, name=name, columns=part)
            yield Recording(source=part_source, schema=schema, problem=problem)


def picture_name(source: Source) -> str:
    """Return the name of a recording's picture."""
    name = source.name
    if source.file:
        name = name.replace(Path(source.file).suffix, "")
    return name.replace(os.sep, "_") or "log"


def columns_of(source: Source) -> Columns:
    """Return the columns of a recording; of an episode, its time and stream."""
    if source.episode is None:
        return source.columns
    stream = source.episode.stream
    spec = source.episode.spec
    columns: Columns = {"time": np.arange(len(stream)) * spec.dt}
    for k, label in enumerate(spec.labels):
        columns[label] = stream[:, k]
    return columns


def lines_of_table(facts: list[dict[str, Any]]) -> list[str]:
    """Return a line for each column of a log: plain text, as a table with borders folds in a narrow console."""
    if not facts:
        return []
    headings = [heading for heading in facts[0] if any(fact[heading] for fact in facts)]
    rows = [headings]
    rows += [[_cell(heading, fact[heading]) for heading in headings] for fact in facts]
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        padded = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(padded).rstrip())
    return lines


def _cell(heading: str, value: Any) -> str:
    """Format a fact; empty for NaN, the range of words, and for what there is none of."""
    is_nan = value != value
    is_range = heading in ("from", "to")
    if is_nan or not (value or is_range):
        return ""
    return FORMATS.get(heading, "{}").format(value)


main = partial(run, "inspect", Args, inspect)
