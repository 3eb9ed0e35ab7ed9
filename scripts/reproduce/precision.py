"""How much a memory finds after so many episodes, and without doubt of predictions far from what it has learned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from unittest.mock import patch

from asm_gym.evaluation.defaults import REPORTED_RATE, WINDOW_S
from asm_gym.evaluation.metrics import false_alarms
from asm_gym.evaluation.resampling import rate_text
from asm_gym.evaluation.scoring import fitted, judged, read
from asm_gym.evaluation.tables import Table
from asm_gym.memory import association_learning
from asm_gym.rollouts.corpus import skill_files
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record

WITHOUT = "-doubt"  # ends the name of a memory that doubts no prediction


@dataclass(frozen=True)
class Config(kit.Config):
    """Faults found by episodes learned from, over seeds."""

    corpus: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """Folder of asm-gym corpus."""
    monitors: tuple[str, ...] = option(("neural_asm", "neural_asm" + WITHOUT), least=1)
    """Names of monitors, as asm-gym evaluate takes them; neural_asm-doubt doubts no prediction."""
    episodes: tuple[int, ...] = option((10, 20, 40), quick=(2,), least=1)
    """Episodes of each task to learn from, at most."""


def run(config: Config) -> Findings:
    """Learn and judge each monitor, from each number of episodes, with each seed."""
    items = list(product(config.repetitions, config.episodes, config.monitors))
    records = kit.each("fitting and judging", partial(judge, config=config), items, config)
    measures = [name for name in records[0] if name not in ("seed", "episodes", "monitor")]
    rows = [
        (name, str(n), *(kit.over_seeds(records, m, episodes=n, monitor=name).text(digits=3) for m in measures))
        for name, n in product(config.monitors, config.episodes)
    ]
    caption = (
        f"Mean and standard deviation over {config.seeds} seeds; found: an alarm within {WINDOW_S:g} s of the onset."
    )
    return Findings(records, [Table(caption, ("monitor", "episodes a task", *measures), rows)])


def judge(item: tuple[int, int, str], config: Config) -> Record:
    """Return what a monitor finds, by its promise, and its false alarms; the fitted ones are kept."""
    seed, n, name = item
    roles, count = read(tuple(file.resolve() for file in skill_files(config.corpus))).roles, dict[str, int]()
    learned = []
    for episode in roles["fit"]:
        count[episode.labelled.task] = count.get(episode.labelled.task, 0) + 1
        if count[episode.labelled.task] <= n:
            learned.append(episode)
    known, doubts = name.removesuffix(WITHOUT), association_learning.DOUBTS
    with patch.object(association_learning, "DOUBTS", doubts[:1] if known != name else doubts):
        monitor = fitted(config.out / name, known, learned, seed)
    found = judged(known, monitor, roles, REPORTED_RATE, WINDOW_S)
    shares = {f"found at {rate_text(promise)}": share.value for promise, share in found.found.items()}
    alarms = {"false alarms": false_alarms(found.nominal).value}
    return {"seed": seed, "episodes": n, "monitor": name, "AUROC": found.auroc, **shares, **alarms}
