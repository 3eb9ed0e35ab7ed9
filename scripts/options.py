"""Options of a command as a frozen dataclass: what stands beside each field, how it is read, and the help that says it.

    @dataclass(frozen=True)
    class Args:
        episodes: int = option(100, quick=4, least=1)
        '''How many.'''

``quick`` is the value with ``--quick`` for whoever did not ask for another; ``least``, ``known`` and ``check`` refuse.
"""

from __future__ import annotations

import ast
import inspect
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, field, fields, is_dataclass, make_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from asm_gym.validation import check_choice

T = TypeVar("T")

_SAME: Any = object()
_METAVARS = {int: "N", float: "X", str: "NAME", Path: "PATH"}
_WIDEST = 120


def option(
    default: T = MISSING,  # type: ignore[assignment]
    *,
    quick: T = _SAME,
    least: float | None = None,
    known: Iterable[str] | Callable[[], Iterable[str]] = (),
    listed: Iterable[str] | Callable[[], Iterable[str]] = (),
    check: Callable[[Any], object] | None = None,
    metavar: str = "",
    positional: bool = False,
) -> T:
    """A field that is an option of the command.

    Args:
        default: without it the option is required.
        quick: with ``--quick``, where nothing else was asked for.
        least: of a number; of a tuple, of how many there are.
        known: names that will do, or what tells them.
        listed: names that the help lists, beside which others may do.
        check: is called with the value, or with each of a tuple's, and raises where it will not do.
        metavar: what stands for the value in the help.
        positional: given without its name.
    """
    about = {"quick": quick, "least": least, "known": known, "listed": listed, "check": check, "metavar": metavar}
    made: T = field(default=default, metadata={**about, "positional": positional, "typed": True})
    return made


def fixed(
    default: T, *, quick: T = _SAME, least: float | None = None, check: Callable[[Any], object] | None = None
) -> T:
    """A field that is set in Python only; ``--quick`` shortens it too."""
    made: T = field(default=default, metadata={"quick": quick, "least": least, "check": check, "typed": False})
    return made


def check_options(options: Any) -> None:
    """Raises ValueError where an option of a dataclass is less than it may be, or no known name."""
    for each in fields(options):
        value, about = getattr(options, each.name), each.metadata
        if value is None:
            continue
        if (least := about.get("least")) is not None:
            many = isinstance(value, Sequence)
            said, number = (f"the number of {each.name}", len(value)) if many else (each.name, value)
            if not number >= least:
                raise ValueError(f"{said} must be at least {least:g}, got {number}")
        for one in value if isinstance(value, tuple) else (value,):
            if known := about.get("known"):
                check_choice(singular(each.name), one, known() if callable(known) else known)
            if check := about.get("check"):
                check(one)


def singular(name: str) -> str:
    """What one of an option's values is called."""
    return name.removesuffix("s").replace("_", " ") if not name.endswith("ss") else name


def read(kind: type[Any], argv: Sequence[str], prog: str) -> dict[str, Any]:
    """The options as typed; what was not typed is its default, or with ``--quick`` its quick value.

    Raises:
        SystemExit: they make no sense; standard error says what.
    """
    import tyro

    hurried = "--quick" in argv
    hints = get_type_hints(kind, include_extras=True)
    defaults = {each.name: _default(each, hurried) for each in fields(kind)}
    annotated: Any = Annotated
    positional: Any = tyro.conf.Positional
    made: list[Any] = []
    for each in fields(kind):
        if not each.metadata.get("typed", True):
            continue
        hint = hints[each.name]
        if metavar := each.metadata.get("metavar"):
            hint = annotated[hint, tyro.conf.arg(metavar=metavar)]
        hint = positional[hint] if each.metadata.get("positional") else hint
        default = defaults[each.name]
        made.append((each.name, hint, field(default=tyro.MISSING if default is MISSING else default)))
    flat = make_dataclass(kind.__name__, made, frozen=True)
    typed: Any = tyro.cli(flat, args=list(argv), prog=prog)
    values: dict[str, Any] = {name: value for name, value in defaults.items() if value is not MISSING} | vars(typed)
    return values


def shortened(options: Any) -> str:
    """What ``--quick`` made of the options, in words; empty where it shortened nothing."""
    if not getattr(options, "quick", False):
        return ""
    changed = [
        f"{each.name.replace('_', ' ')} {_words(quick) or 'none'}"
        for each in fields(options)
        if (quick := each.metadata.get("quick", _SAME)) is not _SAME
        and getattr(options, each.name) == quick != each.default
    ]
    return f"--quick: {', '.join(changed)}" if changed else ""


class OptionRow(NamedTuple):
    """An option in the help."""

    name: str  # as typed
    said: str
    positional: bool
    required: bool


def rows(kind: type[Any]) -> Iterator[OptionRow]:
    """The options of a command, those that are given without a name first."""
    found = list(_rows(kind))
    yield from sorted(found, key=lambda row: not row.positional)


def _rows(kind: Any) -> Iterator[OptionRow]:
    hints, said = get_type_hints(kind, include_extras=True), docstrings(kind)
    for each in fields(kind):
        about = each.metadata
        if not about.get("typed", True):
            continue
        hint: Any = hints[each.name]
        extras: Sequence[Any] = ()
        if get_origin(hint) is Annotated:
            hint, *extras = get_args(hint)
        if is_dataclass(hint):
            nested: Any = hint
            yield from _rows(nested)
            continue
        metavar = about.get("metavar") or next((m for e in extras if (m := getattr(e, "metavar", ""))), "")
        positional = bool(about.get("positional")) or any("POSITIONAL" in str(e).upper() for e in extras)
        required = each.default is MISSING and each.default_factory is MISSING
        told = _said(each, kind, said.get(each.name, ""))
        yield OptionRow(_typed(each, hint, metavar, positional), told, positional, required)


def _typed(each: Field[Any], hint: Any, metavar: str, positional: bool) -> str:
    if hint is bool:
        return "--no-" * (each.default is True) + "--" * (each.default is not True) + each.name.replace("_", "-")
    if get_origin(hint) in (Union, UnionType):
        hint = next(part for part in get_args(hint) if part is not NoneType)
    many = get_origin(hint) is tuple
    item = get_args(hint)[0] if many else hint
    if get_origin(item) is Literal:
        metavar = "{" + ",".join(map(str, get_args(item))) + "}"
    metavar = (metavar or _METAVARS.get(item, "VALUE")) + " ..." * many
    return metavar if positional else f"--{each.name.replace('_', '-')} {metavar}"


def _said(each: Field[Any], kind: type[Any], text: str) -> str:
    about, parts = each.metadata, [" ".join(text.split())]
    for how, said in (("known", "One of"), ("listed", "There are")):
        if names := about.get(how):
            parts.append(f"{said} {', '.join(names() if callable(names) else names)}.")
    if each.name == "quick":
        changed = [
            f"{other.name.replace('_', ' ')} {_words(value) or 'none'}"
            for other in fields(kind)
            if (value := other.metadata.get("quick", _SAME)) is not _SAME
        ]
        parts.append(f"Unless asked otherwise: {', '.join(changed)}." if changed else "")
    elif each.default is MISSING and each.default_factory is MISSING:
        parts.append("Required.")
    elif not isinstance(each.default, bool) and (default := _words(each.default)):
        parts.append(f"Default: {default}.")
    return " ".join(part for part in parts if part)


def help_text(prog: str, kind: type[Any], about: str) -> str:
    """Usage, what the command does, and a paragraph an option, as wide as the terminal."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    every = list(rows(kind))
    given = (row.name if row.required else f"[{row.name}]" for row in every if row.positional)
    usage = " ".join(["usage:", prog, *given])
    named = any(not row.positional for row in every)
    lines = [f"{usage} [OPTIONS]" if named else usage]
    for paragraph in about.split("\n\n"):
        block = paragraph.rstrip()
        lines += ["", *(textwrap.wrap(" ".join(block.split()), width) if not _laid_out(block) else block.splitlines())]
    lines.append("")
    for row in every:
        lines += [f"  {row.name}", *(f"      {line}" for line in textwrap.wrap(row.said, width - 6))]
    return "\n".join(line.rstrip() for line in lines).replace("`", "") + "\n"


def _laid_out(paragraph: str) -> bool:
    """A table or an equation, whose lines are left as they are."""
    return any("    " in line.strip() or line.startswith("    ") for line in paragraph.splitlines())


@cache
def docstrings(kind: Any) -> dict[str, str]:
    """What is said under each field, or under ``Args:``, in the source of a class and of those it comes from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError):  # builtins have none
            continue
        found |= _under_args(inspect.getdoc(base) or "")
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for one, said in pairwise(body):
            match one, said:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = text
    return found


def _under_args(text: str) -> dict[str, str]:
    found: dict[str, str] = {}
    name = ""
    for line in text.partition("Args:\n")[2].splitlines():
        head, colon, rest = line.strip().partition(": ")
        if line.startswith("    ") and not line.startswith("     ") and colon:
            name, found[head] = head, rest[:1].upper() + rest[1:]
        elif name and line.startswith("     "):
            found[name] += " " + line.strip()
    return found


def _default(each: Field[Any], hurried: bool) -> Any:
    quick = each.metadata.get("quick", _SAME)
    return quick if hurried and quick is not _SAME else each.default


def _words(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(map(_words, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
