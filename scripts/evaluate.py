"""Records nominal, faulty and harmless episodes once, lets every monitor judge them, and reports who noticed what.

A run lives in one folder and can be killed at any time: what was recorded, and what was fitted, is not made again. The
same arguments give the same table.
"""

from __future__ import annotations

import ast
import json
import math
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.episode import EpisodeLabel
from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE, REPORTED_RATE, WINDOW_S
from asm_gym.evaluation.detection_tables import brief_monitors_table, harmless_table, kinds_table
from asm_gym.evaluation.report import publish
from asm_gym.evaluation.standing import coverage_table, kept_table
from asm_gym.evaluation.tables import ConsoleTable
from asm_gym.faults import anywhere
from asm_gym.faults.interface import FaultyInterface
from asm_gym.faults.suite import HARMLESS, KINDS, SEVERITIES, kinds_of, possible
from asm_gym.monitors import MONITORS, PARTS, make_monitor, monitor_class
from asm_gym.monitors.registry import check_monitor, model_of
from asm_gym.policies import make_policy
from asm_gym.rollouts.corpus import SKILLS, VERSION, Corpus
from asm_gym.rollouts.parallel import ParallelConfig, Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.record import record
from asm_gym.rollouts.run_folder import claimed, make_missing
from asm_gym.rollouts.scoring import benchmark, calibrated
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.trial import EXECUTIONS, RolloutConfig, Trial, horizon_of
from asm_gym.rollouts.video import Clip, can_record_video, record_video
from asm_gym.scripts.command import one_line, run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.stream_source import StreamSource
from asm_gym.tasks import ROBOTS, env_id, is_task
from asm_gym.validation import check_choice, check_number

_HARMLESS = (*HARMLESS, *EXECUTIONS)
SHOWN = 2
"""Typical episodes in the video."""

_QUICK = (
    *("neural_asm", "association_linear+evidence", "window_pca+evidence", "kalman+evidence"),
    *("logpzo", "external_torque_limit", "force_limit"),
)
"""Monitors that are fitted in seconds."""


@dataclass(frozen=True)
class Args:
    """Tasks × monitors × faults: who notices what, how fast, and how often for nothing."""

    tasks: tuple[str, ...] = option(
        ("Lift", "Stack", "PickPlaceCan", "Door"),
        quick=("Lift", "Stack", "Door"),
        least=1,
        check=env_id,
        metavar="TASK",
    )
    """Names of tasks; or one Gymnasium id with Box spaces, such as Pusher-v5 or gymnasium_robotics:FetchReach-v4."""
    robot: str = option("Panda", known=ROBOTS)
    """The arm, in robosuite's tasks."""
    policy: str = "scripted"
    """What acts: scripted, sway, or the path of an agent."""
    steps: int | None = option(None, check=partial(check_number, "steps", low=2, whole=True))
    """Length of an episode, in an environment by its id; by default its own."""
    monitors: tuple[str, ...] = option(
        tuple(name for name in MONITORS if name not in PARTS), quick=_QUICK, least=1, check=check_monitor
    )
    """Names of monitors; any model goes under any detection, as in external_torque_limit+evidence."""
    settings: tuple[str, ...] = option((), metavar="MONITOR.NAME=VALUE")
    """Hyperparameters of these monitors that are not their own, as in gru.learning_rate=0.0003."""
    faults: tuple[str, ...] = option((), listed=KINDS, metavar="KIND")
    """Kinds of fault, by default all that there are; development or test for robosuite's to choose by, or to report."""
    severities: tuple[str, ...] = option(SEVERITIES, quick=("strong",), least=1, known=SEVERITIES)
    """How bad each is."""
    harmless: tuple[str, ...] = option(_HARMLESS, check=partial(check_choice, "harmless variation", known=_HARMLESS))
    """Harmless variations, which should raise no alarm."""
    fit_episodes: int = option(60, quick=16, least=1)
    """Nominal episodes of each task to learn from."""
    calibration_episodes: int = option(60, quick=10, least=1)
    """Other nominal episodes of each task; the thresholds are set on those of all tasks together."""
    nominal_episodes: int = option(60, quick=8, least=1)
    """Nominal episodes of each task to test on."""
    faulty_episodes: int = option(20, quick=3, least=1)
    """Episodes of each task for each kind and severity; each is the twin of a nominal one."""
    harmless_episodes: int = option(20, quick=2, least=1)
    """Episodes of each task for each harmless variation."""
    false_alarm_rate: float = option(REPORTED_RATE, quick=FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    video: bool = True
    """Do not film two typical episodes; there are none where this machine cannot render."""
    workers: str = option("2", check=ParallelConfig.named, metavar="N")
    """Processes; or a cluster that is running, as dask:tcp://host:8786 or ray:host:6379, which shares the folder."""
    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same table."""
    out: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of the run."""
    quick: bool = False
    """To see that everything runs, not to judge the figures."""
    corpus: Path | None = option(None, metavar="FOLDER")
    """Judges by what asm-gym corpus has recorded there, all of its skills, faults and splits; nothing is recorded."""
    window: float = fixed(WINDOW_S, check=partial(check_number, "window", above=0))
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.elsewhere and len(self.tasks) > 1:
            raise ValueError(f"one memory has one stream: name one environment at a time, got {', '.join(self.tasks)}")
        if self.steps is not None and not self.elsewhere:
            raise ValueError("robosuite's tasks have lengths of their own: leave --steps out")
        _ = self.hyperparameters  # refuses what no monitor has
        if self.elsewhere:
            for name in self.faults:
                check_choice("kind of fault", name, anywhere.KINDS)
        else:
            kinds_of(self.faults)
        if self.faulty_episodes > self.nominal_episodes:
            raise ValueError(
                f"every faulty episode is the twin of a nominal one: faulty_episodes must be at most "
                f"{self.nominal_episodes}, got {self.faulty_episodes}"
            )
        needed = conformal_episodes(self.false_alarm_rate)
        if self.calibration_episodes * len(self.tasks) < needed and not self.quick:
            raise ValueError(
                f"a false-alarm rate of {self.false_alarm_rate:g} needs {needed} calibration episodes in all, got "
                f"{self.calibration_episodes} for each of {len(self.tasks)} tasks"
            )

    def episodes(self, role: str) -> int:
        """Of each task, for a role; with ``--quick`` as many to calibrate on as the rate needs."""
        count: int = getattr(self, f"{role}_episodes")
        if role != "calibration" or not self.quick:
            return count
        return max(count, math.ceil(conformal_episodes(self.false_alarm_rate) / len(self.tasks)))

    @property
    def parallel(self) -> ParallelConfig:
        """Who does the work."""
        return ParallelConfig.named(self.workers)

    @property
    def hyperparameters(self) -> dict[str, dict[str, Any]]:
        """Those in ``settings``, by model and name. Raises ValueError where none of the monitors has one so named."""
        found: dict[str, dict[str, Any]] = {}
        for setting in self.settings:
            where, equals, value = setting.partition("=")
            model, dot, parameter = where.partition(".")
            if not equals or not dot:
                raise ValueError(f"settings must be like gru.learning_rate=0.0003, got {setting!r}")
            check_choice("monitor with settings", model, dict.fromkeys(map(model_of, self.monitors)))
            check_choice(f"hyperparameter of {model}", parameter, monitor_class(model).hyperparameters)
            try:
                found.setdefault(model, {})[parameter] = ast.literal_eval(value)
            except (ValueError, SyntaxError) as error:
                raise ValueError(
                    f"{where} must be a number, True, False or a tuple of numbers, got {value!r}"
                ) from error
        return found

    @property
    def elsewhere(self) -> bool:
        """The environment is not one of robosuite's tasks."""
        return not all(map(is_task, self.tasks))

    @property
    def config(self) -> RolloutConfig:
        if not self.elsewhere:
            return RolloutConfig(self.policy, self.robot)
        return RolloutConfig(self.policy, env_kwargs=(("max_episode_steps", self.steps),) if self.steps else ())


def kinds_in(env: gym.Env[Any, Any], args: Args) -> tuple[list[str], list[str]]:
    """The kinds of fault, and of harmless variation, that there are in ``env``."""
    if args.elsewhere:
        FaultyInterface(env)  # refuses spaces that no fault can act on
        return list(args.faults or anywhere.KINDS), []
    inner: Any = env.unwrapped
    harmless = [k for k in args.harmless if k in EXECUTIONS or possible(k, inner)]
    return [k for k in kinds_of(args.faults or tuple(KINDS)) if possible(k, inner)], harmless


def able(args: Args, console: Console) -> Args:
    """With the monitors that can watch the environment; says which others there were.

    Raises:
        ValueError: none of them can, or one refuses a hyperparameter.
    """
    settings = args.hyperparameters
    if not args.elsewhere and not settings:
        return args
    env = gym.make(env_id(args.tasks[0]), **dict(args.config.settings))
    spec, refused = StreamSource(env).spec, {}
    env.close()
    for name in args.monitors:
        if model_of(name) in settings:
            make_monitor(name, spec, **settings[model_of(name)])
            continue
        try:
            make_monitor(name, spec)
        except ValueError as error:
            refused[name] = one_line(error)
    if len(refused) == len(args.monitors):
        raise ValueError(f"no monitor can watch this: {next(iter(refused.values()))}")
    for name, why in refused.items():
        console.print(f"{name} is left out: {why}", highlight=False)
    return replace(args, monitors=tuple(m for m in args.monitors if m not in refused))


def labels(args: Args) -> list[EpisodeLabel]:
    """Every episode of the run, task by task.

    Raises:
        ValueError, OSError: the policy cannot act in one; or the corpus is damaged, of another version or cut off.
    """
    if args.corpus is not None:
        skills = Corpus.open(args.corpus).episodes(policies=("scripted",), tasks=SKILLS)
        skills.check()
        kinds = [(kind, severity) for kind in ("", *KINDS) for severity in ("", *SEVERITIES)]
        return sorted((e.label for e in skills.entries), key=lambda label: kinds.index((label.kind, label.severity)))
    made: list[EpisodeLabel] = []
    for task in args.tasks:
        env = gym.make(env_id(task), **dict(args.config.settings))
        make_policy(args.policy, env, seed=0)  # what does not fit is refused before anything is recorded
        faults, harmless = kinds_in(env, args)
        horizon = horizon_of(env)
        env.close()
        for role in ("fit", "calibration", "nominal"):
            seeds = role_seeds(args.seed, task, role, args.episodes(role))
            made += [EpisodeLabel(task, role, seed=s) for s in seeds]
        twins = role_seeds(args.seed, task, "nominal", args.nominal_episodes)[: args.faulty_episodes]
        onsets = {s: draw_onset(s, horizon) for s in twins}
        made += [
            EpisodeLabel(task, "faulty", k, severity, s, onsets[s])
            for k in faults
            for severity in args.severities
            for s in twins
        ]
        others = role_seeds(args.seed, task, "harmless", args.harmless_episodes)
        made += [EpisodeLabel(task, "harmless", k, "", s, draw_onset(s, horizon)) for k in harmless for s in others]
    return made


def show_examples(args: Args, result: BenchmarkResult, wanted: Sequence[EpisodeLabel], progress: Progress) -> Path:
    """The first of the typical episodes, as the first monitor saw them."""
    name = args.monitors[0]
    threshold, settings = result.monitors[name].thresholds[args.false_alarm_rate], args.hyperparameters
    monitor = calibrated(args.out, name, wanted, args.seed, threshold, settings.get(model_of(name)))
    clips = [
        Clip(Trial.of(EpisodeLabel(t.task, "faulty", t.kind, t.severity, t.seed, t.onset)), t.condition)
        for t in result.monitors[name].examples[:SHOWN]
    ]
    return record_video(clips, args.config, monitor, args.out / "examples.mp4", progress)


def evaluate(args: Args, console: Console) -> BenchmarkResult:
    """Records, fits, judges and publishes."""
    args = able(args, console)
    seconds: dict[str, float] = {}
    with stage("listing episodes", console, seconds):
        wanted = labels(args)
    claim = {name: getattr(args, name) for name in ("robot", "policy", "seed", "steps")}
    claim |= {} if args.corpus is None else {"corpus": VERSION}
    with claimed(args.out, "recordings.json", claim):
        if args.corpus is None:
            with stage("recording", console, seconds) as progress:
                make = partial(record, config=args.config, folder=args.out.resolve())
                make_missing(make, wanted, lambda label: args.out / label.path, args.parallel, progress)
        with stage("fitting and judging", console, seconds) as progress:
            how = args.false_alarm_rate, args.window, args.seed, args.parallel
            recorded = None if args.corpus is None else args.corpus / "scripted"
            result = benchmark(args.out, wanted, args.monitors, *how, progress, args.hyperparameters, recorded)
        video = None
        if (
            args.video
            and args.corpus is None
            and not args.elsewhere
            and result.monitors[args.monitors[0]].examples
            and can_record_video(console)
        ):
            with stage("recording a video", console, seconds) as progress:
                video = show_examples(args, result, wanted, progress)
        with stage("drawing", console, seconds):
            details = json.loads(json.dumps(asdict(args), default=str))
            details |= {"python": platform.python_version(), "machine": platform.machine(), "seconds": seconds}
            publish(args.out, result, details, video)
    return result


def evaluate_and_report(args: Args, console: Console) -> None:
    """Evaluates, and prints the tables in brief."""
    result = evaluate(args, console)
    harmless = any(monitor.harmless for monitor in result.monitors.values())
    details = [harmless_table(result, args.monitors[:1])] if harmless else [kept_table(result), coverage_table(result)]
    for table in (brief_monitors_table(result), *(details if not args.elsewhere else [kinds_table(result)])):
        console.print(ConsoleTable(table))
    console.print(f"Wrote {args.out / 'report.html'} and {args.out / 'results.parquet'}")


def main(argv: list[str] | None = None) -> int:
    """Evaluates, and returns the exit code."""
    return run("evaluate", Args, evaluate_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
