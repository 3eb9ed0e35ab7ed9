"""False alarms per hour of a shipped memory, in healthy hours of policies and tasks that it never met.

Only episodes that solved the task count as healthy. Surprise that a knock or a stop explains is counted apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from asm_gym.detection.conformal import HOUR, Blocks
from asm_gym.detection.events import KNOCK, STOP
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.detection_tables import SPLITS, kept_rate, over_splits
from asm_gym.evaluation.metrics import DetectionMetrics, hourly_alarms
from asm_gym.evaluation.tables import Table, percent
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.rollouts.corpus import Corpus
from asm_gym.rollouts.pretraining.exam import SEVERITIES, Exam, Marks, card, examine, usual_force
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings

PROMISES = (10.0, 5.0, 3.0, 1.0)  # false alarms per hour that a threshold promises
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
    marks: list[Marks] = []
    known: list[Marks] = []
    with kit.stage("examining") as tell:
        for n, (policy, task) in enumerate(exams):
            tell(n, len(exams))
            own = list(corpus.episodes(policies=(policy,), tasks=(task,)))
            usual = usual_force(list(corpus.episodes("nominal", policies=(EXPERT,), tasks=(task,))[:100]))
            exam = Exam(task, policy, known=policy == EXPERT and task in memory.about["tasks"])
            (known if exam.known else marks).append(examine(memory, exam.name, own, WINDOW_S, usual))
    came = {(r, m.name): hourly_alarms(m.at(thresholds[r]).solved) for r in PROMISES for m in marks}
    records = [{"promised": r, "exam": name, "alarms": c.k, "hours": c.hours} for (r, name), c in came.items()]
    return Findings(
        records, [kept_table(marks, thresholds), card(marks, memory, WINDOW_S), splits_table(marks + known)]
    )


def splits_table(marks: Sequence[Marks]) -> Table:
    """Return what each promise comes to over random halves of all healthy hours, known tasks included."""
    solved = [t for m in marks for t in m.solved]
    units = Blocks.of([t.surprise for t in solved], solved[0].dt)
    found = DetectionMetrics("", [t for m in marks for t in m.metrics.faulty], [], WINDOW_S)
    caption = (
        f"Over {SPLITS} random halves of {units.total:.1f} healthy hours, of tasks that the memory has met too: one "
        "half sets the threshold, in the other so many false alarms came, mean ± SD."
    )
    cells = {f"promised {rate:g}/h": over_splits(found, units, AlarmRate(rate, HOUR)) for rate in PROMISES}
    return Table(caption, list(cells), [list(cells.values())])


def kept_table(marks: Sequence[Marks], thresholds: Mapping[float, float]) -> Table:
    """Return a row for each promise: alarms that came, and faults found."""
    rows = []
    for promised, threshold in thresholds.items():
        at = [m.at(threshold) for m in marks]
        healthy, faulty = [t for m in at for t in m.solved], [t for m in at for t in m.metrics.faulty]
        shares = [
            DetectionMetrics("", [t for t in faulty if t.severity in severities], [], WINDOW_S).detected
            for severities in (SEVERITIES, ("mild",))
        ]
        excused = (f"{hourly_alarms(healthy, event).value:.1f}" for event in (KNOCK, STOP))
        cells = kept_rate(hourly_alarms(healthy), promised), *excused
        rows.append((f"{promised:g}", f"{threshold:.3g}", *cells, *(f"{percent(s)} of {s.n}" for s in shares)))
    hours = sum(len(t) * t.dt for m in marks for t in m.solved) / 3600
    caption = (
        f"Alarms per hour in {hours:.2f} healthy hours of policies and tasks that the memory never met, with 95 % "
        "Poisson intervals; alarms within a minute count once. Broken: the interval lies above the promise. Found: "
        f"faults that an ideal observer could see, within {WINDOW_S:g} s."
    )
    found = (f"{' and '.join(SEVERITIES)} found", "mild found")
    return Table(caption, ("promised", "threshold", "false alarms", "knocks", "stops", *found), rows)
