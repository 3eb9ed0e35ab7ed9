"""What pyproject.toml cannot say: on an index, where no file lies beside it, the README's links must be whole."""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
URLS = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]


def whole(link: re.Match[str]) -> str:
    """A link to a file of the repository: there, or no link where pyproject.toml does not say where that is."""
    mark, text, target = link.groups()
    if re.match(r"[a-z]+:|#", target):
        return link[0]
    home = URLS.get("Repository", "").rstrip("/")
    if not home:
        return "" if mark else text
    return f"{mark}[{text}]({home}/{'raw' if mark else 'blob'}/main/{target})"


text = (HERE / "README.md").read_text(encoding="utf-8")
setup(
    long_description=re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", whole, text),
    long_description_content_type="text/markdown",
)
