"""Sphinx configuration: the guides in MyST, the API from docstrings, the commands from their help."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from asm_gym import __version__  # noqa: E402
from asm_gym.scripts.cli import COMMANDS  # noqa: E402

project = "asm-gym"
author = "the asm-gym authors"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.apidoc", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
suppress_warnings = ["ref.python", "docutils"]  # docstrings are plain text first, reStructuredText second

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
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "asm-gym"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_copy_source = False


def write_commands(app: Sphinx) -> None:
    """Write ``reference/commands.md``: what ``asm-gym COMMAND --help`` prints, command by command."""
    parts = ["# Commands"]
    for name in COMMANDS:
        command = [sys.executable, "-m", "asm_gym.scripts.cli", name, "--help"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=HERE.parent)
        parts.append(f"## asm-gym {name}\n\n```text\n{done.stdout.strip()}\n```")
    (HERE / "reference" / "commands.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def inline_math(translator: Any, node: nodes.math) -> None:
    """Write an equation in a line as MathML, which browsers draw without a script."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def display_math(translator: Any, node: nodes.math_block) -> None:
    """Write an equation of its own line as MathML."""
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def indented_blocks_are_literal(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Mark the equations and drawings of a docstring, which are indented, as literal blocks; escape its bars."""
    out: list[str] = []
    for block in "\n".join(lines).split("\n\n"):
        if block.startswith(" ") and out and not out[-1].startswith(" "):
            out.append("::")
        parts = block.split("``")
        plain = (
            block
            if block.startswith(" ")
            else "``".join(p if n % 2 else p.replace("|", r"\|") for n, p in enumerate(parts))
        )
        out.append(plain)
    lines[:] = "\n\n".join(out).split("\n")


def setup(app: Sphinx) -> None:
    """Register the page of commands, the renderer of equations and the reader of docstrings."""
    app.connect("builder-inited", write_commands)
    app.connect("autodoc-process-docstring", indented_blocks_are_literal, priority=400)
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
