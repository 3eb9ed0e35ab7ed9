"""A page of reference for each room of the package, and one for the commands, written anew with every build."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

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
    """The members of each module of ``names``, by autodoc."""
    parts = [f"# {title}"]
    for name in names:
        heading = [f"## {name}"] if name != title else []
        parts += [*heading, f"```{{eval-rst}}\n.. automodule:: {name}\n   :ignore-module-all:\n```"]
    return "\n\n".join(parts) + "\n"


def commands() -> str:
    """Every command: what it is for, and its arguments."""
    table = import_module("asm_gym.scripts.cli").COMMANDS
    parts = ["# Commands", "`asm-gym COMMAND --help` says the same."]
    for name, command in table.items():
        parts += [f"## asm-gym {name}", command.summary[:1].upper() + command.summary[1:] + "."]
        if hasattr(import_module(command.module), "Args"):
            members = f".. autoclass:: {command.module}.Args\n   :exclude-members: __init__, __new__"
            parts.append(f"```{{eval-rst}}\n{members}\n```")
    return "\n\n".join(parts) + "\n"


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
