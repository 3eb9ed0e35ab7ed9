"""What the tests of the documentation share: which pages there are, and what stands in them."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"

FENCE = re.compile(r"^```([\w{}-]*)\n(.*?)^```\s*$", re.M | re.S)
BEFORE = re.compile(r"<!-- before\n(.*?)-->", re.S)
NEEDS = re.compile(r"<!-- needs: ([\w. ]+) -->\n\Z")
SMALL = re.compile(r"<!-- small: ([^\n]*) -->\n\Z")


class Block(NamedTuple):
    """A fenced block: its language, its text, the line it begins in, and the modules it runs with only."""

    language: str
    text: str
    line: int
    needs: tuple[str, ...] = ()


def written() -> list[Path]:
    """README, CONTRIBUTING, and every page of the documentation that is not made by a build."""
    made = (DOCS / "_build", DOCS / "reference" / "api", DOCS / "environments")
    pages = [p for p in sorted(DOCS.rglob("*.md")) if not any(p.is_relative_to(folder) for folder in made)]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def body(path: Path) -> str:
    """The text of a page below its front matter."""
    text = path.read_text(encoding="utf-8")
    return text.split("\n---\n", 1)[1] if text.startswith("---\n") else text


def small(block: str, before: str) -> str:
    """A block as it is tested, with the numbers of a comment above it: ``<!-- small: 60 -> 6; [:40] -> [:4] -->``.

    Each is replaced once, in the order given; one that does not occur is an error, so that comments stay true.
    """
    found = SMALL.search(before)
    for pair in found.group(1).split("; ") if found else []:
        long, short = pair.split(" -> ")
        assert long in block, f"{long!r} is to be replaced by {short!r} and does not occur in:\n{block}"
        block = block.replace(long, short, 1)
    return block


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page, small, and what has to be run before them."""
    text = path.read_text(encoding="utf-8")
    found: list[tuple[int, Block]] = []
    for match in (*FENCE.finditer(text), *BEFORE.finditer(text)):
        above = text[: match.start()]
        language, code = match.groups() if match.re is FENCE else ("python", match[1])
        needs = NEEDS.search(above)
        named = tuple(needs[1].split()) if needs else ()
        found.append((match.start(), Block(language, small(code, above), above.count("\n") + 2, named)))
    return [block for _, block in sorted(found)]


def tool(module: str) -> Any:
    """A module of ``docs``, which is no package."""
    for folder in (DOCS / "_ext", DOCS):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    return importlib.import_module(module)
