"""What a log is, before anything is learned from it: its clock, its channels, and what would be done about each.

A table of channels: unit, range, noise, resolution, how often one repeats itself, what is missing; and a picture of
them all. Exit code 1: it cannot be read as it is.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
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
    """Reads, prints a table a log, and draws a picture of each."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    layout = LogLayout(None, args.rate, columns=args.columns, join=args.join)
    code = DONE
    with noted() as notes:
        shown = [
            inspected(name, columns, args.rate) for name, columns in islice(read_tables(args.log, layout), args.logs)
        ]
    for found in shown:
        for line in table(found):
            say(line)
        for line in found.remarks():
            say(f"- {line}")
        file = figures.save(figures.log_figure(found), args.out / f"{Path(found.name).stem or 'log'}.png")
        say(f"Wrote {file}")
        if found.clock.trouble:
            code = BAD_NEWS
    for line in notes:
        say(f"Note: {line}.")
    for other in shown[1:]:
        differences(shown[0], other, say)
    return code


def table(found: Inspection) -> list[str]:
    """A line a channel, however narrow the console: a table with borders folded away what matters."""
    clock = found.clock
    rate = f"{clock.rate:.6g} Hz, jitter {100 * clock.jitter:.1f} %" if clock.rate else "no rate"
    caption = f"{found.name}: {clock.rows} rows, {in_time(clock.seconds)}, {rate}, {len(clock.gaps)} gaps"
    rows = [HEADINGS, *(tuple(map(str, cells(channel))) for channel in found.channels)]
    used = [k for k in range(len(HEADINGS)) if any(row[k] for row in rows[1:])]
    widths = {k: max(len(row[k]) for row in rows) for k in used}
    return [caption, *("  ".join(row[k].ljust(widths[k]) for k in used).rstrip() for row in rows)]


def cells(channel: ChannelFound) -> Sequence[object]:
    """What is printed of one."""
    read = channel.rows > 0
    return (
        channel.name,
        channel.unit,
        channel.role,
        f"{channel.low:.4g}" if read else "",
        f"{channel.high:.4g}" if read else "",
        f"{channel.noise:.2g}" if channel.noise else "0",
        f"{channel.resolution:.2g}" if channel.resolution else "",
        f"{100 * channel.repeats:.0f} %",
        channel.missing or "",
        channel.treatment(),
    )


def differences(first: Inspection, other: Inspection, say: partial[None]) -> None:
    """Says where two logs of a folder could not be learned from together."""
    mine, theirs = ({c.name for c in f.channels if c.role in ("sense", "command")} for f in (first, other))
    if mine != theirs:
        odd = sorted(mine ^ theirs)
        say(f"{other.name} has other columns than {first.name}: {', '.join(odd[:6])}; --join makes one log of them")
    elif first.clock.rate and other.clock.rate and abs(first.clock.rate / other.clock.rate - 1) > 0.01:
        say(f"{other.name} comes at {other.clock.rate:.5g} Hz and {first.name} at {first.clock.rate:.5g}: say --rate")


def main(argv: list[str] | None = None) -> int:
    """Inspects, and returns the exit code."""
    return run("inspect", Args, inspect, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
