"""One memory of many skills: is it as good as one for each, does it know what runs, and does it follow a change?

Reads the recordings of ``asm-gym evaluate``, and records a few episodes in which one skill follows another. Everything
is repeated over seeds of the monitors; the table gives means and standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation import defaults
from asm_gym.evaluation.comparison import monitor_metrics, visible_kinds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, milliseconds
from asm_gym.monitors import MONITORS
from asm_gym.rollouts.run_folder import files_in, recorded, tasks_in
from asm_gym.rollouts.scoring import detectability_of, result_of
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import RunConfig
from asm_gym.scripts.reproduce.skill_recognition import (
    alarms_table,
    experienced,
    name_skills,
    naming_figure,
    naming_table,
)
from asm_gym.scripts.reproduce.skill_switch import NAMES, switches


@dataclass(frozen=True)
class Config(RunConfig):
    """One memory for all skills against one for each, over seeds."""

    out: Path = option(Path("runs/repertoire"), metavar="FOLDER")
    """Folder of the results."""
    monitors: tuple[str, ...] = option(("neural_asm", "gru+evidence"), quick=("neural_asm",), least=1, known=MONITORS)
    """Names of monitors to repeat over seeds; the first is also fitted for each task alone."""
    switches: int = option(40, quick=2, least=0)
    """Episodes in which one skill follows another; 0 for none."""
    experience: int = option(60, quick=3, least=0)
    """Further such episodes that a second memory learns from too, a third of them to set its threshold; 0 for none."""
    false_alarm_rate: float = option(defaults.REPORTED_RATE, quick=defaults.FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    alone_seeds: int = fixed(1, least=0)
    """How many seeds are used for one monitor a task too, which costs as much as all tasks together for each task."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.alone_seeds > self.seeds:
            raise ValueError(f"alone_seeds must be in [0, {self.seeds}], got {self.alone_seeds}")

    @property
    def tasks(self) -> tuple[str, ...]:
        """What the run has recorded.

        Raises:
            ValueError: fewer than two tasks.
        """
        found = tuple(tasks_in(self.run))
        if len(found) < 2:
            raise ValueError(f"{self.run} holds recordings of {len(found)} tasks, and a repertoire needs two: "
                             "run asm-gym evaluate first")  # fmt: skip
        return found


EXPERIENCE = 5_000
"""Added to the seeds of changes that are learned from, which so differ from those that are tested."""


class Job(NamedTuple):
    """One monitor to be fitted and asked."""

    monitor: str
    seed: int
    tasks: tuple[str, ...]


def jobs(config: Config) -> list[Job]:
    """All tasks together for each monitor and seed, and each task alone for the first monitor and seeds.

    Raises:
        ValueError: a task has too few episodes to set its own threshold by.
    """
    seeds, tasks, needed = (
        config.repetitions,
        config.tasks,
        conformal_episodes(config.false_alarm_rate),
    )
    for task in tasks if config.alone_seeds else []:
        count = len(files_in(config.run, [task], "calibration"))
        if count < needed:
            raise ValueError(f"{task} alone has {count} calibration episodes, and a rate of {config.false_alarm_rate} "
                             f"needs {needed}: record more, or set alone_seeds to 0")  # fmt: skip
    together = [Job(m, s, tasks) for m in config.monitors for s in seeds]
    return together + [Job(config.monitors[0], s, (t,)) for s in seeds[: config.alone_seeds] for t in tasks]


def score(job: Job, run: Path, rate: float, window_s: float) -> dict[str, DetectionMetrics]:
    """The job's monitor on each of its tasks, and on all of them under ``""``."""
    recordings, _, twins = recorded(run, job.tasks)
    result = result_of(job.monitor, run, recordings, rate, job.seed)
    detectability = detectability_of(twins, recordings["faulty"], window_s)

    def of(task: str) -> DetectionMetrics:
        own = replace(result, traces=[t for t in result.traces if task in ("", t.task)])
        # By task, so that one learned alone is asked about the same kinds.
        visible = visible_kinds([d for d in detectability if task in ("", d.task)])
        return monitor_metrics(job.monitor, own, window_s, visible)

    return {task: of(task) for task in ("", *job.tasks)}


def seeds_table(found: Sequence[tuple[Job, dict[str, DetectionMetrics]]], config: Config) -> Table:
    """Each monitor on all tasks, over seeds."""
    rows = []
    for monitor in config.monitors:
        own = [s[""] for job, s in found if job.monitor == monitor and len(job.tasks) > 1]
        alarms = [100 * false_alarms(s.nominal).value for s in own]
        at = [Spread.of([s.found[r].value for s in own]).text(100, 1) for r in sorted(own[0].found)]
        auroc = Spread.of([s.auroc for s in own]).text()
        delays = ", ".join(milliseconds(s.delays, "median_ms") for s in own)
        rows.append((monitor, auroc, *at, Spread.of(alarms).text(1, 1), delays))
    rates = [f"Found at {100 * r:g} % [%]" for r in sorted(found[0][1][""].found)]
    return Table(
        f"One monitor for {', '.join(config.tasks)}: mean and standard deviation over {config.seeds} seeds.",
        ("Monitor", "AUROC", *rates, "False alarms [% of episodes]", "Median delay [ms]"),
        rows,
    )


def alone_table(found: Sequence[tuple[Job, dict[str, DetectionMetrics]]], config: Config) -> Table:
    """The first monitor's AUROC and share found for each task, learned together and alone."""
    first, rate = config.monitors[0], config.false_alarm_rate
    alone = {(j.seed, j.tasks[0]): s for j, s in found if len(j.tasks) == 1}
    used = {seed for seed, _ in alone}
    together = {j.seed: s for j, s in found if j.monitor == first and len(j.tasks) > 1 and j.seed in used}
    rows = []
    for task in config.tasks:
        pairs = [(s[task], alone[seed, task][task]) for seed, s in together.items()]
        auroc = [Spread.of([p[i].auroc for p in pairs]).text() for i in (0, 1)]
        gained = Spread.of([a.auroc - b.auroc for a, b in pairs]).text()
        power = [Spread.of([p[i].found[rate].value for p in pairs]).text(100, 0) for i in (0, 1)]
        rows.append((task, *auroc, gained, *power))
    return Table(
        f"{first}: learned from all skills together, one threshold, and from each alone with its own; "
        f"{config.alone_seeds} of the seeds.",
        ("Task", "AUROC, together", "alone", "gained", f"Found at {100 * rate:g} % [%], together", "alone"),
        rows,
    )


def run(config: Config) -> Findings:
    """Fits, asks and compares."""
    wanted = jobs(config)  # refused before anything is recorded
    named_too = "neural_asm" in config.monitors
    possible = named_too and set(NAMES.values()) <= set(config.tasks)
    paths = switches(config, config.switches if possible else 0)
    shown = switches(config, config.experience if possible and paths else 0, "experience", EXPERIENCE)
    ask = partial(score, run=config.run.resolve(), rate=config.false_alarm_rate, window_s=config.window)
    found = list(zip(wanted, kit.each("fitting and judging", ask, wanted, config), strict=True))
    tables = [seeds_table(found, config)]
    if config.alone_seeds:
        tables.append(alone_table(found, config))
    figure = None
    if named_too:
        what: dict[str, Any] = {"run": config.run, "tasks": config.tasks, "rate": config.false_alarm_rate}
        what["switches"] = paths
        named = kit.each("naming skills", partial(name_skills, **what), config.repetitions, config)
        dt = config.roles["nominal"][0].spec.dt
        tables.append(naming_table(named, len(config.tasks), dt))
        if paths:
            alarms = {"of single skills": [n.alarms for n in named]}
            if shown:
                learn = partial(experienced, **what, experience=shown)
                seen = kit.each("learning changes of skill too", learn, config.repetitions, config)
                alarms[f"that has seen {len(shown)} changes"] = seen
            tables.append(alarms_table(alarms))
        curves = {"from the start": [r for n in named for r in n.nominal]}
        if named[0].switched:
            curves["after a change"] = [r for n in named for r in n.switched]
        figure = naming_figure(curves, dt)
    return Findings([record(job, own) for job, own in found], tables, figure)


def record(job: Job, found: dict[str, DetectionMetrics]) -> Record:
    """What one monitor found in all its tasks."""
    whole = found[""]
    at = {f"found_at_{rate:g}": share.value for rate, share in whole.found.items()}
    return {**job._asdict(), "tasks": " ".join(job.tasks), "auroc": whole.auroc, **at}
