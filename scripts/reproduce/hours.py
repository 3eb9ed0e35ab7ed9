"""False alarms per hour of a shipped memory, in healthy hours of policies and tasks that it never met.

Only episodes that solved the task count as healthy. Surprise that a knock or a stop explains is counted apart.

Three alarms are compared: the hourly threshold, one that follows each policy, and an e-detector, which bounds the mean
time between false alarms at whatever time one looks, and lets weak evidence add up from episode to episode:

    M_k = (M_{k-1} + 1) e(p_k)     alarm at M_k >= c; then M_k = 0      e(p) = (1 - p + p ln p) / (p ln² p)

p_k is the rank of the greatest surprise of episode k among n blocks of calibration, and c the number of blocks between
the false alarms that are promised. Sources: Shin, Ramdas and Rinaldo 2024 (NEJSDS 2(2), arXiv 2203.03532) for the
detector of Shiryaev and Roberts' form; Vovk and Wang 2021 (Annals of Statistics 49(3)) for e(p).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asm_gym.detection.conformal import HOUR, Blocks
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.detection_tables import SPLITS, over_splits
from asm_gym.evaluation.metrics import DetectionMetrics, hourly_alarms
from asm_gym.evaluation.tables import Table, percent
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.rollouts.detection_corpus import Corpus
from asm_gym.rollouts.pretraining.body_evaluation import (
    PROMISES,
    EvaluationCase,
    Scores,
    all_episodes,
    evaluate_case,
    promises_table,
    scores_table,
    usual_force,
)
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings

EXPERT = "scripted"


@dataclass(frozen=True)
class Config(kit.Config):
    """False alarms per hour of a shipped memory, promised and counted."""

    seeds: int = option(1, least=1)
    """Not used: there is one corpus."""
    corpus: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """Folder of asm-gym corpus."""
    memory: str = option("panda", metavar="NAME")
    """Shipped memory, or the file of one (.asm), of the arm of the corpus."""


def run(config: Config) -> Findings:
    """Examine the memory, at its shipped thresholds, in every policy and task that it has not met."""
    find = NeuralASM.load if config.memory.endswith(".asm") else NeuralASM.pretrained
    memory, corpus = find(config.memory), Corpus.open(config.corpus)
    thresholds = {r: memory.threshold_at(false_alarms_per_hour=r) for r in PROMISES}
    exams = corpus.files[["policy", "task"]].drop_duplicates().to_numpy().tolist()
    marks: list[Scores] = []
    known: list[Scores] = []
    with kit.stage("examining") as tell:
        for n, (policy, task) in enumerate(exams):
            tell(n, len(exams))
            own = list(corpus.episodes(policies=(policy,), tasks=(task,)))
            usual = usual_force(
                list(corpus.episodes("nominal", policies=(EXPERT,), tasks=(task,))[:100])
            )
            exam = EvaluationCase(
                task, policy, known=policy == EXPERT and task in memory.about["tasks"]
            )
            (known if exam.known else marks).append(
                evaluate_case(memory, exam.name, own, WINDOW_S, usual)
            )
    came = {(r, m.name): hourly_alarms(m.at(thresholds[r]).solved) for r in PROMISES for m in marks}
    records = [
        {"promised": r, "exam": name, "alarms": c.k, "hours": c.hours}
        for (r, name), c in came.items()
    ]
    return Findings(
        records,
        [
            promises_table(marks, thresholds, WINDOW_S),
            scores_table(marks, memory, WINDOW_S),
            rules_table(marks, memory, thresholds),
            splits_table(marks + known),
        ],
    )


class EDetector:
    """An e-detector as a threshold: what the next episode's greatest surprise must exceed for an alarm.

    Args:
        blocks: of calibration.
        rate: promised false alarms per hour.
    """

    def __init__(self, blocks: Blocks, rate: float) -> None:
        self._maxima, self._evidence = np.sort(blocks.maxima)[::-1], 0.0
        self._enough = len(blocks.maxima) / blocks.total / rate
        p = np.arange(1, len(self._maxima) + 1) / (len(self._maxima) + 1)
        # of what 0, 1, … maxima exceed
        self._e_values = (1 - p + p * np.log(p)) / (p * np.log(p) ** 2)

    @property
    def value(self) -> float:
        """The present threshold; infinite where no surprise would be evidence enough."""
        ranks = int(((self._evidence + 1.0) * self._e_values >= self._enough).sum())
        return float(self._maxima[ranks - 1]) if ranks else np.inf

    def follow(self, largest: float) -> None:
        """Take an episode of this greatest surprise as evidence; an alarm ends all evidence."""
        rank = min(int((self._maxima >= largest).sum()), len(self._maxima) - 1)
        self._evidence = (self._evidence + 1.0) * float(self._e_values[rank])
        if self._evidence >= self._enough:
            self._evidence = 0.0


def rules_table(
    marks: Sequence[Scores], memory: NeuralASM, thresholds: Mapping[float, float]
) -> Table:
    """Return a row for each promise and rule of alarm."""
    blocks, rows = memory.blocks_, []
    assert blocks is not None
    for rate, threshold in thresholds.items():
        at = [m.at(threshold) for m in marks]
        rules = {
            "hourly threshold": at,
            "threshold that follows": [m.adapted(rate) for m in at],
            "e-detector": [m.under(EDetector(blocks, rate)) for m in marks],
        }
        for name, judged in rules.items():
            came = [hourly_alarms(m.solved) for m in judged]
            above = sum(c.interval[0] > rate for c in came)
            healthy, faulty = all_episodes(judged)
            found = percent(DetectionMetrics("", faulty, [], WINDOW_S).detected)
            cells = (
                hourly_alarms(healthy).text,
                f"{above} of {len(came)}",
                f"{found} of {len(faulty)}",
            )
            rows.append((f"{rate:g}", name, *cells))
    headings = (
        "promised",
        "rule",
        "false alarms an hour",
        "policies above it beyond chance",
        "faults found",
    )
    return Table(
        "Three rules of alarm, under policies and tasks that the memory never met.", headings, rows
    )


def splits_table(marks: Sequence[Scores]) -> Table:
    """Return what each promise comes to over random halves of all healthy hours, known tasks included."""
    solved, faulty = all_episodes(marks)
    units = Blocks.of([t.surprise for t in solved], solved[0].dt)
    found = DetectionMetrics("", faulty, [], WINDOW_S)
    caption = (
        f"Over {SPLITS} random halves of {units.total:.1f} healthy hours, of tasks that the memory has met too: one "
        "half sets the threshold, in the other so many false alarms came, mean ± SD."
    )
    cells = {
        f"promised {rate:g}/h": over_splits(found, units, AlarmRate(rate, HOUR))
        for rate in PROMISES
    }
    return Table(caption, list(cells), [list(cells.values())])
