"""Trains the same agent alone and under the safety wrapper: fewer violations on the way, as much success in the end?

An untrained actor learns by SAC with demonstrations in its replay buffer: alone; where an alarm costs reward and ends
the episode; and where the robot holds on an alarm. The memory knows harmless exploration, in which none of the runs
takes part; or it is a shipped memory of the body (``--memory panda``), and nothing is recorded for it. A run can be
killed at any time: what has been recorded, fitted or trained is not made again.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, load_episode
from asm_gym.evaluation import figures
from asm_gym.evaluation.tables import Table, console_table, markdown
from asm_gym.monitors import NeuralASM, load_monitor, pretrained
from asm_gym.monitors.shipped import pretrained_file
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.parallel import THIS_PROCESS, ParallelConfig, Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed, make_missing
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.exploration import Gentle, explore, harmless
from asm_gym.rollouts.training.outcome import COUNTED, TrainingOutcome
from asm_gym.rollouts.training.safe_run import ALONE, CONDITIONS, Setting, outcome_file, read_outcome, run
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts import command
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.training_report import counts_table, learning_figure, worth_table
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

DEMONSTRATIONS, FITTING, TESTING = 11, 12, 13
"""Stages of the seeds of episodes that are recorded."""
FREE = ("seeds", "conditions", "parallel", "out")
"""What may change while a comparison goes on."""


@dataclass(frozen=True)
class Args:
    """Training alone against training under the wrapper, paired by seed."""

    task: str = "Lift"
    """Name of a task with a scripted expert, whose contacts are gentle."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """What to compare: alone, terminate, hold; alone must be among them."""
    seeds: int = 5
    """Runs of each condition."""
    steps: int = 2_500
    """Control steps of each run."""
    demonstrations: int = 50
    """Episodes of the expert in the replay buffer, and as many others for a memory of the expert."""
    memory: str | None = None
    """What watches: the name of a shipped memory, or the path of one; by default one of exploration is made."""
    fit_episodes: int = 120
    """Episodes of exploration that the memory learns from."""
    calibration_episodes: int = 60
    """Other episodes of exploration that its threshold is set on."""
    test_episodes: int = 40
    """Other episodes of exploration that its false alarms are counted in."""
    false_alarm_rate: float = 0.05
    """Share of harmless episodes of exploration that may raise an alarm."""
    harmless_force: float = 20.0
    """External force above which exploration is no longer harmless [N]."""
    harmless_torque: float = 10.0
    """External torque on a joint above which it is not harmless [N m]: arms that hit themselves, joints at stops."""
    force_limit: float = 40.0
    """External force above which a contact is a violation [N]."""
    cost: float = 1.0
    """What an alarm takes off the reward where it ends the episode."""
    evaluate_every: int = 500
    """Control steps between evaluations."""
    evaluation_episodes: int = 10
    """Episodes of each evaluation."""
    final_episodes: int = 100
    """Episodes of the last evaluation."""
    parallel: tyro.conf.OmitArgPrefixes[ParallelConfig] = THIS_PROCESS
    """Who does the work."""
    seed: int = 0
    """The first of the runs' seeds, and the seed of all that is recorded."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/train_safely")
    """Folder of the comparison."""
    quick: bool = False
    """Two seeds and little of everything: to see that everything runs."""

    def __post_init__(self) -> None:
        task_spec(self.task)
        for name in self.conditions:
            check_choice("condition", name, CONDITIONS)
        if ALONE not in self.conditions:
            raise ValueError(f"conditions must hold {ALONE}, which the others are compared with")
        at_least(1, self, "seeds", "steps", "evaluate_every", *(n for n in vars(self) if n.endswith("episodes")))
        for name in ("harmless_force", "harmless_torque", "force_limit"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}")
        needed = conformal_episodes(self.false_alarm_rate)
        if self.memory is not None and self.memory not in pretrained():
            load_monitor(self.memory)  # refused before anything runs
        if min(self.calibration_episodes, self.demonstrations) < needed:
            raise ValueError(
                f"a false-alarm rate of {self.false_alarm_rate:g} needs {needed} calibration_episodes and as many "
                f"demonstrations, got {self.calibration_episodes} and {self.demonstrations}"
            )

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        return replace(
            self,
            false_alarm_rate=0.2,
            fit_episodes=10,
            calibration_episodes=9,
            test_episodes=3,
            demonstrations=9,
            seeds=min(2, self.seeds),
            steps=600,
            evaluate_every=300,
            evaluation_episodes=1,
            final_episodes=2,
        )

    @property
    def env_id(self) -> str:
        return task_spec(self.task).id

    @property
    def gentle(self) -> Gentle:
        return Gentle(self.harmless_force, self.harmless_torque)

    @property
    def setting(self) -> Setting:
        names = ("env_id", "steps", "evaluate_every", "evaluation_episodes", "final_episodes", "force_limit", "cost")
        return Setting(**{name: getattr(self, name) for name in names})


class Recorded(NamedTuple):
    """Files of episodes."""

    expert: list[Path]  # twice the demonstrations: those of the buffer, and others
    exploration: list[Path]  # to fit on and to calibrate on; none for a memory that is there already
    testing: list[Path]


def record(args: Args, progress: Progress) -> Recorded:
    """Records what is not there yet."""
    folder = args.out.resolve() / "episodes"
    shown = episode_seeds(args.seed, 2 * args.demonstrations, DEMONSTRATIONS)
    expert = collect_to(folder / "expert", args.env_id, RolloutConfig(), shown, args.parallel, progress)

    def explored(count: int, stage: int) -> list[Path]:
        make = partial(explore, env_id=args.env_id, gentle=args.gentle, folder=folder / "exploration")
        seeds = episode_seeds(args.seed, count, stage)
        return make_missing(make, seeds, lambda s: folder / "exploration" / f"{s}.npz", args.parallel, progress)

    fitting = [] if args.memory else explored(args.fit_episodes + args.calibration_episodes, FITTING)
    return Recorded(expert, fitting, explored(args.test_episodes, TESTING))


def memories(args: Args, recorded: Recorded) -> dict[str, Path]:
    """One memory that watches, and one of the expert, to compare; fitted where they are not yet."""
    expert = [load_episode(f) for f in recorded.expert]
    n, k = args.fit_episodes, args.demonstrations
    learned: dict[str, tuple[list[Episode], list[Episode]]] = {"the expert": (expert[:k], expert[k:])}
    paths = {}
    if args.memory is None:
        explored = harmless(recorded.exploration[:n]), harmless(recorded.exploration[n:])
        learned = {"exploration": explored, **learned}
    else:
        paths["the body"] = pretrained_file(args.memory) if args.memory in pretrained() else Path(args.memory)
    for name, (fit, calibration) in learned.items():
        paths[name] = args.out.resolve() / f"{name.removeprefix('the ')}.asm"
        if not paths[name].is_file():
            if not fit:
                raise ValueError(f"no episode stays harmless for long enough: is {args.task} done gently?")
            memory = NeuralASM(fit[0].spec, seed=args.seed, epochs=5 if args.quick else 40).fit(fit)
            memory.calibrate(calibration, args.false_alarm_rate).save(paths[name])
    return paths


def surprise_table(args: Args, memory: Mapping[str, Path], recorded: Recorded) -> Table:
    """How much each memory finds wrong where nothing is."""
    kinds = {
        "harmless exploration": harmless(recorded.testing),
        "the expert": [load_episode(f) for f in recorded.expert[: args.test_episodes]],
    }
    rows = []
    for name, path in memory.items():
        watching = NeuralASM.load(path)
        cells = [f"a memory of {name}"]
        for episodes in kinds.values():
            alarms = [s.value > watching.threshold for s in watching.score_episodes(episodes)]
            cells.append(f"{100 * np.concatenate(alarms).mean():.1f} %")
            cells.append(f"{sum(a.any() for a in alarms)} of {len(alarms)}")
        rows.append(tuple(cells))
    headings = [f"{kind}: {what}" for kind in kinds for what in ("steps in alarm", "episodes with one")]
    return Table(
        f"False alarms where nothing presses with more than {args.harmless_force:g} N or {args.harmless_torque:g} N m; "
        "the thresholds are for "
        f"{100 * args.false_alarm_rate:g} % of the episodes that each memory knows. The memory of the expert has "
        "learned from these episodes of the expert.",
        ("", *headings),
        rows,
    )


def train_safely(args: Args, console: Console) -> list[Table]:
    """Records, fits, trains, compares and writes."""
    with claimed(args.out, "train_safely.json", {k: v for k, v in vars(args).items() if k not in FREE}):
        return _train_safely(args, console)


def _train_safely(args: Args, console: Console) -> list[Table]:
    seconds: dict[str, float] = {}
    with stage("recording", console, seconds) as progress:
        recorded = record(args, progress)
    with stage("fitting", console, seconds):
        memory = memories(args, recorded)
        surprises = surprise_table(args, memory, recorded)
    jobs = [(c, args.seed + n) for n in range(args.seeds) for c in args.conditions]
    folder = args.out.resolve() / "outcomes"
    with stage("training", console, seconds) as progress:
        each = partial(
            run,
            setting=args.setting,
            memory=next(iter(memory.values())),
            demonstrations=recorded.expert[: args.demonstrations],
            folder=folder,
        )
        outcome = make_missing(each, jobs, lambda job: outcome_file(folder, job), args.parallel, progress)
        made = [read_outcome(path) for path in outcome]
    outcomes = {c: [o for o in made if o.condition == c] for c in args.conditions}
    tables = [counts_table(outcomes, args.force_limit), worth_table(outcomes, ALONE, args.force_limit), surprises]
    _write(args, outcomes, tables, seconds)
    return tables


def _write(
    args: Args, outcomes: Mapping[str, Sequence[TrainingOutcome]], tables: Sequence[Table], seconds: Mapping[str, float]
) -> None:
    (args.out / "training.md").write_text("\n\n".join(map(markdown, tables)) + "\n", encoding="utf-8")
    every = [o for runs in outcomes.values() for o in runs]
    rows = [(o.condition, o.seed, o.steps, *(sum(getattr(o, n)) for n in COUNTED), o.success) for o in every]
    with (args.out / "training.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("condition", "seed", "steps", *COUNTED, "success"), *rows])
    content = {"settings": asdict(args), "seconds": seconds, "runs": [asdict(o) for o in every]}
    (args.out / "training.json").write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")
    figures.save(learning_figure(outcomes, args.force_limit), args.out / "training.png")


def train_and_report(args: Args, console: Console) -> None:
    """Trains, and prints the tables."""
    args = args.scaled()
    tables = train_safely(args, console)
    for table in tables:
        console.print(console_table(table))
    console.print(f"Wrote {args.out / 'training.md'}, training.csv, training.json and training.png")


def main(argv: list[str] | None = None) -> int:
    """Trains, and returns the exit code."""
    return command.run("reproduce safe_training", Args, train_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
