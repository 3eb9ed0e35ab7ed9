"""One memory of many skills: is it as good as one for each, does it know what runs, and does it follow a change?

Reads the recordings of ``asm-gym evaluate``, and records a few episodes in which one skill follows another. Everything
is repeated over seeds of the monitors; the table gives means and standard deviations.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation.comparison import monitor_metrics, visible_kinds
from asm_gym.evaluation.figures import save
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, console_table, markdown, milliseconds
from asm_gym.monitors import MONITORS
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import files_in, recorded, tasks_in
from asm_gym.rollouts.scoring import detectability_of, result_of
from asm_gym.scripts.command import at_least, run
from asm_gym.scripts.reproduce.skill_recognition import (
    alarms_table,
    experienced,
    name_skills,
    naming_figure,
    naming_table,
)
from asm_gym.scripts.reproduce.skill_switch import NAMES, record_switch
from asm_gym.validation import check_choice


@dataclass(frozen=True)
class Args:
    """One memory for all skills against one for each, over seeds."""

    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/evaluate")
    """Folder of an evaluation, whose recordings are judged."""
    monitors: tuple[str, ...] = ("neural_asm", "gru+evidence")
    """Names of monitors to repeat over seeds; the first is also fitted for each task alone."""
    seeds: int = 3
    """How many seeds of the monitors."""
    alone_seeds: int = 1
    """How many of them are used for one monitor a task too, which costs as much as all tasks together for each task."""
    switches: int = 40
    """Episodes in which one skill follows another; 0 for none."""
    experience: int = 60
    """Further such episodes that a second memory learns from too, a third of them to set its threshold; 0 for none."""
    false_alarm_rate: float = 0.01
    """Share of nominal episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""
    workers: int = 2
    """Processes."""
    seed: int = 0
    """The first of the seeds."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/repertoire")
    """Folder of the results."""

    def __post_init__(self) -> None:
        for name in self.monitors:
            check_choice("monitor", name, MONITORS)
        if not self.monitors:
            raise ValueError("there must be at least one monitor")
        at_least(1, self, "seeds", "workers")
        conformal_episodes(self.false_alarm_rate)  # refuses a rate that is none
        if not self.window > 0:
            raise ValueError(f"window must be > 0, got {self.window}")
        if not 0 <= self.alone_seeds <= self.seeds:
            raise ValueError(f"alone_seeds must be in [0, {self.seeds}], got {self.alone_seeds}")
        at_least(0, self, "switches", "experience")

    @property
    def tasks(self) -> list[str]:
        """What the run has recorded.

        Raises:
            ValueError: fewer than two tasks.
        """
        found = tasks_in(self.run)
        if len(found) < 2:
            raise ValueError(f"{self.run} holds recordings of {len(found)} tasks, and a repertoire needs two: "
                             "run asm-gym evaluate first")  # fmt: skip
        return found


class Job(NamedTuple):
    """One monitor to be fitted and asked."""

    monitor: str
    seed: int
    tasks: tuple[str, ...]


def jobs(args: Args) -> list[Job]:
    """All tasks together for each monitor and seed, and each task alone for the first monitor and seeds.

    Raises:
        ValueError: a task has too few episodes to set its own threshold by.
    """
    seeds, tasks, needed = (
        range(args.seed, args.seed + args.seeds),
        args.tasks,
        conformal_episodes(args.false_alarm_rate),
    )
    for task in tasks if args.alone_seeds else []:
        count = len(files_in(args.run, [task], "calibration"))
        if count < needed:
            raise ValueError(f"{task} alone has {count} calibration episodes, and a rate of {args.false_alarm_rate} "
                             f"needs {needed}: record more, or set alone_seeds to 0")  # fmt: skip
    together = [Job(m, s, tuple(tasks)) for m in args.monitors for s in seeds]
    return together + [Job(args.monitors[0], s, (t,)) for s in seeds[: args.alone_seeds] for t in tasks]


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


def seeds_table(found: Sequence[tuple[Job, dict[str, DetectionMetrics]]], args: Args) -> Table:
    """Each monitor on all tasks, over seeds."""
    rows = []
    for monitor in args.monitors:
        own = [s[""] for job, s in found if job.monitor == monitor and len(job.tasks) > 1]
        alarms = [100 * false_alarms(s.nominal).value for s in own]
        at = [Spread.of([s.found[r].value for s in own]).text(100, 1) for r in sorted(own[0].found)]
        auroc = Spread.of([s.auroc for s in own]).text()
        delays = ", ".join(milliseconds(s.delays, "median_ms") for s in own)
        rows.append((monitor, auroc, *at, Spread.of(alarms).text(1, 1), delays))
    rates = [f"Found at {100 * r:g} % [%]" for r in sorted(found[0][1][""].found)]
    return Table(
        f"One monitor for {', '.join(args.tasks)}: mean and standard deviation over {args.seeds} seeds.",
        ("Monitor", "AUROC", *rates, "False alarms [% of episodes]", "Median delay [ms]"),
        rows,
    )


def alone_table(found: Sequence[tuple[Job, dict[str, DetectionMetrics]]], args: Args) -> Table:
    """The first monitor's AUROC and share found for each task, learned together and alone."""
    first, rate = args.monitors[0], args.false_alarm_rate
    alone = {(j.seed, j.tasks[0]): s for j, s in found if len(j.tasks) == 1}
    used = {seed for seed, _ in alone}
    together = {j.seed: s for j, s in found if j.monitor == first and len(j.tasks) > 1 and j.seed in used}
    rows = []
    for task in args.tasks:
        pairs = [(s[task], alone[seed, task][task]) for seed, s in together.items()]
        auroc = [Spread.of([p[i].auroc for p in pairs]).text() for i in (0, 1)]
        gained = Spread.of([a.auroc - b.auroc for a, b in pairs]).text()
        power = [Spread.of([p[i].found[rate].value for p in pairs]).text(100, 0) for i in (0, 1)]
        rows.append((task, *auroc, gained, *power))
    return Table(
        f"{first}: learned from all skills together, one threshold, and from each alone with its own; "
        f"{args.alone_seeds} of the seeds.",
        ("Task", "AUROC, together", "alone", "gained", f"Found at {100 * rate:g} % [%], together", "alone"),
        rows,
    )


def repertoire(args: Args, console: Console) -> list[Table]:
    """Fits, asks, compares and writes."""
    seconds: dict[str, float] = {}
    wanted_jobs = jobs(args)
    possible = set(NAMES.values()) <= set(args.tasks)
    args.out.mkdir(parents=True, exist_ok=True)
    with stage("changing skills", console, seconds) as progress:
        counts = {"switches": args.switches, "experience": args.experience if args.switches else 0}
        wanted = [_switch_path(args, name, n) for name, count in counts.items() for n in range(count)]
        paths: list[Path] = parallel_map(record_switch, wanted, args.workers, progress) if possible else []
        switches, experience = paths[: args.switches], paths[args.switches :]
    with stage("fitting and judging", console, seconds) as progress:
        ask = partial(score, run=args.run.resolve(), rate=args.false_alarm_rate, window_s=args.window)
        found = list(zip(wanted_jobs, parallel_map(ask, wanted_jobs, args.workers, progress), strict=True))
    tables = [seeds_table(found, args)]
    if args.alone_seeds:
        tables.append(alone_table(found, args))
    if "neural_asm" in args.monitors:
        what: dict[str, Any] = {"run": args.run, "tasks": tuple(args.tasks), "rate": args.false_alarm_rate}
        what["switches"] = switches
        with stage("naming skills", console, seconds) as progress:
            name = partial(name_skills, **what)
            named = parallel_map(name, range(args.seed, args.seed + args.seeds), args.workers, progress)
        dt = recorded(args.run, tuple(args.tasks)).roles["nominal"][0].spec.dt
        tables.append(naming_table(named, len(args.tasks), dt))
        if switches:
            alarms = {"of single skills": [n.alarms for n in named]}
            if experience:
                learn = partial(experienced, **what, experience=experience)
                with stage("learning changes of skill too", console, seconds) as progress:
                    seeds = range(args.seed, args.seed + args.seeds)
                    alarms[f"that has seen {len(experience)} changes"] = parallel_map(
                        learn, seeds, args.workers, progress
                    )
            tables.append(alarms_table(alarms))
        curves = {"from the start": [r for n in named for r in n.nominal]}
        if named[0].switched:
            curves["after a change"] = [r for n in named for r in n.switched]
        save(naming_figure(curves, dt), args.out / "naming.png")
    _write(args, tables, seconds)
    return tables


def _switch_path(args: Args, kind: str, number: int) -> Path:
    """Named by the seed, which differs between what is learned and what is tested."""
    return args.out / kind / f"{args.seed + number + (5_000 if kind == 'experience' else 0)}.npz"


def _write(args: Args, tables: Sequence[Table], seconds: dict[str, float]) -> None:
    (args.out / "repertoire.md").write_text("\n\n".join(map(markdown, tables)) + "\n", encoding="utf-8")
    content: dict[str, Any] = {"settings": json.loads(json.dumps(asdict(args), default=str)), "seconds": seconds}
    content["tables"] = [{"caption": t.caption, "headings": t.headings, "rows": t.rows} for t in tables]
    (args.out / "repertoire.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def compare_and_report(args: Args, console: Console) -> None:
    """Compares, and prints the tables."""
    made = repertoire(args, console)
    for table in made:
        console.print(console_table(table))
    console.print(f"Wrote {args.out / 'repertoire.md'} and {args.out / 'repertoire.json'}")


def main(argv: list[str] | None = None) -> int:
    """Compares, and returns the exit code."""
    return run("reproduce repertoire", Args, compare_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
