"""Options of a command: the fields of a frozen dataclass, read by tyro; the string under a field is its help."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

from asm_gym.validation import check_choice

T = TypeVar("T")
_SAME: Any = object()
_ANNOTATED: Any = Annotated


def option(
    default: T = MISSING,  # type: ignore[assignment]
    *,
    quick: T = _SAME,
    least: float | None = None,
    known: Iterable[str] | Callable[[], Iterable[str]] = (),
    check: Callable[[Any], object] | None = None,
    metavar: str = "",
    positional: bool = False,
) -> T:
    """Return a dataclass field that is an option of a command.

    Args:
        default: value; without one the option is required.
        quick: default with ``--quick``.
        least: lowest number, or the least length of a tuple.
        known: names that the help lists; no others are accepted, unless ``check`` decides.
        check: function that raises for a value, or for an element of a tuple, that is not accepted.
        metavar: placeholder of the value in the help.
        positional: whether the option is given without its name.
    """
    about = {"quick": quick, "least": least, "known": known, "check": check}
    made: T = field(default=default, metadata={**about, "metavar": metavar, "positional": positional})
    return made


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every command."""

    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same result."""
    quick: bool = False
    """Little of everything: to see that it runs, not to judge the figures."""

    def __post_init__(self) -> None:
        check_options(self)


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
            if check := about.get("check"):
                check(one)
            elif known := _names(about):
                check_choice(each.name.removesuffix("s").replace("_", " "), one, known)


def parser(kind: type[Any], quick: bool = False) -> Any:
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
        default = about["quick"] if quick and about.get("quick", _SAME) is not _SAME else each.default
        made.append((each.name, hint, field(default=tyro.MISSING if default is MISSING else default)))
    unchecked = {"__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, made, bases=(kind,), frozen=True, namespace=unchecked)


def _hint(about: Any) -> Callable[[str], str]:
    """Return what the help says after an option's text: known names, its default and its quick value."""

    def hint(default: str) -> str:
        names, quick = _names(about), about.get("quick", _SAME)
        parts = [f"known: {', '.join(names)}"] if names else []
        if default not in ("", "None", "True", "False"):
            parts.append("required" if default == "(required)" else f"default: {default}")
        if quick is not _SAME:
            parts.append(f"--quick: {' '.join(map(str, quick)) if isinstance(quick, tuple) else quick}")
        return f"({'; '.join(parts)})" if parts else ""

    return hint


def _names(about: Any) -> list[str]:
    names = about.get("known", ())
    return list(names() if callable(names) else names)
