"""Learn a memory of a body for any policy: record motor babbling, learn from it, and evaluate the memory.

The memory is evaluated on policies and tasks that babbling never showed. A run can be killed at any time; the same
command continues it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data.episode import Episode, load_episode
from asm_gym.detection.conformal import check_hours, check_per_hour
from asm_gym.evaluation.scoring import HEALTHY_ROLES
from asm_gym.evaluation.tables import markdown
from asm_gym.faults.suite import TEST, kinds_of, possible
from asm_gym.files import write_text
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.shipped import USUAL_HZ
from asm_gym.policies.registry import EXPERTS, agents, trained_in
from asm_gym.rollouts.detection_corpus import Corpus
from asm_gym.rollouts.pretraining.body_evaluation import (
    PROMISES,
    EvaluationCase,
    Scores,
    evaluate_case,
    promises_table,
    scores_table,
    summary,
    usual_force,
)
from asm_gym.rollouts.pretraining.body_memory import calibrate_body, healthy, held_out, learn_body
from asm_gym.rollouts.pretraining.training_motions import curriculum, record_motion
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed, make_missing, versions
from asm_gym.rollouts.run_trials import environment, record_missing
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, nominal_trials
from asm_gym.scripts.command import Options, option, run
from asm_gym.tasks import ROBOTS, TASKS
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

SHOWN = (
    "Lift",
    "Stack",
    "Door",
    "NutAssemblySquare",
    "PickPlaceCan",
    "PickPlaceBread",
    "PickPlaceCereal",
)
"""Tasks to babble in."""
LEFT_OUT = ("PickPlaceMilk", "NutAssemblyRound")
"""Tasks for the evaluation alone."""
HOURS_SEED = 11  # seed of the healthy hours
_PANDAS = {"Door", "NutAssemblySquare", "NutAssemblyRound"}
"""Tasks whose experts often fail with other arms than the Panda."""
_GRIPPED = tuple(
    name for name, task in TASKS.items() if task.arms == 1 and name in EXPERTS and name != "Wipe"
)
"""Tasks of one arm with a gripper, whose streams are alike."""


@dataclass(frozen=True)
class Args(Options):
    """Options of babbling."""

    robot: str = option("Panda", known=ROBOTS)
    """The arm."""
    episodes: int = option(60, quick=18, least=1)
    """Babbling episodes in each task; a second call with a larger number continues."""
    reaching: bool = False
    """Let hands reach for places instead of moving by noise alone, with one more episode for each three that press."""
    stream_freq: int | None = option(None, least=1, metavar="HZ")
    """Rows of the stream per second; by default one per control step."""
    healthy_episodes: int = option(60, quick=0, least=0)
    """Expert episodes of each task to calibrate on, beside held-out babbling."""
    healthy_hours: float | None = option(None, least=0, metavar="HOURS")
    """Hours of each task in their place: fewer episodes of tasks that take longer."""
    corpus: Path | None = option(None, metavar="FOLDER")
    """Folder of asm-gym corpus, to calibrate also on its healthy hours of experts."""
    exam_episodes: int = option(60, quick=0, least=0)
    """Healthy episodes of each evaluation; 0 for none."""
    workers: int = option(2, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/babble"), metavar="FOLDER")
    """Folder of the run."""
    tasks: tuple[str, ...] | None = option(None, metavar="TASK ...")
    """Tasks to babble in; by default seven with the Panda, and with other arms those that their experts solve."""
    false_alarms_per_hour: float = option(5.0, quick=120.0, check=check_per_hour)
    """Promised false alarms per hour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.shown:
            check_choice("task of one arm with a gripper", name, _GRIPPED)
        if not self.shown:
            raise ValueError("there must be at least one task to babble in")
        motions = sum(map(held_out, range(self.episodes)))
        steps = sum((motions + self.healthy(t)) * task_spec(t).horizon for t in self.shown)
        check_hours(self.false_alarms_per_hour, steps / USUAL_HZ / 3600)

    def healthy(self, task: str) -> int:
        """Return how many episodes of a task's expert are recorded to calibrate on."""
        if self.healthy_hours is None:
            return self.healthy_episodes
        return math.ceil(3600 * USUAL_HZ * self.healthy_hours / task_spec(task).horizon)

    @property
    def shown(self) -> tuple[str, ...]:
        """Tasks to babble in."""
        if self.tasks is not None:
            return self.tasks
        if self.quick:
            return self._able(SHOWN)[:2]
        return self._able(SHOWN)

    def _able(self, tasks: Sequence[str]) -> tuple[str, ...]:
        if self.robot == "Panda":
            return tuple(tasks)
        return tuple(task for task in tasks if task not in _PANDAS)

    @property
    def config(self) -> RolloutConfig:
        """How episodes are made."""
        return RolloutConfig(robot=self.robot, stream_freq=self.stream_freq)

    @property
    def cases(self) -> list[EvaluationCase]:
        """Policies and tasks to evaluate it on; shipped agents were trained with the Panda."""
        unknown = [task for task in self._able(LEFT_OUT) if task not in self.shown]
        cases = [EvaluationCase(task, "scripted", known=True) for task in self.shown]
        cases += [EvaluationCase(task, "scripted", known=False) for task in unknown]
        if self.robot == "Panda":
            for policy in agents():
                task = task_spec(trained_in(policy)).name
                cases.append(EvaluationCase(task, policy, known=False))
        return cases


def record_motions(args: Args) -> list[Episode]:
    """Record the training motions that are missing, and return all."""
    motions = curriculum(args.shown, args.episodes, args.seed, args.reaching)
    make = partial(record_motion, config=args.config, folder=args.out.resolve())
    with stage("babbling") as progress:
        files = make_missing(
            make, motions, lambda motion: args.out / motion.path, args.workers, progress
        )
    return [load_episode(file) for file in sorted(files)]  # in whichever order tasks were named


def record_hours(args: Args) -> list[Episode]:
    """Record the healthy hours of the experts that are missing, and return all in which they succeed.

    But for those with a missing number, such as the pose of an object that is out of sight: that is an alarm at
    whatever threshold.
    """
    trials = []
    for task in args.shown:
        seeds = role_seeds(HOURS_SEED, task, "hours", args.healthy(task))
        trials += nominal_trials(task_spec(task).id, "nominal", seeds)
    with stage("healthy hours") as progress:
        files = record_missing(trials, args.config, args.out / "hours", args.workers, progress)
    hours = [load_episode(file) for file in files]
    if args.corpus is not None:
        hours += Corpus.open(args.corpus).episodes(
            *HEALTHY_ROLES, policies=("scripted",), tasks=args.shown
        )
    return [e for e in hours if e.success and np.isfinite(e.stream).all()]


def pretrain(args: Args) -> NeuralASM:
    """Record what is missing of training motions and healthy hours; fit, calibrate and save the memory."""
    motions = healthy(record_motions(args))
    hours = record_hours(args)
    arm: Any = environment(task_spec(args.shown[0]).id, args.config.settings).unwrapped
    with stage("learning") as progress:
        memory = learn_body(motions, arm.stream_spec, args.seed, progress)
    calibrate_body(memory, motions, hours, args.false_alarms_per_hour)
    name = args.robot.lower()
    if args.stream_freq:
        name += f"_{args.stream_freq}hz"
    memory.about = {
        "name": name,
        "controller": arm.controller,
        "tasks": list(args.shown),
        "reaching": args.reaching,
        "episodes": args.episodes,
        "seed": args.seed,
        "false_alarms_per_hour": args.false_alarms_per_hour,
        "lessons": len(motions.fit),
        "rows": sum(map(len, motions.fit)),
        "hours": sum(len(e) * e.spec.dt for e in [*motions.whole, *hours]) / 3600,
        **versions(),
    }
    memory.save(args.out / f"{name}.asm")
    return memory


def evaluate(args: Args, memory: NeuralASM) -> list[Scores]:
    """Record the missing episodes of each case, and score them; faults happen where a policy or a task is unknown."""
    scores = []
    usual: dict[str, float] = {}  # force in each task, by its expert, who comes first
    for case in args.cases:
        config = replace(args.config, policy=case.policy)
        arm: Any = environment(task_spec(case.task).id, config.settings).unwrapped
        kinds = []
        if not case.known:
            kinds = [kind for kind in kinds_of((TEST,)) if possible(kind, arm)]
        trials = case.trials(args.exam_episodes, kinds, args.seed)
        folder = args.out / "exams" / case.policy
        with stage(case.name) as progress:
            files = record_missing(trials, config, folder, args.workers, progress)
            recordings = [load_episode(file) for file in files]
            force = usual.setdefault(case.task, usual_force(recordings))
            scores.append(evaluate_case(memory, case.name, recordings, force))
    return scores


def babble(args: Args, console: Console) -> None:
    """Record, learn, evaluate, and print the results."""
    claim = {n: getattr(args, n) for n in ("robot", "stream_freq", "seed", "reaching")}
    with claimed(args.out, "babble.json", claim):
        memory = pretrain(args)
        if args.exam_episodes:
            publish(args, memory, evaluate(args, memory), console)
    console.print(
        f"Wrote {args.out}/{memory.about['name']}.asm: NeuralASMSafety(env, "
        "NeuralASM.load(...)) watches with it"
    )


def publish(args: Args, memory: NeuralASM, scores: Sequence[Scores], console: Console) -> None:
    """Print the scores, and write them to a file."""
    own = args.false_alarms_per_hour
    rates = [*(rate for rate in PROMISES if rate > own), own]
    thresholds = {rate: memory.threshold_at(false_alarms_per_hour=rate) for rate in rates}
    tables = [
        scores_table(scores, memory),
        promises_table(scores, thresholds),
    ]
    adapted = summary([each.adapted(own) for each in scores])
    result = f"{summary(scores)}\nWith an adaptive threshold: {adapted}"
    text = "\n\n".join([*map(markdown, tables), result])
    write_text(args.out / "card.md", text + "\n")
    console.print(*tables, result, sep="\n")


main = partial(run, "babble", Args, babble)
