"""False alarms per hour of a shipped memory, in healthy hours of policies and tasks that it never met.

Only episodes that solved the task count as healthy. Surprise that a knock or a stop explains is counted apart.

The hourly threshold is compared with one that follows each policy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

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
    """Evaluate the memory, at its shipped thresholds, on every policy and task that it has not met."""
    memory = load_memory(config.memory)
    corpus = Corpus.open(config.corpus)
    cases = corpus.files[["policy", "task"]].drop_duplicates()
    new: list[Scores] = []
    known: list[Scores] = []
    with kit.stage("evaluating") as report:
        for n, (policy, task) in enumerate(cases.itertuples(index=False)):
            report(n, len(cases))
            is_known = policy == EXPERT and task in memory.about["tasks"]
            case = EvaluationCase(task, policy, known=is_known)
            recordings = corpus.episodes(policies=(policy,), tasks=(task,))
            expert = corpus.episodes("nominal", policies=(EXPERT,), tasks=(task,))
            expert_force = usual_force(expert[:EXPERT_EPISODES])
            scores = evaluate_case(memory, case.name, recordings, expert_force)
            if is_known:
                known.append(scores)
            else:
                new.append(scores)

    thresholds = {rate: memory.threshold_at(false_alarms_per_hour=rate) for rate in PROMISES}
    records = []
    for rate, scores in product(PROMISES, new):
        alarms = hourly_alarms(scores.at(thresholds[rate]).solved)
        records.append(
            {"promised": rate, "exam": scores.name, "alarms": alarms.k, "hours": alarms.hours}
        )
    tables = [
        promises_table(new, thresholds),
        scores_table(new, memory),
        rules_table(new, thresholds),
        splits_table(new + known),
    ]
    return Findings(records, tables)


def load_memory(name: str) -> NeuralASM:
    """Return the memory in a file, or the shipped one of this name."""
    if name.endswith(".asm"):
        return NeuralASM.load(name)
    return NeuralASM.pretrained(name)


def rules_table(scores: Sequence[Scores], thresholds: Mapping[float, float]) -> Table:
    """Return a row for each promise and rule of alarm."""
    rows = []
    for rate, threshold in thresholds.items():
        hourly = [each.at(threshold) for each in scores]
        adaptive = [each.adapted(rate) for each in hourly]
        rows.append(rule_row(rate, "hourly threshold", hourly))
        rows.append(rule_row(rate, "threshold that follows", adaptive))
    caption = "Two rules of alarm, under policies and tasks that the memory never met."
    return kit.table_of(caption, rows)


def rule_row(rate: float, name: str, scores: Sequence[Scores]) -> dict[str, str]:
    """Return the row of a rule of alarm that promises a rate [1/h]."""
    above = 0
    for each in scores:
        low, _ = hourly_alarms(each.solved).interval
        above += low > rate
    healthy, faulty = all_episodes(scores)
    found = percent(DetectionMetrics("", faulty, [], WINDOW_S).detected)
    return {
        "promised": f"{rate:g}",
        "rule": name,
        "false alarms an hour": hourly_alarms(healthy).text,
        "policies above it beyond chance": f"{above} of {len(scores)}",
        "faults found": f"{found} of {len(faulty)}",
    }


def splits_table(scores: Sequence[Scores]) -> Table:
    """Return false alarms, where one random half of all healthy hours sets the threshold; known tasks included."""
    solved, faulty = all_episodes(scores)
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
