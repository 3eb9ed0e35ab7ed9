"""Hostile calls, command lines and files, each with a verdict; every shard of them is a process of its own.

A verdict is ``fine``, ``clear`` (refused by an error that names an argument, a value or a file), ``raw`` (refused in
words that name neither), ``silent`` (a damaged file was read as another), ``crash`` (the process died) or ``hang``.
"""

from __future__ import annotations

import json
import os
import queue
import re
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
VERDICTS = ("fine", "clear", "raw", "silent", "crash", "hang")
HANG_S = 120.0
"""How long a case may take [s]."""
IMPORTS_S = 600.0
"""The same of imports and compilation, on a busy machine [s]."""


class Judged(NamedTuple):
    """A case and what became of it."""

    area: str
    case: str
    verdict: str
    said: str = ""


def judge(call: Callable[..., Any], arguments: dict[str, Any], hostile: dict[str, Any]) -> tuple[str, str]:
    """The verdict of one call, and what it said.

    Args:
        arguments: of the call, hostile ones included.
        hostile: those that are not what they should be, by name.
    """
    try:
        call(**arguments)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        said = f"{type(error).__name__}: {error}"[:300]
        return ("clear" if names(said, hostile) else "raw"), said
    return "fine", ""


CALLED = {"x": "stream"}
"""What an argument is called in words, where its name is a letter."""


def names(said: str, hostile: dict[str, Any]) -> bool:
    """Whether an error names one of the arguments or values that are to blame, as words of their own."""
    said = said.lower()
    for name, value in hostile.items():
        words = {
            w for n in (name, name.removesuffix("s"), CALLED.get(name, name)) for w in (n, n.replace("_", " "), f"{n}s")
        }
        with suppress(Exception):  # a value may have no text
            words |= {repr(value)[:20], str(value)[:20], getattr(value, "__name__", "")}
        if any(re.search(rf"(?<!\w){re.escape(w.lower())}", said) for w in words if w.strip()):
            return True
    return False


def shard(
    area: str, seed: int, cases: int, folder: Path, program: Sequence[str] = ("-m", "tests.soak.cases")
) -> Iterator[Judged]:
    """The verdicts of so many cases of an area, by processes that are replaced where they die."""
    first = 0
    while first < cases:
        command = [sys.executable, *program, area, str(seed), str(first), str(cases)]
        there = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
        process = subprocess.Popen(
            command, cwd=folder, env=there, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        lines: queue.Queue[str | None] = queue.Queue()
        assert process.stdout is not None
        threading.Thread(target=_read, args=(process.stdout, lines), daemon=True).start()
        begun = "imports"
        while True:
            try:
                line = lines.get(timeout=IMPORTS_S if begun == "imports" else HANG_S)
            except queue.Empty:
                process.kill()
                yield Judged(area, begun, "hang")
                break
            if line is None:
                if begun == "imports":
                    raise RuntimeError(
                        f"the cases of {area} cannot be imported: python -m tests.soak.cases {area} 0 0 1"
                    )
                if first < cases:
                    yield Judged(area, begun, "crash", f"exit code {process.wait()}")
                break
            told = json.loads(line)
            if "begin" in told:
                begun = told["begin"]
            else:
                first += 1
                yield Judged(area, begun, told["verdict"], told["said"])
        first += first < cases  # the one that took the process along
        process.wait()


def _read(stream: Any, lines: queue.Queue[str | None]) -> None:
    for line in stream:
        if line.startswith("{"):
            lines.put(line)
    lines.put(None)


def counted(judged: list[Judged]) -> list[tuple[str, ...]]:
    """A row for each area: how many cases, and how many of each verdict."""
    rows = []
    for area in dict.fromkeys(j.area for j in judged):
        own = Counter(j.verdict for j in judged if j.area == area)
        rows.append((area, str(own.total()), *(str(own[v]) for v in VERDICTS)))
    total = Counter(j.verdict for j in judged)
    return [*rows, ("all", str(total.total()), *(str(total[v]) for v in VERDICTS))]
