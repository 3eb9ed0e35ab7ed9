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
from dataclasses import MISSING, Field, dataclass, field, fields, make_dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

import gymnasium as gym

from asm_gym.scripts.shortage import shortage_of
from asm_gym.validation import check_choice
from asm_gym.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")
Args = TypeVar("Args")
DONE = 0
BAD_NEWS = 1
REFUSED = 2
# errors that a user can put right
USAGE_ERRORS = (ValueError, TypeError, OSError, ImportError, gym.error.Error)
MOST_NAMES = 7  # that the help of an option lists; a wrong name lists all
_NO_QUICK_VALUE: Any = object()  # with ``--quick`` the option keeps its default
_ANNOTATED: Any = Annotated  # so that mypy lets annotations be computed


class Terminated(KeyboardInterrupt):
    """The process received SIGTERM."""


# ------------------------------------------------------------------ options


def option(
    default: T = MISSING,  # type: ignore[assignment]
    *,
    quick: T = _NO_QUICK_VALUE,  # default with ``--quick``
    least: float | None = None,  # lowest number, or the least length of a tuple
    # names that the help lists; no others are accepted, unless ``check`` decides
    known: Iterable[str] = (),
    # raises for a value, or an element of a tuple, that is not accepted
    check: Callable[[Any], object] | None = None,
    metavar: str = "",  # placeholder of the value in the help
    positional: bool = False,  # whether the option is given without its name
) -> T:
    """Return a dataclass field that is an option of a command; without a default it is required."""
    metadata = {
        "quick": quick,
        "least": least,
        "known": known,
        "check": check,
        "metavar": metavar,
        "positional": positional,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Checked:
    """Options that are checked when they are made: ValueError where one is too small or an unknown name."""

    def __post_init__(self) -> None:
        for own in fields(self):
            value = getattr(self, own.name)
            if value is None:
                continue
            _check_least(own, value)
            check = own.metadata.get("check")
            known = own.metadata.get("known")
            in_words = own.name.removesuffix("s").replace("_", " ")
            elements = value if isinstance(value, tuple) else (value,)
            for element in elements:
                if check:
                    check(element)
                elif known:
                    check_choice(in_words, element, known)


def _check_least(option: Field[Any], value: Any) -> None:
    """Raise ValueError where a number is too small, or a tuple or string too short."""
    least = option.metadata.get("least")
    if least is None:
        return
    name = option.name
    if isinstance(value, Sequence):
        name = f"the number of {name}"
        value = len(value)
    if not value >= least:
        raise ValueError(f"{name} must be at least {least:g}, got {value}")


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
    description = inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "").replace("`", "")
    all_fields = fields(cast(Any, kind))
    named = [each.name for each in all_fields if not each.metadata.get("positional")]
    options = ["--" + field_name.replace("_", "-") for field_name in named] + ["--help"]
    values = {each.name: each.metadata.get("metavar") for each in all_fields}
    for word, following in zip(args, [*args[1:], "--"], strict=False):
        if word.startswith("--") and not word.startswith("--tyro-"):
            option_name, given, _ = word.partition("=")
            check_choice("option", option_name.replace("_", "-"), options)
            needed = values.get(option_name[2:].replace("-", "_"))
            if needed and not given and following.startswith("--"):
                raise ValueError(f"{option_name} needs {needed}")
    unchecked = tyro.cli(
        _unchecked(kind, "--quick" in args),
        args=args,
        prog=f"asm-gym {name}",
        description=description,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    return kind(**vars(unchecked))


def _unchecked(kind: type[Any], quick: bool) -> Any:
    """Return a subclass of ``kind`` that tyro reads: annotated, and not checked while it is read."""
    import tyro

    hints: dict[str, Any] = get_type_hints(kind, include_extras=True)
    conf: Any = tyro.conf
    annotated: list[Any] = []
    for each in fields(kind):
        about = each.metadata
        in_help = conf.arg(metavar=about.get("metavar") or None, help_behavior_hint=_hint(about))
        hint = _ANNOTATED[hints[each.name], in_help]
        if about.get("positional"):
            hint = conf.Positional[hint]
        default = each.default
        if quick and about.get("quick", _NO_QUICK_VALUE) is not _NO_QUICK_VALUE:
            default = about["quick"]
        elif default is MISSING:
            default = tyro.MISSING
        annotated.append((each.name, hint, field(default=default)))
    no_checks = {"__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, annotated, bases=(kind,), frozen=True, namespace=no_checks)


def _hint(about: Any) -> Callable[[str], str]:
    """Return the function from an option's default to what the help says after the option's text.

    ``about`` is the metadata of the option's field.
    """

    def hint(default: str) -> str:
        parts = []
        names = list(about.get("known", ()))
        if names:
            listed = ", ".join(names[:MOST_NAMES])
            if len(names) > MOST_NAMES:
                listed += ", …"
            parts.append(f"known: {listed}")
        if default == "(required)":
            parts.append("required")
        elif default not in ("", "''", "None", "True", "False"):
            parts.append(f"default: {default}")
        quick = about.get("quick", _NO_QUICK_VALUE)
        if isinstance(quick, tuple):
            quick = " ".join(map(str, quick))
        if quick is not _NO_QUICK_VALUE:
            parts.append(f"--quick: {quick}")
        if not parts:
            return ""
        return f"({'; '.join(parts)})"

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
    """Return the exit code of ``work``; print an error that a user can correct as one line."""
    prog = f"asm-gym {name}".strip()
    try:
        with _terminable():
            return work() or DONE
    except SystemExit as end:
        return int(end.code or DONE)
    except KeyboardInterrupt as end:
        print(f"{prog}: interrupted", file=sys.stderr)
        if isinstance(end, Terminated):
            return 128 + signal.SIGTERM
        return 128 + signal.SIGINT
    except BrokenPipeError:  # the reader of our output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except Exception as error:
        message = shortage_of(error)
        if not message and isinstance(error, USAGE_ERRORS):
            message = one_line(error)
        if sys.flags.dev_mode or not message:
            raise
        print(f"{prog}: {message}", file=sys.stderr)
        return REFUSED


def origin() -> dict[str, str]:
    """Return how to make a report again: the whole command, the version, and when it was made."""
    return {
        "command": shlex.join(["asm-gym", *sys.argv[1:]]),
        "version": f"asm-gym {__version__}",
        "date": datetime.now(UTC).astimezone().isoformat(timespec="seconds"),
    }


def one_line(error: BaseException) -> str:
    """Return the message of an error as one line."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    first, *others = lines
    return f"{first} {'; '.join(others)}".strip()


@contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into an exception, as Ctrl-C is, so that workers are stopped; restore the caller's handler."""

    def raise_terminated(number: int, frame: object) -> None:
        raise Terminated

    # Signals reach the main thread only.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    callers_handler = signal.signal(signal.SIGTERM, raise_terminated)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, callers_handler)
