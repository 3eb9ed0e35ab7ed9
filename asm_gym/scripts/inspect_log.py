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
    remarks: set[str] = set()  # that were said: what is alike in many logs is said once
    trouble = False
    with noted() as notes:
        for number, recording in enumerate(recordings(args)):
            source = recording.source
            log = inspect_log(
                source.name, table_of_source(source), recording.schema, recording.problem
            )
            trouble = trouble or bool(log.trouble)
            say(log.caption())
            if number == 0:
                for line in table(log.facts()):
                    say(line)
            for remark in log.remarks():
                if remark not in remarks:
                    say(f"- {remark}")
            remarks.update(log.remarks())
            if number < args.logs:
                picture = args.out / f"{picture_name(source)}.png"
                say(f"Wrote {figures.save(figures.log_figure(log), picture)}")
            if number == 0 and args.schema is not None:
                write_schema(args.schema, recording.schema)
                say(f"Wrote {args.schema}. Next: asm-gym fit {args.log} --schema {args.schema}")
    for note in notes:
        say(f"Note: {note}.")
    return exit_code_of_reading(notes, BAD_NEWS if trouble else DONE)


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
            own = infer_schema([table_of_source(source)], SchemaHints(channels=("*",)))
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
    name = source.name.replace(Path(source.file).suffix, "") if source.file else source.name
    return name.replace(os.sep, "_") or "log"


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


main = partial(run, "inspect", Args, inspect)
