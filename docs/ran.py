"""What ran while a page was printed: which files, at which commit, on which machine; and what has changed since.

A file is known by git's own id of its content, so that a page printed from a tree that was never committed says what it
ran all the same, and a file that was moved is found again. Changed is what Python would run otherwise: a comment, a
docstring and the layout may be others.
"""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
HOOK = Path(__file__).resolve().parent / "_ran"
DIGITS = 12  # of git's 40, which tell 10,000 files apart


def noting(notes: Path) -> dict[str, str]:
    """The variables under which every Python that is started notes in ``notes`` what it runs and reads."""
    return {"PYTHONPATH": os.pathsep.join((str(HOOK), str(ROOT))), "PAGES_RAN": str(notes)}


def noted(notes: Path) -> dict[str, str]:
    """The files of this repository that are named in ``notes``, and the ids of their content."""
    lines = notes.read_text(encoding="utf-8").splitlines() if notes.exists() else []
    real = {Path(line).resolve() for line in lines}
    known = set(_git("ls-files", "--cached", "--others", "--exclude-standard").splitlines())
    names = sorted(str(path.relative_to(ROOT)) for path in real if path.is_file() and path.is_relative_to(ROOT))
    return {name: blob(ROOT / name) for name in names if name in known and HOOK not in (ROOT / name).parents}


def blob(path: Path) -> str:
    """Git's id of a file's content, shortened."""
    return _blob(path, path.stat().st_mtime_ns)


def blob_at(commit: str, name: str) -> str:
    """Git's id of what a file held at a commit, shortened; "" where it was not there, or git has no such commit."""
    return _git("rev-parse", "--quiet", "--verify", f"{commit}:{name}").strip()[:DIGITS]


@cache
def _blob(path: Path, _written: int) -> str:
    content = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()[:DIGITS]


def commit() -> str:
    """The commit of this tree, shortened; with a plus where a file that git knows has been edited since."""
    edited = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs/results", ":!docs/img")
    return _git("rev-parse", "--short=9", "HEAD").strip() + "+" * bool(edited.strip())


def machine() -> str:
    """What decides how numbers are rounded: the processor's family, and the kernels that OpenBLAS takes on it."""
    import numpy  # noqa: F401  # whose OpenBLAS it is
    import threadpoolctl

    said = {}
    if Path("/proc/cpuinfo").exists():
        for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines():
            name, _, value = line.partition(":")
            said[name.strip()] = value.strip()
    family = f"{said.get('model name', platform.processor())} ({platform.machine()}"
    if "cpu family" in said:
        family += f", family {said['cpu family']}, model {said['model']}"
    kernels = {p["architecture"] for p in threadpoolctl.threadpool_info() if p.get("internal_api") == "openblas"}
    return f"{family}), {os.cpu_count()} cores, OpenBLAS for {' and '.join(sorted(kernels)) or 'none'}"


def changed(files: Mapping[str, str]) -> list[str]:
    """Those of ``files`` (path to id) that this tree has no more, or whose code is another."""
    return [name for name, was in files.items() if not _is_same(name, was)]


def _is_same(name: str, was: str) -> bool:
    path = ROOT / name
    if not path.is_file():
        return was in _ids()  # moved, as it was
    if blob(path) == was:
        return True
    if path.suffix != ".py":
        return False
    old = _content(was)
    return old is not None and skeleton(old) == skeleton(path.read_bytes())


@cache
def _ids() -> frozenset[str]:
    """Of all files that git knows, so that one which was moved is found."""
    return frozenset(line.split()[1][:DIGITS] for line in _git("ls-files", "--stage").splitlines())


@cache
def _content(was: str) -> bytes | None:
    """What git keeps under an id; None where it keeps nothing, as in a shallow clone."""
    found = subprocess.run(["git", "cat-file", "blob", was], cwd=ROOT, capture_output=True, check=False)
    return found.stdout if found.returncode == 0 else None


def _git(*arguments: str) -> str:
    """What git says; nothing where there is no git, or no repository, as in a wheel's source."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""


@cache
def skeleton(source: bytes) -> bytes:
    """What is left of a module without comments, docstrings and layout."""
    return repr(list(_shape(ast.parse(source)))).encode()


def _shape(node: ast.AST) -> Iterator[Any]:
    """A syntax tree as nested tuples, without texts that stand alone, and alike in every version of Python."""
    yield type(node).__name__
    for name, value in ast.iter_fields(node):
        values: Iterable[Any] = value if isinstance(value, list) else [value][: value is not None]
        kept = [v for v in values if not _stands_alone(v)]
        if kept:
            yield name, tuple(tuple(_shape(v)) if isinstance(v, ast.AST) else repr(v) for v in kept)


def _stands_alone(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
