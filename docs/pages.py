"""Pages of results, which know the command that printed them and what it ran.

The front matter of a page in ``docs/results`` says so:

    command: |
      asm-gym evaluate --quick --out runs/quick
    printed: runs/quick/results.md   what the command leaves, one file or several; without it, what the command prints
    figures: {runs/quick/roc.png: docs/img/roc.png}
    reads: {runs/evaluate: detection}   what the command reads, and the page whose command makes that
    check: asm-gym evaluate … --out $CHECK   at most 30 s of a core; CHECK: an empty folder
    tolerance: 0.05                  of the check's numbers, relative
    version: 0.1.0
    date: 2026-11-22
    commit: 3f2a1b4c5
    machine: AMD EPYC (x86_64, family 25, model 17), 2 cores, OpenBLAS for SkylakeX
    seconds: 812                     what printing took
    processor: 1540                  what it cost, in seconds of a core: the same on a busy machine

Beside the pages, in ``ran/NAME.json``, stand the files that the command ran, each with git's id of its content, and
what the check printed. What has changed since is found out by whoever asks: the site, or this list.

    python docs/pages.py                     lists the pages, what has changed since, and what each costs
    python docs/pages.py print PAGE …        runs the command of a page, and replaces what it printed
    python docs/pages.py all [--again]       prints all that something has changed for; or all not of this commit
    python docs/pages.py check PAGE …        keeps what the check of a page prints now
    python docs/pages.py verify [PAGE …]     runs the checks, and says which print something else
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

import ran
import yaml
from kept import TOLERANCE, different, rounded

ROOT = ran.ROOT
RESULTS = ROOT / "docs" / "results"
ARCHIVE = RESULTS / "archive"
BEGIN, END = "<!-- printed by the command above: edits are lost -->", "<!-- end of what was printed -->"
REQUIRED = ("command", "version", "date", "commit")
MOST = 20  # live pages
ALLOWED = 30.0  # for a check [s of a core]
MOST_SAID = 12  # lines that a check prints otherwise


@dataclass(frozen=True)
class Page:
    """A page of results: what stands in its front matter, the text below, and what is kept beside it."""

    path: Path
    meta: dict[str, Any]
    text: str
    kept: dict[str, Any] = field(default_factory=dict)

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
        meta["commit"] = str(meta["commit"])  # one of digits alone is a number in YAML
        beside = _beside(path)
        kept = json.loads(beside.read_text()) if beside.is_file() else {}
        return cls(path, meta, text, kept)

    def write(self) -> None:
        """Replaces each file at once, or not at all."""
        if self.kept:
            _replace(_beside(self.path), json.dumps(self.kept, indent=1) + "\n")
        _replace(self.path, f"---\n{_yaml(self.meta)}---\n{self.text.rstrip()}\n")

    @property
    def files(self) -> dict[str, str]:
        """What the command ran, or else its check: path to id; empty where neither was recorded."""
        return dict(self.kept.get("files") or self.kept.get("check", {}).get("files", {}))

    @property
    def changed(self) -> list[str]:
        """What it ran and is another today."""
        return ran.changed(self.files)

    @property
    def name(self) -> str:
        return str(self.path.relative_to(ROOT)) if self.path.is_relative_to(ROOT) else str(self.path)

    def printed_anew(self, printed: str) -> Page:
        """The same page with ``printed`` in place of what was printed before."""
        before, _, rest = self.text.partition(BEGIN)
        _, _, after = rest.partition(END)
        return replace(self, text=f"{before}{BEGIN}\n\n{printed.strip()}\n\n{END}{after}")


def _beside(page: Path) -> Path:
    """The file that holds what a page's command ran."""
    return page.parent / "ran" / f"{page.stem}.json"


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    new = path.with_suffix(".new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)


class _Dumper(yaml.SafeDumper):
    """YAML in which text of several lines stands as it is."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _text)


def _yaml(value: dict[str, Any]) -> str:
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=10_000))


def pages(folder: Path = RESULTS) -> list[Page]:
    """The pages of results in a folder, by name: live ones, or those in ``ARCHIVE``."""
    return [Page.read(path) for path in sorted(folder.glob("*.md")) if path.name != "index.md"]


def run(page: Page) -> Page:
    """The page as its command prints it now, and what it ran.

    Raises:
        subprocess.CalledProcessError: the command failed.
    """
    from asm_gym import __version__

    began, spent = time.monotonic(), _processor()
    said, files = _said(page.meta["command"])
    cost = {"seconds": round(time.monotonic() - began), "processor": round(_processor() - spent)}
    for made, kept in page.meta.get("figures", {}).items():
        shutil.copyfile(ROOT / made, ROOT / kept)
    if "printed" in page.meta:
        left = ((ROOT / path).read_text(encoding="utf-8").strip() for path in page.meta["printed"].split())
        page = page.printed_anew("\n\n".join(left))
    else:
        page = page.printed_anew(f"```text\n{said}\n```")
    fresh = {"version": __version__, "date": date.today(), "commit": ran.commit(), "machine": ran.machine()}
    page = replace(page, meta=page.meta | fresh | cost, kept={"files": files})
    return checked(page) if "check" in page.meta else page


def _processor() -> float:
    """Seconds of a core that commands have had until now, with all that they started and waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


def checked(page: Page) -> Page:
    """The page with what its check prints now, and which files that ran where those of its command are not known."""
    said, files = _said(page.meta["check"])
    check: dict[str, Any] = {"commit": ran.commit(), "printed": rounded(said) + "\n"}
    if "files" not in page.kept:
        check["files"] = {name: ran.blob_at(page.meta["commit"], name) for name in files}
    return replace(page, kept=page.kept | {"check": check})


def _said(command: str) -> tuple[str, dict[str, str]]:
    """What a command prints, and which files of the repository it ran and read."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    with tempfile.TemporaryDirectory() as folder:
        notes = Path(folder) / "ran.txt"
        there = os.environ | {"PATH": path, "COLUMNS": "120", "CHECK": folder} | ran.noting(notes)
        done = subprocess.run(
            ["bash", "-e", "-c", command], cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True, check=True
        )
        files = ran.noted(notes)
    out = re.sub(r"(?m)^.*: (\d+ of \d+, )?(done in )?\d+ s\n", "", done.stdout)  # how far it had come is no result
    return "\n".join(line.rstrip() for line in out.strip("\n").splitlines()), files


def state(page: Page) -> str:
    """In words: what has changed since the page was printed."""
    if not page.files:
        return "which files it ran was not recorded"
    changed, count = len(page.changed), len(page.files)
    files = f"of its {count} files" if "files" in page.kept else f"of the {count} files that its check runs"
    return f"{changed or 'none'} {files} changed since"


def to_print(live: list[Page], again: bool) -> list[Page]:
    """Those that something has changed for, or that are not of this commit; what another reads stands before it."""
    here = ran.commit()
    due = [p for p in live if (p.meta["commit"] != here if again else not p.files or p.changed)]
    by_name = {page.path.stem: page for page in live}
    ordered: list[Page] = []
    for page in due:
        for folder, maker in page.meta.get("reads", {}).items():
            if by_name[maker] not in ordered and (by_name[maker] in due or not (ROOT / folder).exists()):
                ordered.append(by_name[maker])
        if page not in ordered:
            ordered.append(page)
    return ordered


def print_all(again: bool) -> int:
    """Prints what is due, a page at a time; one that fails is left as it was, and named at the end."""
    due, failed = to_print(pages(), again), []
    print(f"{len(due)} of {len(pages())} pages to print: {_total(due)}")
    for page in due:
        print(f"{page.name}: {_cost(page)} the last time; {state(page)}", flush=True)
        try:
            page = run(page)
            page.write()
            print(f"{page.name}: {_cost(page)}", flush=True)
        except (OSError, subprocess.CalledProcessError) as error:
            failed.append(page.name)
            print(f"{page.name}: {error}", file=sys.stderr)
    print(f"failed: {', '.join(failed)}" if failed else "all pages are printed")
    return int(bool(failed))


def verify(live: list[Page]) -> int:
    """Runs the checks; 1 where one prints something else, or takes longer than it may."""
    wrong = unkept = 0
    began = _processor()
    for page in live:
        if "check" not in page.kept:
            print(f"{page.name}: nothing is kept of a check")
            unkept += 1
            continue
        before = _processor()
        try:
            said, _ = _said(page.meta["check"])
        except subprocess.CalledProcessError as error:
            said = str(error)
        seconds = _processor() - before
        differences = different(page.kept["check"]["printed"], said, page.meta.get("tolerance", TOLERANCE))
        late = f"; {ALLOWED:.0f} are allowed" if seconds > ALLOWED else ""
        verdict = "prints something else: superseded" if differences else "holds"
        more = [f"and {(len(differences) - MOST_SAID) // 2} more"] if len(differences) > MOST_SAID else []
        shown = [*differences[:MOST_SAID], *more]
        print(f"{page.name}: {verdict}, {seconds:.0f} s of a core{late}", *shown, sep="\n    ", flush=True)
        wrong += bool(differences)
    spent = f"{_processor() - began:.0f} s of a core"
    print(f"{wrong} of {len(live)} pages are superseded, {unkept} were not checked; {spent}")
    return int(wrong > 0)


def _cost(page: Page) -> str:
    """Of the last printing: of a core, or by the clock where that is not known."""
    minutes = _minutes(page)
    return "not timed" if minutes is None else f"{minutes:.1f} min{' of a core' * ('processor' in page.meta)}"


def _minutes(page: Page) -> float | None:
    seconds = page.meta.get("processor", page.meta.get("seconds"))
    return None if seconds is None else seconds / 60


def _total(some: list[Page]) -> str:
    known = [minutes for minutes in map(_minutes, some) if minutes is not None]
    return f"{sum(known) / 60:.1f} h, and {len(some) - len(known)} that were not timed yet"


def main(argv: list[str]) -> int:
    match argv:
        case []:
            for page in pages():
                print(f"{page.name}: {page.meta['commit']}, {page.meta['date']}, {state(page)}; {_cost(page)}")
            print(f"all {len(pages())}: {_total(pages())}")
        case ["print", *names] if names:
            for name in names:
                run(Page.read(ROOT / name)).write()
        case ["all"] | ["all", "--again"]:
            return print_all(argv[1:] == ["--again"])
        case ["check", *names] if names:
            for name in names:
                checked(Page.read(ROOT / name)).write()
        case ["verify", *names]:
            return verify([Page.read(ROOT / name) for name in names] or pages())
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
