"""The docstrings of this package as reStructuredText: what they indent is an equation or a drawing, and stays as it is;
bars are absolute values, not substitutions."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

COLUMNS = re.compile(r"\S {3,}\S")


def literal_blocks(lines: list[str]) -> list[str]:
    """``lines``, with ``::`` before each block that is set in columns, or indented below one that is not."""
    out: list[str] = []
    left = ""  # the last line before
    for block in "\n".join(lines).strip("\n").split("\n\n"):
        part = block.strip("\n").split("\n")
        indented = part[0].startswith(" ")
        if not indented and any(COLUMNS.search(line) for line in part):
            part = ["::", "", *(f"    {line}" for line in part)]
        elif indented and left and not left.startswith(" "):
            part = ["::", "", *part]
        else:
            part = [line if line.startswith(" ") else _plain(line) for line in part]
        left = block.strip("\n").split("\n")[-1]
        out += [*part, ""]
    return out


def _plain(line: str) -> str:
    parts = line.split("``")
    return "``".join(part if n % 2 else part.replace("|", r"\|") for n, part in enumerate(parts))


def setup(app: Sphinx) -> dict[str, bool]:
    kept: dict[str, list[str]] = {}

    def before(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
        lines[:] = literal_blocks(lines)
        kept[name] = list(lines)

    def after(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
        if what in ("attribute", "data", "property"):  # napoleon takes what stands before a colon for a type
            lines[:] = kept[name]

    def nameless(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
        """Leaves out fields of named tuples that the docstring of their class explains."""
        return True if (getattr(obj, "__doc__", None) or "").startswith("Alias for field number") else None

    app.connect("autodoc-skip-member", nameless)
    app.connect("autodoc-process-docstring", before, priority=400)
    app.connect("autodoc-process-docstring", after, priority=600)  # napoleon reads the sections between them
    return {"parallel_read_safe": True, "parallel_write_safe": True}
