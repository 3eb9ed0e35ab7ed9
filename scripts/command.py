"""What every command does alike: options in, work, an exit code out.

Exit codes, everywhere:

====  =========================================================================================
   0  done
   1  done, and the answer is bad news: something needed is missing, there was an alarm, it leaks
   2  refused: options, files or what is installed make no sense; one line says what
 130  interrupted by Ctrl-C, 143 by ``kill``: one line, and no worker goes on
====  =========================================================================================

``PYTHONDEVMODE=1`` shows the traceback of what was refused.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper
from typing import TYPE_CHECKING, TypeVar

import gymnasium as gym

from asm_gym.scripts.options import help_text, read, shortened

if TYPE_CHECKING:
    from rich.console import Console

DONE, BAD_NEWS, REFUSED = 0, 1, 2

USAGE_ERRORS = (ValueError, TypeError, OSError, ImportError, gym.error.Error)
"""Raised where arguments, files or what is installed make no sense; no cluster at an address is an OSError too."""

Args = TypeVar("Args")


class OptionsError(ValueError):
    """Options that make no sense; the message is one line."""


class Terminated(KeyboardInterrupt):
    """The process was told to end (SIGTERM): workers are stopped as after Ctrl-C."""


def run(
    name: str,
    kind: type[Args],
    work: Callable[[Args, Console], int | None],
    argv: Sequence[str] | None = None,
    about: str | None = None,
) -> int:
    """Runs one command, and returns its exit code.

    Args:
        name: as typed after ``asm-gym``.
        kind: a dataclass of its options; the string under each says what it is. It refuses what makes no sense.
        work: is handed the options and where to print; what it returns is the exit code, None is 0.
        argv: options as typed; those of this process by default.
        about: what the command does, shown above its options; by default the docstring of ``kind``.
    """
    from rich.console import Console

    def parsed_and_done() -> int | None:
        args = parse(name, kind, argv, about)
        if args is None:
            return DONE
        console = Console()
        if hurried := shortened(args):
            console.print(hurried, highlight=False)
        return work(args, console)

    return exit_code(name, parsed_and_done)


def exit_code(name: str, work: Callable[[], int | None]) -> int:
    """What ``work`` returns; where it raises what a user can put right, says so in one line."""
    prog = f"asm-gym {name}".strip()
    try:
        with _terminable():
            return work() or DONE
    except KeyboardInterrupt as end:
        print(f"{prog}: interrupted", file=sys.stderr)
        return 128 + (signal.SIGTERM if isinstance(end, Terminated) else signal.SIGINT)
    except BrokenPipeError:  # whoever read our output has seen enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except USAGE_ERRORS as error:
        if sys.flags.dev_mode:
            raise
        print(f"{prog}: {one_line(error)}", file=sys.stderr)
        return REFUSED


def parse(name: str, kind: type[Args], argv: Sequence[str] | None = None, about: str | None = None) -> Args | None:
    """The options as typed; None where help was asked for, and printed.

    Raises:
        OptionsError: they make no sense.
        ValueError: the dataclass refuses them.
    """
    given, prog = sys.argv[1:] if argv is None else list(argv), f"asm-gym {name}".strip()
    if {"-h", "--help"} & set(given):
        print(help_text(prog, kind, plain(about or kind.__doc__ or "")), end="")
        return None
    said = TextIOWrapper(BytesIO(), encoding="utf-8", write_through=True)
    try:
        # Unframed below: framed lines that are broken could not be put together as they were.
        with redirect_stdout(said), redirect_stderr(said), _columns(10_000):
            values = read(kind, given, prog)
    except SystemExit:
        said.seek(0)
        raise OptionsError(_complaint(said.read())) from None
    return kind(**values)


def plain(text: str) -> str:
    """A docstring without its markup, and without equations, which fit no terminal."""
    text = "\n\n".join(part for part in text.split("\n\n") if not part.startswith("    "))
    return re.sub(r":\w+:`~?([^`]*)`|`+([^`]*)`+", lambda found: found[1] or found[2], textwrap.dedent(text)).strip()


def one_line(error: BaseException) -> str:
    """What an error says, however many lines it takes to say it."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    head, *rest = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return " ".join([head, "; ".join(rest)]) if rest else head


def _complaint(said: str) -> str:
    """A parser's framed complaint, its help and hints as one line."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", said)
    rows = [row[2:].rstrip("│ ") for row in text.splitlines() if row.startswith("│")]
    block, *others = "\n".join("" if set(row) == {"─"} else row for row in rows).split("\n\n")
    head, *names = [row for row in block.splitlines() if not row.startswith(" " * 8)]  # deeper stands their help
    said = f"{head} {', '.join(name.strip() for name in names)}".strip()
    hints = [row for hint in others if hint.startswith("Perhaps") for row in hint.splitlines() if row[4:6] == "--"]
    near = ", ".join(dict.fromkeys(row.split()[0] for row in hints))
    choices = [hint for hint in others if hint.startswith("Available")]
    said = re.sub(r"^Error parsing (?!-)\S+: |^Error parsing ", "", said)
    return said + (f"; did you mean {near}?" if near else "") + "".join(f"; {choice}" for choice in choices)


@contextmanager
def _columns(width: int) -> Iterator[None]:
    """So wide a terminal, for whatever asks."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(width)
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


@contextmanager
def _terminable() -> Iterator[None]:
    """``kill`` ends the work as Ctrl-C does, which stops its workers; what a caller had set is set again."""

    def end(number: int, frame: object) -> None:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:  # only the main thread hears signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
