"""A page of reference for each room of the package, and one for the commands, written anew with every build."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

from asm_gym.scripts.options import rows as option_rows

ROOMS = (
    "data",
    "envs",
    "faults",
    "memory",
    "detection",
    "monitors",
    "evaluation",
    "policies",
    "wrappers",
    "rollouts",
    "view",
)


def modules(package: Path, room: str = "") -> Iterator[str]:
    """Names of a room's modules, the room itself first; of the package's own modules where ``room`` is empty."""
    place = package / room
    found = sorted(place.rglob("*.py") if room else place.glob("*.py"))
    names = (".".join((package.name, *path.relative_to(package).with_suffix("").parts)) for path in found)
    public = (name.removesuffix(".__init__") for name in names if not name.endswith("__main__"))
    return iter(sorted(public))


def page(title: str, names: list[str]) -> str:
    """What a room hands out, in a table; then the members of each module of ``names``, by autodoc."""
    parts = [f"# {title}", public(title)]
    for name in names:
        heading = [f"## {name}"] if name != title else []
        parts += [*heading, f"```{{eval-rst}}\n.. automodule:: {name}\n   :ignore-module-all:\n```"]
    return "\n\n".join(part for part in parts if part) + "\n"


def public(room: str) -> str:
    """A row for each name in the ``__all__`` of a room, with the first sentence that is said of it."""
    module = import_module(room)
    rows = []
    for name in sorted(getattr(module, "__all__", ()), key=str.lower):
        value = getattr(module, name)
        if callable(value):  # constants stand below
            rows.append(f"| {{py:obj}}`{name} <{value.__module__}.{name}>` | {_first(value)} |")
    return "\n".join((f"`from {room} import …`:", "", "| name | |", "|---|---|", *rows)) if rows else ""


def _first(value: object) -> str:
    """The first sentence of a docstring as Markdown."""
    line = " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split()).split(". ")[0].rstrip(".")
    return re.sub(r":\w+:`~?([^`]*)`|``([^`]*)``", lambda m: f"`{m[1] or m[2]}`", line).replace("|", r"\|")


def commands() -> str:
    """Every command: what it is for, and a table of its options; of one with parts, a table for each."""
    parts = ["# Commands", "`asm-gym COMMAND --help` says the same."]
    for name, command in import_module("asm_gym.scripts.cli").COMMANDS.items():
        module = import_module(command.module)
        parts += [f"## asm-gym {name}", command.summary[:1].upper() + command.summary[1:] + "."]
        if hasattr(module, "Args"):
            parts.append(options(module.Args))
        for part, kind in (getattr(module, "BENCHMARKS", {}) | getattr(module, "STUDIES", {})).items():
            kind = module.options_of(part) if hasattr(module, "options_of") else kind
            parts += [f"### asm-gym {name} {part}", (kind.__doc__ or "").split("\n\n")[0], options(kind)]
    return "\n\n".join(part for part in parts if part) + "\n"


def options(kind: type) -> str:
    """A row for each option of a command."""
    rows = [f"| `{row.name}` | {row.said.replace('|', chr(92) + '|')} |" for row in option_rows(kind)]
    return "\n".join(("| option | |", "|---|---|", *rows)) if rows else ""


def write(folder: Path, package: Path) -> None:
    """One Markdown file a room; a file that would not change is left alone, so that it is not built again."""
    texts = {"asm_gym": page("asm_gym", list(modules(package))), "commands": commands()}
    texts |= {room: page(f"asm_gym.{room}", list(modules(package, room))) for room in ROOMS}
    folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    source = Path(app.srcdir)
    app.connect("builder-inited", lambda app: write(source / "reference" / "api", source.parent / "asm_gym"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
