"""Run a command: read its options, do the work, return an exit code.

====  ===================================================================================
   0  done
   1  done, with bad news: something needed is missing, or there was an alarm
   2  refused: the options, files or installed packages do not fit; one line says why
 130  interrupted by Ctrl-C; 143 by ``kill``: no worker process is left behind
====  ===================================================================================

``PYTHONDEVMODE=1`` shows the traceback of a refusal.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import gymnasium as gym

from asm_gym.scripts.options import parser

if TYPE_CHECKING:
    from rich.console import Console

Args = TypeVar("Args")
DONE, BAD_NEWS, REFUSED = 0, 1, 2

USAGE_ERRORS = (ValueError, TypeError, OSError, ImportError, gym.error.Error)
"""Errors that a user can put right; a cluster that is not at its address is an OSError too."""


class Terminated(KeyboardInterrupt):
    """The process received SIGTERM."""


def run(
    name: str, kind: type[Args], work: Callable[[Args, Console], int | None], argv: Sequence[str] | None = None
) -> int:
    """Run one command and return its exit code.

    Args:
        name: command, as typed after ``asm-gym``.
        kind: dataclass of its options; the docstring of its module is the help text above them.
        work: function of the options and a console; returns the exit code, None is 0.
        argv: options as typed; those of this process by default.
    """
    from rich.console import Console

    return exit_code(name, lambda: work(parse(name, kind, argv), Console()))


def parse(name: str, kind: type[Args], argv: Sequence[str] | None = None) -> Args:
    """Return the options of a command; those not typed have their defaults, or with ``--quick`` their quick values.

    Raises:
        SystemExit: help was asked for, or options are unknown or unreadable; tyro printed why.
        ValueError: the dataclass refuses a value.
    """
    import tyro

    args = list(sys.argv[1:] if argv is None else argv)
    text = inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "").replace("`", "")
    flags = (tyro.conf.FlagCreatePairsOff,)
    typed = tyro.cli(parser(kind, "--quick" in args), args=args, prog=f"asm-gym {name}", description=text, config=flags)
    return kind(**vars(typed))


def exit_code(name: str, work: Callable[[], int | None]) -> int:
    """Return the exit code of ``work``; print an error that a user can put right as one line."""
    prog = f"asm-gym {name}".strip()
    try:
        with _terminable():
            return work() or DONE
    except SystemExit as end:
        return int(end.code or DONE)
    except KeyboardInterrupt as end:
        print(f"{prog}: interrupted", file=sys.stderr)
        return 128 + (signal.SIGTERM if isinstance(end, Terminated) else signal.SIGINT)
    except BrokenPipeError:  # the reader of our output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except USAGE_ERRORS as error:
        if sys.flags.dev_mode:
            raise
        print(f"{prog}: {one_line(error)}", file=sys.stderr)
        return REFUSED


def one_line(error: BaseException) -> str:
    """Return the message of an error as one line."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    head, *rest = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return " ".join([head, "; ".join(rest)]) if rest else head


@contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into an exception, as Ctrl-C is, so that workers are stopped; restore the caller's handler."""

    def end(number: int, frame: object) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
