"""Compare monitors: record nominal and faulty episodes, score them with every monitor, and report what each found.

A run can be killed at any time; the same command continues it. The same arguments give the same table.
"""

from __future__ import annotations

import json
import math
import platform
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE, REPORTED_RATE, WINDOW_S
from asm_gym.evaluation.detection_tables import brief_monitors_table, kept_table, kinds_table
from asm_gym.evaluation.report_page import publish
from asm_gym.evaluation.scoring import benchmark
from asm_gym.faults import foreign_faults
from asm_gym.faults.suite import SEVERITIES, kinds_of
from asm_gym.monitors.monitor_registry import BY_EVIDENCE, check_monitor_name
from asm_gym.rollouts.detection_corpus import SKILLS, VERSION, skill_files
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.run_trials import record_missing
from asm_gym.rollouts.trial import RolloutConfig, Trial, evaluation_trials
from asm_gym.scripts.command import Options, option, origin, run
from asm_gym.tasks import ROBOTS, TASKS, env_id
from asm_gym.validation import check_choice, check_number

ROLES = ("fit", "calibration", "nominal", "faulty")

_QUICK = (
    "neural_asm",
    "association_linear+evidence",
    "kalman+evidence",
    "logpzo",
)
"""Monitors that are fitted in seconds."""


@dataclass(frozen=True)
class Args(Options):
    """Options of a comparison: tasks × monitors × faults."""

    tasks: tuple[str, ...] = option(
        SKILLS, quick=("Lift", "Stack", "Door"), least=1, check=env_id, metavar="TASK"
    )
    """Names of tasks; or one Gymnasium id with Box spaces, such as Pusher-v5 or gymnasium_robotics:FetchReach-v4."""
    robot: str = option("Panda", known=ROBOTS)
    """The arm, for robosuite's tasks."""
    policy: str = "scripted"
    """Policy: scripted, sway, or the path of an agent."""
    steps: int | None = option(
        None, check=partial(check_number, "steps", low=2, whole=True), metavar="N"
    )
    """Length of an episode of an environment given by its id; by default its own."""
    monitors: tuple[str, ...] = option(
        ("neural_asm", *BY_EVIDENCE), quick=_QUICK, least=1, check=check_monitor_name
    )
    """Names of monitors. Without +evidence a rival is judged as its authors do; MODEL+DETECTION combines any two, as in
    kalman+squares."""
    faults: tuple[str, ...] = option((), metavar="KIND")
    """Kinds of fault, by default all; development or test for one half of the suite."""
    severities: tuple[str, ...] = option(SEVERITIES, quick=("strong",), least=1, known=SEVERITIES)
    """Severities of each fault."""
    fit_episodes: int = option(100, quick=16, least=1)
    """Nominal episodes of each task to learn from."""
    calibration_episodes: int = option(60, quick=10, least=1)
    """Other nominal episodes of each task, which set one threshold for all tasks."""
    nominal_episodes: int = option(60, quick=8, least=1)
    """Nominal episodes of each task to test on."""
    faulty_episodes: int = option(20, quick=3, least=1)
    """Episodes of each task for each kind and severity, each the twin of a nominal one."""
    false_alarm_rate: float = option(
        REPORTED_RATE, quick=FALSE_ALARM_RATE, check=conformal_episodes
    )
    """Share of nominal episodes that may raise an alarm."""
    workers: int = option(2, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of the run."""
    corpus: Path | None = option(None, metavar="FOLDER")
    """Score the recordings of asm-gym corpus instead; only --tasks and --fit-episodes then limit them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elsewhere:
            if len(self.tasks) > 1:
                raise ValueError(
                    "one memory has one stream: name one environment at a time, "
                    f"got {', '.join(self.tasks)}"
                )
            for name in self.faults:
                check_choice("kind of fault", name, foreign_faults.KINDS)
        else:
            if self.steps is not None:
                raise ValueError("robosuite's tasks have lengths of their own: leave --steps out")
            kinds_of(self.faults)
        if self.faulty_episodes > self.nominal_episodes:
            raise ValueError(
                "every faulty episode is the twin of a nominal one: faulty_episodes must be at "
                f"most {self.nominal_episodes}, got {self.faulty_episodes}"
            )
        needed = conformal_episodes(self.false_alarm_rate)
        if self.calibration_episodes * len(self.tasks) < needed and not self.quick:
            raise ValueError(
                f"a false-alarm rate of {self.false_alarm_rate:g} needs {needed} calibration "
                f"episodes in all, got {self.calibration_episodes} "
                f"for each of {len(self.tasks)} tasks"
            )

    @property
    def episodes(self) -> dict[str, int]:
        """Episodes of each task, by role; with ``--quick`` enough calibration episodes for the rate."""
        counts = {role: int(getattr(self, f"{role}_episodes")) for role in ROLES}
        if self.quick:
            needed = math.ceil(conformal_episodes(self.false_alarm_rate) / len(self.tasks))
            counts["calibration"] = max(counts["calibration"], needed)
        return counts

    @property
    def elsewhere(self) -> bool:
        """Whether the environment is not one of robosuite's tasks."""
        names = {name.removeprefix("asm_gym/").removesuffix("-v0") for name in self.tasks}
        return not names <= set(TASKS)

    @property
    def config(self) -> RolloutConfig:
        """How episodes are made."""
        if not self.elsewhere:
            return RolloutConfig(self.policy, self.robot)
        if self.steps:
            return RolloutConfig(self.policy, env_kwargs=(("max_episode_steps", self.steps),))
        return RolloutConfig(self.policy)


def trials_of(args: Args, task: str) -> list[Trial]:
    """Return every trial of a task."""
    return evaluation_trials(
        env_id(task),
        task,
        args.config,
        args.episodes,
        faults=args.faults,
        severities=args.severities,
        seed=args.seed,
    )


def evaluate(args: Args, console: Console) -> None:
    """Record, fit, judge and publish; print the tables in brief."""
    seconds: dict[str, float] = {}  # of each stage
    claim = {name: getattr(args, name) for name in ("robot", "policy", "seed", "steps")}
    trials = []
    if args.corpus is not None:
        files = skill_files(args.corpus, args.fit_episodes, args.tasks)
        claim["corpus"] = VERSION
    else:
        trials = [trial for task in args.tasks for trial in trials_of(args, task)]
        files = [args.out / trial.label.path for trial in trials]
    with claimed(args.out, "recordings.json", claim):
        if trials:
            with stage("recording", seconds) as progress:
                record_missing(trials, args.config, args.out, args.workers, progress)
        with stage("fitting and judging", seconds) as progress:
            result = benchmark(
                args.out,
                files,
                args.monitors,
                rate=args.false_alarm_rate,
                window_s=WINDOW_S,
                seed=args.seed,
                map_items=partial(parallel_map, workers=args.workers, progress=progress),
            )
        with stage("drawing", seconds):
            details = origin() | json.loads(json.dumps(asdict(args), default=str))
            machine = {"python": platform.python_version(), "machine": platform.machine()}
            publish(args.out, result, details | machine | {"seconds": seconds})
    tables = [brief_monitors_table(result), kept_table(result)]
    if args.elsewhere:
        tables.append(kinds_table(result))
    for table in tables:
        console.print(table)
    console.print(f"Wrote {args.out / 'report.html'} and {args.out / 'results.md'}")


main = partial(run, "evaluate", Args, evaluate)
