"""How Sphinx builds these pages: nothing is fetched, while they are built or while they are read."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE), str(HERE.parent)]

from asm_gym import __version__  # noqa: E402

project = "asm-gym"
author = "the asm-gym authors"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "docstrings",
    "environments",
    "printed",
    "reference",
]
exclude_patterns = ["_build"]
suppress_warnings = ["ref.python"]  # one noun in two rooms, in the signature of a third
nitpicky = False  # what a signature names need not have a page: NumPy's types, for example

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = "asm-gym"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_copy_source = False
