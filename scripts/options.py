"""Options of a command: the fields of a frozen dataclass, read by tyro; the string under a field is its help.

@dataclass(frozen=True)
class Args:
    '''What the command does.'''

    episodes: int = option(100, quick=4, least=1)
    '''Number of episodes.'''
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, field, fields, make_dataclass
from typing import Annotated, Any, TypeVar, get_origin, get_type_hints

from asm_gym.validation import check_choice

T = TypeVar("T")
Args = TypeVar("Args")
Names = Iterable[str] | Callable[[], Iterable[str]]

_SAME: Any = object()
_ANNOTATED: Any = Annotated


def option(
    default: T = MISSING,  # type: ignore[assignment]
    *,
    quick: T = _SAME,
    least: float | None = None,
    known: Names = (),
    listed: Names = (),
    check: Callable[[Any], object] | None = None,
    metavar: str = "",
    positional: bool = False,
) -> T:
    """Return a dataclass field that is an option of a command.

    Args:
        default: value; without one the option is required.
        quick: default with ``--quick``.
        least: lowest number, or the least length of a tuple.
        known: names that are accepted.
        listed: names that the help lists; others are accepted too.
        check: function that raises for a value, or for an element of a tuple, that is not accepted.
        metavar: placeholder of the value in the help.
        positional: whether the option is given without its name.
    """
    about = {"quick": quick, "least": least, "known": known, "listed": listed, "check": check}
    made: T = field(default=default, metadata={**about, "metavar": metavar, "positional": positional})
    return made


def fixed(
    default: T, *, quick: T = _SAME, least: float | None = None, check: Callable[[Any], object] | None = None
) -> T:
    """Return a dataclass field that is set in Python only; ``--quick`` changes it too."""
    made: T = field(default=default, metadata={"quick": quick, "least": least, "check": check, "fixed": True})
    return made


def check_options(options: Any) -> None:
    """Raise ValueError where an option is too small or an unknown name, or where its own check raises."""
    for each in fields(options):
        value, about = getattr(options, each.name), each.metadata
        if value is None:
            continue
        if (least := about.get("least")) is not None:
            many = isinstance(value, Sequence)
            name, number = (f"the number of {each.name}", len(value)) if many else (each.name, value)
            if not number >= least:
                raise ValueError(f"{name} must be at least {least:g}, got {number}")
        for one in value if isinstance(value, tuple) else (value,):
            if known := _names(about.get("known")):
                check_choice(singular(each.name), one, known)
            if check := about.get("check"):
                check(one)


def singular(name: str) -> str:
    """Return the name of one value of an option."""
    return name.removesuffix("s").replace("_", " ") if not name.endswith("ss") else name


def read(kind: type[Args], argv: Sequence[str], prog: str, description: str = "") -> Args:
    """Return the options typed; the others have their defaults, or with ``--quick`` their quick values.

    Raises:
        SystemExit: help was asked for, or options are unknown or unreadable; tyro printed why.
        ValueError: the dataclass refuses a value.
    """
    import tyro

    text = inspect.cleandoc(description or kind.__doc__ or "").replace("`", "")
    on_off = (tyro.conf.FlagCreatePairsOff,)
    typed = tyro.cli(parser(kind, "--quick" in argv), args=list(argv), prog=prog, description=text, config=on_off)
    return kind(**vars(typed))


def parser(kind: type[Any], hurried: bool = False) -> Any:
    """Return a subclass of ``kind`` that tyro reads: annotated, and not checked while it is read."""
    import tyro

    hints: dict[str, Any] = get_type_hints(kind, include_extras=True)
    marks: Any = tyro.conf
    made: list[Any] = []
    for each in fields(kind):
        about, hint = each.metadata, hints[each.name]
        quick = about.get("quick", _SAME)
        if about.get("fixed"):
            hint = marks.Suppress[marks.Fixed[hint]]
        else:
            many = " ..." if get_origin(hint) is tuple and about.get("metavar") else ""
            metavar = about.get("metavar", "") + many or None
            names = _names(about.get("known") or about.get("listed"))
            hint = _ANNOTATED[hint, tyro.conf.arg(metavar=metavar, help_behavior_hint=_hint(names, quick))]
            hint = marks.Positional[hint] if about.get("positional") else hint
        default = quick if hurried and quick is not _SAME else each.default
        made.append((each.name, hint, field(default=tyro.MISSING if default is MISSING else default)))
    unchecked = {"__post_init__": lambda self: None}
    frozen = kind.__dataclass_params__.frozen
    return make_dataclass(kind.__name__, made, bases=(kind,), frozen=frozen, namespace=unchecked)


def _hint(names: Sequence[str], quick: Any) -> Callable[[str], str]:
    """Return what the help says after an option's text: known names, its default and its quick value."""

    def hint(default: str) -> str:
        parts = [f"known: {', '.join(names)}"] if names else []
        if default not in ("", "None", "True", "False"):
            parts.append("required" if default == "(required)" else f"default: {default}")
        if quick is not _SAME:
            parts.append(f"--quick: {' '.join(map(str, quick)) if isinstance(quick, tuple) else quick}")
        return f"({'; '.join(parts)})" if parts else ""

    return hint


def _names(names: Names | None) -> list[str]:
    return list(names() if callable(names) else names or ())
