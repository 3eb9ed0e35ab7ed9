"""Pages of results, which know the command that printed them and the code that it measured.

The front matter of a page in ``docs/results`` says so:

    command: |
      asm-gym evaluate --quick --out runs/quick
    printed: runs/quick/results.md   what the command leaves; without it, what the command prints
    figures: {runs/quick/roc.png: docs/img/roc.png}
    rooms: [envs, memory, detection]
    version: 0.1.0
    date: 2026-11-22
    code: 3f2a…                      the digest of those rooms at that time
    stale: true                      the rooms have changed since

    python docs/pages.py                     lists the pages, and which are stale
    python docs/pages.py mark                writes `stale: true` where it is true
    python docs/pages.py print PAGE …        runs the command of a page, and replaces what it printed
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
BEGIN, END = "<!-- printed by the command above: edits are lost -->", "<!-- end of what was printed -->"
REQUIRED = ("command", "rooms", "version", "date", "code")


@dataclass(frozen=True)
class Page:
    """A page of results: what stands in its front matter, and the text below."""

    path: Path
    meta: dict[str, Any]
    text: str

    @classmethod
    def read(cls, path: Path) -> Page:
        """Raises ValueError where the front matter lacks something, or the text its place for what is printed."""
        raw = path.read_text(encoding="utf-8")
        _, _, rest = raw.partition("---\n")
        front, dashes, text = rest.partition("\n---\n")
        if not raw.startswith("---\n") or not dashes:
            raise ValueError(f"{path}: a page of results begins with front matter between two lines of ---")
        meta = yaml.safe_load(front)
        missing = [key for key in REQUIRED if key not in meta]
        if missing:
            raise ValueError(f"{path}: the front matter lacks {', '.join(missing)}")
        if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
            raise ValueError(f"{path}: what was printed must stand once between {BEGIN} and {END}")
        return cls(path, meta, text)

    def write(self) -> None:
        """Replaces the file at once, or not at all."""
        new = self.path.with_suffix(".new")
        front = yaml.dump(self.meta, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=10_000)
        new.write_text(f"---\n{front}---\n{self.text}", encoding="utf-8")
        new.replace(self.path)

    @property
    def is_old(self) -> bool:
        """The code that was measured is not the code of this tree."""
        return bool(self.meta["code"] != digest(self.meta["rooms"]))

    @property
    def says_so(self) -> bool:
        return bool(self.meta.get("stale", False))

    def marked(self) -> Page:
        """The same page, which says that it is stale if it is."""
        kept = {key: value for key, value in self.meta.items() if key != "stale"}
        return replace(self, meta=kept | ({"stale": True} if self.is_old else {}))

    def printed_anew(self, printed: str) -> Page:
        """The same page with ``printed`` in place of what was printed before, by the code of this tree."""
        from asm_gym import __version__

        before, _, rest = self.text.partition(BEGIN)
        _, _, after = rest.partition(END)
        fresh = {"version": __version__, "date": date.today(), "code": digest(self.meta["rooms"])}
        text = f"{before}{BEGIN}\n\n{printed.strip()}\n\n{END}{after}"
        return replace(self, meta=self.meta | fresh, text=text).marked()


class _Dumper(yaml.SafeDumper):
    """YAML in which text of several lines stands as it is."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _text)


def pages() -> list[Page]:
    """All pages of results, by name."""
    return [Page.read(path) for path in sorted(RESULTS.glob("*.md")) if path.name != "index.md"]


def digest(rooms: Iterable[str], package: Path = ROOT / "asm_gym") -> str:
    """Of the code in ``rooms`` (folders or modules of the package), whatever its comments, docstrings and layout.

    Raises:
        FileNotFoundError: there is no such room.
    """
    made = hashlib.sha256()
    for room in rooms:
        place = package / room
        if not place.exists():
            raise FileNotFoundError(f"{place}: no such room of the package")
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            made.update(str(path.relative_to(package)).encode())
            made.update(_skeleton(path.read_bytes()))
    return made.hexdigest()[:16]


@cache
def _skeleton(source: bytes) -> bytes:
    """What is left of a module without comments, docstrings and layout; many pages measure the same ones."""
    return repr(list(_shape(ast.parse(source)))).encode()


def _shape(node: ast.AST) -> Iterator[Any]:
    """A syntax tree as nested tuples, without texts that stand alone, and alike in every version of Python."""
    yield type(node).__name__
    for name, value in ast.iter_fields(node):
        values = value if isinstance(value, list) else [value][: value is not None]
        kept = [v for v in values if not _stands_alone(v)]
        if kept:
            yield name, tuple(tuple(_shape(v)) if isinstance(v, ast.AST) else repr(v) for v in kept)


def _stands_alone(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def run(page: Page) -> Page:
    """The page as its command prints it now.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    there = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    command = ["bash", "-e", "-c", page.meta["command"]]
    said = subprocess.run(command, cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True, check=True).stdout
    out = re.sub(r"(?m)^.*: (\d+ of \d+, )?(done in )?\d+ s\n", "", said)  # how far it had come is no result
    for made, kept in page.meta.get("figures", {}).items():
        shutil.copyfile(ROOT / made, ROOT / kept)
    if "printed" in page.meta:
        return page.printed_anew((ROOT / page.meta["printed"]).read_text(encoding="utf-8"))
    lines = "\n".join(line.rstrip() for line in out.strip("\n").splitlines())
    return page.printed_anew(f"```text\n{lines}\n```")


def main(argv: list[str]) -> int:
    match argv:
        case []:
            for page in pages():
                print(f"{'stale' if page.is_old else 'fresh'}  {page.path.relative_to(ROOT)}")
        case ["mark"]:
            for page in pages():
                page.marked().write()
        case ["print", *names] if names:
            for name in names:
                run(Page.read(ROOT / name)).write()
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
