"""Commands that are killed at random moments, that run out of disk, and that meet another on their folder.

Each command is run to its end twice: in this process, so that those it is forked into find everything imported, and in
one of those, for its time. Then it is begun, killed (SIGKILL) after a random part of that time, and begun again, until
it has been killed as often as asked; what is left in the end must be, bit by bit, what was left at first.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from asm_gym.checkpoint import kind_of, read_checkpoint
from asm_gym.data.datasets import read_dataset
from asm_gym.episode import load_episode
from asm_gym.files import UNFINISHED
from asm_gym.monitors import NeuralASM
from asm_gym.scripts import cli, train
from tests.streams import sine_episodes, sine_spec

FULL = 120 * 1024
"""A file can grow no larger than this in a run whose disk is full [bytes]."""


WORKS = ("save", "collect", "evaluate", "train", "react")


class Work(NamedTuple):
    """Something that is begun again until it is done."""

    name: str
    begin: Callable[[Path], int]  # works in a folder, and returns an exit code
    left: Callable[[Path], Any]  # what it left there, to be compared


class Outcome(NamedTuple):
    """A row of the table."""

    what: str
    times: int
    ended: Mapping[int, int]  # exit code to how often; -9 for killed
    same: bool

    @property
    def row(self) -> tuple[str, ...]:
        ended = ", ".join(f"{n} × {code}" for code, n in sorted(self.ended.items()))
        return self.what, str(self.times), ended, "yes" if self.same else "NO"


def commands() -> list[Work]:
    """What is killed."""
    evaluate = """evaluate --tasks Lift --monitors kalman --faults push --severities strong --harmless touch --no-video
        --fit-episodes 2 --calibration-episodes 5 --nominal-episodes 1 --faulty-episodes 1 --harmless-episodes 1"""
    return [
        Work("save", save_for_ever, lambda folder: NeuralASM.load(folder / "x.asm").hidden_size in SIZES),
        Work("collect", command("collect Lift --episodes 3"), recorded),
        Work("evaluate", command(f"{evaluate} --false-alarm-rate 0.2"), tables),
        Work("train", trained, agent),
    ]


def trained(folder: Path) -> int:
    """An agent of few steps, by one worker, into a folder."""
    few = {"demonstrations": 1, "cloning_updates": 40, "steps": 60, "checkpoint_every": 20, "evaluate_every": 30}
    args = train.Args(**few, evaluation_episodes=1, final_episodes=1, seed=3, out=folder)  # type: ignore[arg-type]
    train.train_and_report(args, Console())
    return 0


def command(line: str) -> Callable[[Path], int]:
    """``asm-gym`` with these options, by one worker, into a folder."""
    argv = [*line.split(), "--workers", "1", "--seed", "3"]
    return lambda folder: cli.main([*argv, "--out", str(folder)])


def recorded(folder: Path) -> Any:
    """Every number of the episodes, as files and as a dataset."""
    own = [load_episode(p) for p in sorted((folder / "episodes").glob("*.npz"))]
    return [(e.stream.tobytes(), e.actions.tobytes(), e.success, e.seed) for e in (*own, *read_dataset(folder))]


def tables(folder: Path) -> Any:
    """The text of what is printed."""
    return {p.name: p.read_text() for p in sorted(folder.glob("*.md"))}


def agent(folder: Path) -> Any:
    """The weights of the agents, and how well they did."""
    found = {p.name: read_checkpoint(p, kind_of(p)).arrays for p in sorted(folder.glob("*.npz"))}
    weights = {(file, n): a.tobytes() for file, arrays in found.items() for n, a in arrays.items()}
    result = json.loads((folder / "result.json").read_text())
    return weights, result["curve"], result["success"]


SIZES = (3, 24)
"""Hidden units of the two memories that are saved by turns."""


def save_for_ever(folder: Path) -> int:
    """Saves two memories by turns under one name, for a while; a reader must find one of them."""
    episodes = sine_episodes(4, spec=sine_spec(3, 1))
    memories = [NeuralASM(episodes[0].spec, hidden_size=h, association_size=8, epochs=1).fit(episodes) for h in SIZES]
    for k in range(200):
        memories[k % 2].save(folder / "x.asm")
    return 0


def started(work: Work, folder: Path, full: bool = False) -> int:
    """The process that begins it."""
    child = os.fork()
    if child:
        return child
    os.setpgid(0, 0)
    code = 70  # what raised is no exit code of a command
    with contextlib.suppress(BaseException), open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
        if full:
            resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))
        folder.mkdir(parents=True, exist_ok=True)
        code = work.begin(folder)
        # One line says what was wrong.
        said = sys.stderr.getvalue().strip().splitlines()
        code = code if code != 2 or len(said) == 1 else 71
    os._exit(code)


def ended(process: int) -> int:
    """Its exit code; less than 0 for the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def killed_and_begun_again(work: Work, folder: Path, kills: int, rng: np.random.Generator) -> Outcome:
    """Whether a work that is killed so often comes to the same end."""
    (folder / "whole").mkdir(parents=True)
    with contextlib.redirect_stdout(io.StringIO()):
        codes = [work.begin(folder / "whole")]
    expected = work.left(folder / "whole")
    began = time.monotonic()
    codes.append(ended(started(work, folder / "again")))
    lasted = time.monotonic() - began
    same, done, k = codes == [0, 0] and work.left(folder / "again") == expected, 0, 0
    while done < kills:
        place = folder / f"killed-{k}"
        for row in range(min(4, kills - done)):  # in a row, and then it may finish; what goes on has less to do
            process = started(work, place)
            time.sleep(lasted * rng.uniform(0.05, 0.5 if row else 1.0))
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
            codes.append(ended(process))
            if codes[-1] == 0:  # it had ended before, and this was no kill
                lasted *= 0.8
                break
            done += 1
        else:
            codes.append(ended(started(work, place)))
        same &= codes[-1] == 0 and work.left(place) == expected
        same &= not [p for p in place.rglob("*") if p.name.endswith(UNFINISHED)]
        k += 1
    return Outcome(f"{work.name}, killed", done, _counts(codes), same)


def out_of_disk(work: Work, folder: Path) -> Outcome:
    """Whether a full disk is a refusal in one line, after which the same command comes to the same end."""
    whole, place = folder / "whole", folder / "full"
    expected = work.left(whole)
    codes = [ended(started(work, place, full=True)), ended(started(work, place))]
    return Outcome(f"{work.name}, disk full", 1, _counts(codes), codes == [2, 0] and work.left(place) == expected)


def two_at_once(work: Work, folder: Path) -> Outcome:
    """Whether of two on one folder one is refused, and the other undisturbed."""
    both = [started(work, folder / "two") for _ in range(2)]
    codes = [ended(process) for process in both]
    same = sorted(codes) == [0, 2] and work.left(folder / "two") == work.left(folder / "whole")
    return Outcome(f"{work.name}, two at once", 2, _counts(codes), same)


def _counts(codes: list[int]) -> dict[int, int]:
    return {code: codes.count(code) for code in set(codes)}
