"""Sphinx configuration: the guides in MyST, the API from docstrings, the commands from their help."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from asm_gym import __version__  # noqa: E402
from asm_gym.scripts.cli import COMMANDS  # noqa: E402

project = html_title = "asm-gym"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build"]
# docstrings are plain text first, reStructuredText second
suppress_warnings = [
    "ref.python",
    "docutils",
]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4

apidoc_modules = [
    {
        "path": "../asm_gym",
        "destination": "reference/api",
        "follow_links": True,
        "exclude_patterns": ["../asm_gym/scripts*"],
        "module_first": True,
    }
]
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}
napoleon_use_ivar = True

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False


def write_commands(app: Sphinx) -> None:
    """Write ``reference/commands.md``: what ``asm-gym COMMAND --help`` prints, command by command."""
    parts = ["# Commands"]
    for name in COMMANDS:
        command = [sys.executable, "-m", "asm_gym", name, "--help"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=HERE.parent)
        parts.append(f"## asm-gym {name}\n\n```text\n{done.stdout.strip()}\n```")
    (HERE / "reference" / "commands.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def indented_blocks_are_literal(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Mark the equations and drawings of a docstring, which are indented, as literal blocks; escape its bars."""
    out: list[str] = []
    for block in "\n".join(lines).split("\n\n"):
        if block.startswith(" ") and out and not out[-1].startswith(" "):
            out.append("::")
        if not block.startswith(" "):
            parts = block.split("``")
            block = "``".join(
                part if n % 2 else part.replace("|", r"\|") for n, part in enumerate(parts)
            )
        out.append(block)
    lines[:] = "\n\n".join(out).split("\n")


def setup(app: Sphinx) -> None:
    """Register the page of commands and the reader of docstrings."""
    app.connect("builder-inited", write_commands)
    app.connect("autodoc-process-docstring", indented_blocks_are_literal, priority=400)
