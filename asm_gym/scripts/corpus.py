"""Record the corpus behind the detection tables: healthy motion, and faults with their healthy twins.

It can be killed at any time; the same command continues. An incomplete corpus can already be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from asm_gym.rollouts.detection_corpus import (
    CLAIM,
    PARTS,
    QUICK,
    ROUNDS,
    VERSION,
    Corpus,
    record_corpus,
)
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.scripts.command import Options, option, run
from asm_gym.validation import check_number


@dataclass(frozen=True)
class Args(Options):
    """Options of the corpus."""

    part: tuple[str, ...] = option(tuple(PARTS), least=1, known=PARTS)
    """Parts to record."""
    rounds: int = option(ROUNDS, quick=1, check=partial(check_number, "rounds", low=1, high=ROUNDS))
    """Number of rounds; each has the same share of every task, and the first also the training episodes."""
    workers: int = option(2, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """Folder of the corpus."""


def make(args: Args, console: Console) -> None:
    """Record what is missing, part by part, and print how much there is."""
    sources = PARTS
    total = ROUNDS
    if args.quick:
        sources = QUICK
        total = 1
    with claimed(args.out, CLAIM, {"corpus": VERSION, "quick": args.quick}):
        for part in args.part:
            for number in range(min(args.rounds, total)):
                with stage(f"{part}, round {number + 1}") as progress:
                    record_corpus(args.out, sources[part], number, total, args.workers, progress)
    files = Corpus.open(args.out).files
    healthy = (files.role != "faulty").sum()
    console.print(f"Corpus {VERSION} in {args.out}: {len(files)} episodes, {healthy} healthy")


main = partial(run, "corpus", Args, make)
