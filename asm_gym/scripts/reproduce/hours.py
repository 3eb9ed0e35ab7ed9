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
from itertools import product
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
EXPERT_EPISODES = 100  # that tell the usual force in a task


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
    memory = find(config.memory)
    corpus = Corpus.open(config.corpus)
    exams = corpus.files[["policy", "task"]].drop_duplicates()
    new: list[Scores] = []
    known: list[Scores] = []
    with kit.stage("examining") as report:
        for n, (policy, task) in enumerate(exams.itertuples(index=False)):
            report(n, len(exams))
            is_known = policy == EXPERT and task in memory.about["tasks"]
            exam = EvaluationCase(task, policy, known=is_known)
            own = corpus.episodes(policies=(policy,), tasks=(task,))
            expert = corpus.episodes("nominal", policies=(EXPERT,), tasks=(task,))
            usual = usual_force(expert[:EXPERT_EPISODES])
            marks = evaluate_case(memory, exam.name, own, WINDOW_S, usual)
            (known if is_known else new).append(marks)

    thresholds = {rate: memory.threshold_at(false_alarms_per_hour=rate) for rate in PROMISES}
    records = []
    for rate, marks in product(PROMISES, new):
        alarms = hourly_alarms(marks.at(thresholds[rate]).solved)
        records.append(
            {"promised": rate, "exam": marks.name, "alarms": alarms.k, "hours": alarms.hours}
        )
    tables = [
        promises_table(new, thresholds, WINDOW_S),
        scores_table(new, memory, WINDOW_S),
        rules_table(new, memory, thresholds),
        splits_table(new + known),
    ]
    return Findings(records, tables)


class EDetector:
    """An e-detector as a threshold: what the next episode's greatest surprise must exceed for an alarm.

    Args:
        blocks: of calibration.
        rate: promised false alarms per hour.
    """

    def __init__(self, blocks: Blocks, rate: float) -> None:
        n = len(blocks.maxima)
        p = np.arange(1, n + 1) / (n + 1)
        # e(p) of an episode whose surprise 0, 1, … maxima reach
        self._e_values = (1 - p + p * np.log(p)) / (p * np.log(p) ** 2)
        self._maxima = np.sort(blocks.maxima)[::-1]
        self._enough = n / blocks.total / rate
        self._evidence = 0.0

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
    assert memory.blocks_ is not None
    rows = []
    for rate, threshold in thresholds.items():
        hourly = [m.at(threshold) for m in marks]
        rules = {
            "hourly threshold": hourly,
            "threshold that follows": [m.adapted(rate) for m in hourly],
            "e-detector": [m.under(EDetector(memory.blocks_, rate)) for m in marks],
        }
        rows += [rule_row(rate, name, under_rule) for name, under_rule in rules.items()]
    caption = "Three rules of alarm, under policies and tasks that the memory never met."
    return kit.table_of(caption, rows)


def rule_row(rate: float, name: str, marks: Sequence[Scores]) -> dict[str, str]:
    """Return the row of a rule of alarm that promises a rate [1/h]."""
    above = sum(hourly_alarms(m.solved).interval[0] > rate for m in marks)
    healthy, faulty = all_episodes(marks)
    found = percent(DetectionMetrics("", faulty, [], WINDOW_S).detected)
    return {
        "promised": f"{rate:g}",
        "rule": name,
        "false alarms an hour": hourly_alarms(healthy).text,
        "policies above it beyond chance": f"{above} of {len(marks)}",
        "faults found": f"{found} of {len(faulty)}",
    }


def splits_table(marks: Sequence[Scores]) -> Table:
    """Return what each promise comes to over random halves of all healthy hours, known tasks included."""
    solved, faulty = all_episodes(marks)
    units = Blocks.of([t.surprise for t in solved], solved[0].dt)
    metrics = DetectionMetrics("", faulty, [], WINDOW_S)
    caption = (
        f"Over {SPLITS} random halves of {units.total:.1f} healthy hours, of tasks that the memory "
        "has met too: one half sets the threshold, in the other so many false alarms came, "
        "mean ± SD."
    )
    row = {}
    for rate in PROMISES:
        row[f"promised {rate:g}/h"] = over_splits(metrics, units, AlarmRate(rate, HOUR))
    return kit.table_of(caption, [row])
