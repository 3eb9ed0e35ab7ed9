"""Kill commands at random moments, begin them again, and compare what they leave with an undisturbed run.

    python -m tests.kills --kills 20

Each command runs once undisturbed and is timed. Then it is started, killed (SIGKILL) after a random part of that time
and started again, until it has been killed as often as asked. It must leave the same results, bit by bit, and no
unfinished file. With a full disk a command must be refused, and then reach the same results once there is room.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.episode import load_episode
from asm_gym.files import UNFINISHED
from asm_gym.scripts import cli

# no file can grow larger in a run whose disk is full [bytes]; less than an episode takes
FULL = 20 * 1024

EVALUATE = """evaluate --tasks Lift --monitors kalman --faults push --severities strong
    --fit-episodes 2 --calibration-episodes 5 --nominal-episodes 1 --faulty-episodes 1
    --false-alarm-rate 0.2"""


class Work(NamedTuple):
    """A command, and how to read what it left in its folder."""

    line: str
    results: Callable[[Path], Any]


def episodes_in(folder: Path) -> Any:
    """Return every number of the recorded episodes."""
    found = [load_episode(path) for path in sorted((folder / "episodes").glob("*.npz"))]
    return [(e.stream.tobytes(), e.actions.tobytes(), e.success, e.seed) for e in found]


def tables_in(folder: Path) -> Any:
    """Return the text of the printed tables."""
    return {path.name: path.read_text() for path in sorted(folder.glob("*.md"))}


WORKS = {
    "collect": Work("collect Lift --episodes 3", episodes_in),
    "evaluate": Work(EVALUATE, tables_in),
}


def start(work: Work, folder: Path, full_disk: bool = False) -> int:
    """Start the command in a process group of its own. Return the process."""
    process = os.fork()
    if process:
        return process
    os.setpgid(0, 0)
    code = 70  # a command that raises has no exit code of its own
    with contextlib.suppress(BaseException), open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        if full_disk:
            resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))
        folder.mkdir(parents=True, exist_ok=True)
        code = cli.main([*work.line.split(), "--workers", "1", "--seed", "3", "--out", str(folder)])
    os._exit(code)


def wait(process: int) -> int:
    """Return the exit code of a process, negative for the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def survives_kills(work: Work, root: Path, kills: int, rng: np.random.Generator) -> bool:
    """Return whether a command that is killed ``kills`` times still reaches the results of an undisturbed run."""
    began = time.monotonic()
    if wait(start(work, root / "whole")) != 0:
        return False
    seconds, expected = time.monotonic() - began, work.results(root / "whole")
    done = attempt = 0
    while done < kills:
        folder = root / f"killed-{attempt}"
        process = start(work, folder)
        time.sleep(seconds * rng.uniform(0.05, 0.9))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)
        done += wait(process) != 0
        finished = wait(start(work, folder)) == 0
        if not finished or work.results(folder) != expected:
            return False
        if any(path.name.endswith(UNFINISHED) for path in folder.rglob("*")):
            return False
        attempt += 1
    return True


def survives_a_full_disk(work: Work, root: Path) -> bool:
    """Return whether a full disk is a refusal (exit code 2) from which the same command recovers."""
    codes = [wait(start(work, root / "full", full_disk=True)), wait(start(work, root / "full"))]
    return codes == [2, 0] and work.results(root / "full") == work.results(root / "whole")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng, failed = np.random.default_rng(args.seed), False
    for name, work in WORKS.items():
        with tempfile.TemporaryDirectory() as folder:
            same = survives_kills(work, Path(folder), args.kills, rng)
            disk = survives_a_full_disk(work, Path(folder))
        kills, full = ("survived" if ok else "FAILED" for ok in (same, disk))
        print(f"{name}: {args.kills} kills {kills}, full disk {full}")
        failed |= not (same and disk)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
