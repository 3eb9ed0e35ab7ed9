"""The docstrings of this package as reStructuredText: what they indent is an equation or a drawing, and stays as it is;
bars are absolute values, not substitutions."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx


def literal_blocks(lines: list[str]) -> list[str]:
    """``lines``, with ``::`` before each block that is indented below a blank line and a line that is not."""
    out: list[str] = []
    left = ""  # the last line with text
    for n, line in enumerate(lines):
        below_a_gap = n > 0 and not lines[n - 1].strip()
        if line.startswith(" ") and below_a_gap and left and not left.startswith(" "):
            out += ["::", ""]
        out.append(line if line.startswith(" ") else _plain(line))
        left = line if line.strip() else left
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

    app.connect("autodoc-process-docstring", before, priority=400)
    app.connect("autodoc-process-docstring", after, priority=600)  # napoleon reads the sections between them
    return {"parallel_read_safe": True, "parallel_write_safe": True}
