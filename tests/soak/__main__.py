"""Prints what the package survives: hostile calls by verdict, kills, full disks, two at once, and long guarded runs."""

from __future__ import annotations

import json
import math
import shutil
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.scripts.command import BAD_NEWS, DONE, run
from asm_gym.validation import check_choice, check_number
from tests.soak import guard, kills, verdicts
from tests.soak.kills import WORKS

SHARES = {"calls": 0.885, "command lines": 0.026, "files": 0.089}
"""Of the hostile cases: as in the campaign that found what this one looks for again."""
SHARE_OF_LIFT = 0.02
"""Steps of Lift for each of the synthetic arm: one costs fifteen times as much."""
MOST_GROWTH = 5.0
"""Of a process from the end of its first tenth on [%]."""
MOST_RAW = 0.01
"""Share of refusals in words that name neither argument nor value."""


@dataclass(frozen=True)
class Args:
    """An hour of what a minute of tests cannot show."""

    cases: int = 100_000
    """Hostile calls, command lines and files in all; 0 leaves them out, and so on."""
    kills: int = 100
    """Kills in all, shared out among the works."""
    works: tuple[str, ...] = WORKS
    """What is killed; ``react`` goes on with what ``evaluate`` left."""
    steps: int = 1_000_000
    """Guarded steps of the synthetic arm; a fiftieth as many are of Lift."""
    seed: int = 0
    """Of all that is drawn."""
    out: Path = Path("runs/soak")
    """Folder to work in; it must be empty, or one of a soak."""

    def __post_init__(self) -> None:
        for name in ("cases", "kills", "steps", "seed"):
            check_number(name, getattr(self, name), low=0, whole=True)
        if 0 < self.steps < 1000:
            raise ValueError(f"steps must be 0, or at least 1000 for a table by tenths, got {self.steps}")
        for work in self.works:
            check_choice("work", work, WORKS)
        if "react" in self.works and "evaluate" not in self.works:
            raise ValueError(f"react goes on with what evaluate left, got works {', '.join(self.works)}")


def soak(args: Args, console: Console) -> int:
    """Prints the tables; 1 where something was lost, let in, or said badly."""
    mark = args.out / "soak"
    if args.out.exists() and any(args.out.iterdir()) and not mark.exists():
        raise ValueError(f"{args.out} is not empty, and no folder of a soak: name another --out")
    shutil.rmtree(args.out, ignore_errors=True)
    args.out.mkdir(parents=True)
    mark.touch()
    good = [part(args, console) for part in (hostile, killed, guarded)]
    return DONE if all(good) else BAD_NEWS


def hostile(args: Args, console: Console) -> bool:
    """Hostile cases by verdict; ``cases.jsonl`` holds all of them."""
    if not args.cases:
        return True
    judged: list[verdicts.Judged] = []
    with (args.out / "cases.jsonl").open("w", buffering=1) as kept:
        for area, share in SHARES.items():
            with tempfile.TemporaryDirectory(dir=args.out) as place:
                for one in verdicts.shard(area, args.seed, math.ceil(share * args.cases), Path(place)):
                    judged.append(one)
                    kept.write(json.dumps(one) + "\n")
    rows = verdicts.counted(judged)
    console.print(ConsoleTable(Table("hostile cases by verdict", ("area", "cases", *verdicts.VERDICTS), rows)))
    bad = [j for j in judged if j.verdict not in ("fine", "clear")]
    for j in list({(j.verdict, j.said[:40]): j for j in bad}.values())[:20]:  # each that was said, once
        console.print(ascii(f"{j.verdict}: {j.case}: {j.said}"[:200]), markup=False, highlight=False)
    refused = sum(j.verdict in ("clear", "raw") for j in judged)
    raw = sum(j.verdict == "raw" for j in judged)
    console.print(f"refused in words that name neither argument nor value: {100 * raw / max(1, refused):.2f} %")
    return len(bad) == raw <= MOST_RAW * refused


def killed(args: Args, console: Console) -> bool:
    """Kills, full disks, and two at once."""
    if not args.kills:
        return True
    rng, found, out = np.random.default_rng(args.seed), [], args.out.resolve()
    works = [work for work in kills.commands() if work.name in args.works]
    for k, work in enumerate(works):
        share = args.kills // len(works) + (k < args.kills % len(works))
        found.append(kills.killed_and_begun_again(work, out / work.name, share, rng))
        if work.name != "save":
            found += [kills.out_of_disk(work, out / work.name), kills.two_at_once(work, out / work.name)]
    title = "killed, out of disk, two at once: exit codes (-9 killed, 2 refused in a line), and whether the end is one"
    console.print(ConsoleTable(Table(title, ("what", "times", "exit codes", "same end"), [f.row for f in found])))
    return all(f.same for f in found)


def guarded(args: Args, console: Console) -> bool:
    """Guarded steps under failing sensors and policies: of a synthetic arm, and fewer of Lift."""
    if not args.steps:
        return True
    parts = {"synthetic arm": (guard.arm, args.steps), "Lift": (guard.lift, math.ceil(args.steps * SHARE_OF_LIFT))}
    found = {}
    for name, (made, steps) in parts.items():
        tell = partial(_tell, name, steps)
        found[name] = guard.guarded(made(), steps, args.seed, tell)
    names = "robot", "steps", "episodes", "in alarm", "sensor or policy failed", "without alarm", "bad actions done"
    counts = [(n, *map(str, f[:6]), f"{f.growth:+.1f} %") for n, f in found.items()]
    console.print(ConsoleTable(Table("guarded steps", (*names, "memory grew"), counts)))
    tenths = [(n, *(f"{size:.0f}" for size in f.sizes)) for n, f in found.items()]
    title = "resident memory of the process after each tenth of the steps [MB]"
    console.print(ConsoleTable(Table(title, ("robot", *(f"{k}0 %" for k in range(1, 11))), tenths)))
    return all(not (f.missed or f.let_through) and f.growth < MOST_GROWTH for f in found.values())


def _tell(name: str, steps: int, done: int, size: float) -> None:
    print(f"{name}: {done} of {steps} steps, {size:.0f} MB", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(run("soak", Args, soak, about=__doc__))
