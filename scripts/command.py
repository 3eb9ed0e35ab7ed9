"""Run a command: read its options, do the work, return an exit code.

====  ===================================================================================
   0  done
   1  done, with bad news: something needed is missing, or there was an alarm
   2  refused: the options, files or installed packages do not fit; one line says why
 130  interrupted by Ctrl-C; 143 by ``kill``: no worker process is left behind
====  ===================================================================================

Options are the fields of a frozen dataclass, read by tyro; the string under a field is its help. ``PYTHONDEVMODE=1``
shows the traceback of a refusal.
"""

from __future__ import annotations

import inspect
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

import gymnasium as gym

from asm_gym.validation import check_choice
from asm_gym.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")
Args = TypeVar("Args")
DONE, BAD_NEWS, REFUSED = 0, 1, 2
# errors that a user can put right
USAGE_ERRORS = (
    ValueError,
    TypeError,
    OSError,
    ImportError,
    gym.error.Error,
)
MOST_NAMES = 7  # that the help of an option lists; a wrong name lists all
_SAME: Any = object()
_ANNOTATED: Any = Annotated


class Terminated(KeyboardInterrupt):
    """The process received SIGTERM."""


# ------------------------------------------------------------------ options


def option(
    default: T = MISSING,  # type: ignore[assignment]
    *,
    quick: T = _SAME,  # default with ``--quick``
    least: float | None = None,  # lowest number, or the least length of a tuple
    # names that the help lists; no others are accepted, unless ``check`` decides
    known: Iterable[str] = (),
    check: Callable[[Any], object]
    | None = None,  # raises for a value, or an element of a tuple, that is not accepted
    metavar: str = "",  # placeholder of the value in the help
    positional: bool = False,  # whether the option is given without its name
) -> T:
    """Return a dataclass field that is an option of a command; without a default it is required."""
    about = {"quick": quick, "least": least, "known": known, "check": check}
    return field(default=default, metadata={**about, "metavar": metavar, "positional": positional})


@dataclass(frozen=True)
class Checked:
    """Options that are checked when they are made: ValueError where one is too small or an unknown name."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value, about = getattr(self, each.name), each.metadata
            if value is None:
                continue
            if (least := about.get("least")) is not None:
                many = isinstance(value, Sequence)
                name, number = (
                    (f"the number of {each.name}", len(value)) if many else (each.name, value)
                )
                if not number >= least:
                    raise ValueError(f"{name} must be at least {least:g}, got {number}")
            for one in value if isinstance(value, tuple) else (value,):
                if check := about.get("check"):
                    check(one)
                elif known := about.get("known"):
                    check_choice(each.name.removesuffix("s").replace("_", " "), one, known)


@dataclass(frozen=True, kw_only=True)
class Options(Checked):
    """Options of most commands."""

    seed: int = option(0, least=0)
    """Seed of all random draws: the same seed gives the same result."""
    quick: bool = False
    """A small run, to see that the command works; its figures mean nothing."""


def parse(name: str, kind: type[Args], argv: Sequence[str] | None = None) -> Args:
    """Return the options of a command; those not typed have their defaults, or with ``--quick`` their quick values.

    Raises:
        SystemExit: help was asked for, or options are unreadable; tyro printed why.
        ValueError: there is no such option, or the dataclass refuses a value.
    """
    import tyro

    args = list(sys.argv[1:] if argv is None else argv)
    text = inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "").replace("`", "")
    named = [
        each.name.replace("_", "-")
        for each in fields(cast(Any, kind))
        if not each.metadata.get("positional")
    ]
    options = [f"--{name}" for name in (*named, "help")]
    for word in args:
        if word.startswith("--") and not word.startswith("--tyro-"):
            check_choice("option", word.partition("=")[0].replace("_", "-"), options)
    flags = (tyro.conf.FlagCreatePairsOff,)
    readable = _readable(kind, "--quick" in args)
    typed = tyro.cli(readable, args=args, prog=f"asm-gym {name}", description=text, config=flags)
    return kind(**vars(typed))


def _readable(kind: type[Any], quick: bool) -> Any:
    """Return a subclass of ``kind`` that tyro reads: annotated, and not checked while it is read."""
    import tyro

    hints: dict[str, Any] = get_type_hints(kind, include_extras=True)
    marks: Any = tyro.conf
    made: list[Any] = []
    for each in fields(kind):
        about, hint = each.metadata, hints[each.name]
        shown = marks.arg(metavar=about.get("metavar") or None, help_behavior_hint=_hint(about))
        hint = _ANNOTATED[hint, shown]
        hint = marks.Positional[hint] if about.get("positional") else hint
        default = (
            about["quick"] if quick and about.get("quick", _SAME) is not _SAME else each.default
        )
        made.append(
            (each.name, hint, field(default=tyro.MISSING if default is MISSING else default))
        )
    unchecked = {"__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, made, bases=(kind,), frozen=True, namespace=unchecked)


def _hint(about: Any) -> Callable[[str], str]:
    """Return what the help says after an option's text: known names, its default and its quick value."""

    def hint(default: str) -> str:
        names, quick = [*about.get("known", ())], about.get("quick", _SAME)
        more = ", …" if len(names) > MOST_NAMES else ""
        parts = [f"known: {', '.join(names[:MOST_NAMES])}{more}"] if names else []
        if default not in ("", "None", "True", "False"):
            parts.append("required" if default == "(required)" else f"default: {default}")
        if quick is not _SAME:
            parts.append(
                f"--quick: {' '.join(map(str, quick)) if isinstance(quick, tuple) else quick}"
            )
        return f"({'; '.join(parts)})" if parts else ""

    return hint


# ------------------------------------------------------------------ exit codes


def run(
    name: str,
    kind: type[Args],
    work: Callable[[Args, Console], int | None],
    argv: Sequence[str] | None = None,
) -> int:
    """Run one command and return its exit code, which ``work`` returns; None is 0.

    The docstring of the module of ``kind``, the dataclass of options, is the help text above them.
    """
    from rich.console import Console

    return exit_code(name, lambda: work(parse(name, kind, argv), Console()))


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


def origin() -> dict[str, str]:
    """Return how to make a report again: the whole command, the version, and when it was made."""
    made = datetime.now(UTC).astimezone().isoformat(timespec="seconds")
    return {
        "command": shlex.join(["asm-gym", *sys.argv[1:]]),
        "version": f"asm-gym {__version__}",
        "date": made,
    }


def one_line(error: BaseException) -> str:
    """Return the message of an error as one line."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    head, *rest = [line.strip() for line in str(error).splitlines() if line.strip()] or [
        type(error).__name__
    ]
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
