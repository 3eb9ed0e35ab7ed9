"""What a log is, before anything is learned from it: its clock, its channels, and what is done with each.

A table of channels: unit, range, noise, resolution, how often one repeats itself, what is missing; and a picture of
them all. Exit code 1: it cannot be read as it is.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

from rich.console import Console

from asm_gym.data.inspection import ChannelFound, Inspection, in_time, inspected
from asm_gym.data.logs import LogLayout, read_tables
from asm_gym.data.reader_notes import noted
from asm_gym.evaluation import figures
from asm_gym.scripts.command import BAD_NEWS, DONE, run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.validation import check_number

HEADINGS = ("channel", "unit", "is", "from", "to", "noise", "resolution", "repeats", "missing", "what is done")


@dataclass(frozen=True)
class Args:
    """What a log is."""

    log: Path = option(positional=True, metavar="LOG")
    """A file or a folder, as asm-gym fit reads it."""
    out: Path = option(Path("runs/inspect"), metavar="FOLDER")
    """Folder of the pictures."""
    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows a second, where the log has no clock."""
    columns: tuple[str, ...] = option((), metavar="NAME")
    """Names of the columns of files without a header."""
    join: bool = False
    """The files of a folder are parts of one recording: join them by their clocks."""
    logs: int = fixed(3, least=1)
    """How many logs of a folder are shown."""

    def __post_init__(self) -> None:
        check_options(self)


def inspect(args: Args, console: Console) -> int:
    """Read, print a table a log, and draw a picture of each."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    layout = LogLayout(None, args.rate, columns=args.columns, join=args.join)
    with noted() as notes:
        tables = islice(read_tables(args.log, layout), args.logs)
        found = [inspected(name, columns, args.rate) for name, columns in tables]
    for log in found:
        picture = figures.save(figures.log_figure(log), args.out / f"{Path(log.name).stem or 'log'}.png")
        for line in [*table(log), *(f"- {remark}" for remark in log.remarks()), f"Wrote {picture}"]:
            say(line)
    for line in [*(f"Note: {note}." for note in notes), *(differences(found[0], other) for other in found[1:])]:
        if line:
            say(line)
    return BAD_NEWS if any(log.clock.trouble for log in found) else DONE


def table(log: Inspection) -> list[str]:
    """Return a line a channel, however narrow the console: a table with borders would fold away what matters."""
    clock = log.clock
    rate = f"{clock.rate:.6g} Hz, jitter {100 * clock.jitter:.1f} %" if clock.rate else "no rate"
    caption = f"{log.name}: {clock.rows} rows, {in_time(clock.seconds)}, {rate}, {len(clock.gaps)} gaps"
    rows = [HEADINGS, *map(cells, log.channels)]
    used = [k for k in range(len(HEADINGS)) if any(row[k] for row in rows[1:])]
    widths = {k: max(len(row[k]) for row in rows) for k in used}
    return [caption, *("  ".join(row[k].ljust(widths[k]) for k in used).rstrip() for row in rows)]


def cells(channel: ChannelFound) -> tuple[str, ...]:
    """Return the cells of a channel's line."""
    return (
        channel.name,
        channel.unit,
        channel.role,
        f"{channel.low:.4g}" if channel.rows else "",
        f"{channel.high:.4g}" if channel.rows else "",
        f"{channel.noise:.2g}",
        f"{channel.resolution:.2g}" if channel.resolution else "",
        f"{100 * channel.repeats:.0f} %",
        str(channel.missing or ""),
        channel.treatment(),
    )


def differences(first: Inspection, other: Inspection) -> str:
    """Say why two logs of a folder could not be learned from together; empty where they can."""
    mine, theirs = ({c.name for c in f.channels if c.role in ("sense", "command")} for f in (first, other))
    if mine != theirs:
        odd = ", ".join(sorted(mine ^ theirs)[:6])
        return f"{other.name} has other columns than {first.name}: {odd}; --join makes one log of them"
    if first.clock.rate and other.clock.rate and abs(first.clock.rate / other.clock.rate - 1) > 0.01:
        return f"{other.name} comes at {other.clock.rate:.5g} Hz and {first.name} at {first.clock.rate:.5g}: say --rate"
    return ""


def main(argv: list[str] | None = None) -> int:
    """Inspect, and return the exit code."""
    return run("inspect", Args, inspect, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
