"""Learn a memory of a body for any policy: record motor babbling, learn from it, and test the memory.

The memory is tested on policies and tasks that babbling never showed. A run can be killed at any time; the same command
continues it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from asm_gym.data.episode import load_episode
from asm_gym.detection.conformal import check_hours, check_per_hour
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.scoring import NOMINAL_ROLES
from asm_gym.evaluation.tables import markdown
from asm_gym.faults.suite import TEST, kinds_of, possible
from asm_gym.files import write_text
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.shipped import USUAL
from asm_gym.policies.registry import EXPERTS, agents, trained_in
from asm_gym.rollouts.collect import environment, record_missing
from asm_gym.rollouts.corpus import Corpus
from asm_gym.rollouts.pretraining.babbling import curriculum, record_lesson
from asm_gym.rollouts.pretraining.exam import (
    PROMISES,
    Exam,
    Marks,
    card,
    examine,
    promises_table,
    summary,
    usual_force,
)
from asm_gym.rollouts.pretraining.healthy import calibrate_body, healthy, held_out, learn_body
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed, make_missing, versions
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
LEFT_OUT = ("PickPlaceMilk", "NutAssemblyRound")
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
    """Babbling episodes (lessons) in each task; a second call with a larger number continues."""
    reaching: bool = False
    """Let hands reach for places instead of moving by noise alone, with one more lesson for each three that press."""
    stream_freq: int | None = option(None, least=1, metavar="HZ")
    """Rows of the stream per second; by default one per control step."""
    healthy_episodes: int = option(60, quick=0, least=0)
    """Expert episodes of each task to calibrate on, beside held-out lessons."""
    healthy_hours: float | None = option(None, least=0, metavar="HOURS")
    """Hours of each task in their place: fewer episodes of tasks that take longer."""
    corpus: Path | None = option(None, metavar="FOLDER")
    """Folder of asm-gym corpus, to calibrate also on its healthy hours of experts."""
    exam_episodes: int = option(60, quick=0, least=0)
    """Healthy episodes of each test; 0 for no test."""
    workers: int = option(2, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/babble"), metavar="FOLDER")
    """Folder of the run."""
    tasks: tuple[str, ...] | None = option(None)
    """Tasks to babble in; by default seven with the Panda, and with other arms those that their experts solve."""
    false_alarms_per_hour: float = option(5.0, quick=120.0, check=check_per_hour)
    """Promised false alarms per hour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.shown:
            check_choice("task of one arm with a gripper", name, _GRIPPED)
        if not self.shown:
            raise ValueError("there must be at least one task to babble in")
        lessons = sum(map(held_out, range(self.episodes)))
        steps = sum((lessons + self.healthy(t)) * task_spec(t).horizon for t in self.shown)
        check_hours(self.false_alarms_per_hour, steps / USUAL / 3600)

    def healthy(self, task: str) -> int:
        """Return how many episodes of a task's expert are recorded to calibrate on."""
        if self.healthy_hours is None:
            return self.healthy_episodes
        return math.ceil(3600 * USUAL * self.healthy_hours / task_spec(task).horizon)

    @property
    def shown(self) -> tuple[str, ...]:
        """Tasks to babble in."""
        return (
            self.tasks if self.tasks is not None else self._able(SHOWN)[: 2 if self.quick else None]
        )

    def _able(self, tasks: Sequence[str]) -> tuple[str, ...]:
        return tuple(t for t in tasks if self.robot == "Panda" or t not in _PANDAS)

    @property
    def config(self) -> RolloutConfig:
        """How episodes are made."""
        return RolloutConfig(robot=self.robot, stream_freq=self.stream_freq)

    @property
    def exams(self) -> list[Exam]:
        """Policies and tasks to examine it on; shipped agents were trained with the Panda."""
        homes = (
            {p: task_spec(trained_in(p)).name for p in agents()} if self.robot == "Panda" else {}
        )
        return [
            *(Exam(t, "scripted", known=True) for t in self.shown),
            *(
                Exam(t, "scripted", known=False)
                for t in self._able(LEFT_OUT)
                if t not in self.shown
            ),
            *(Exam(t, p, known=False) for p, t in homes.items()),
        ]


def learn(args: Args, console: Console) -> NeuralASM:
    """Record what is missing of lessons and of the experts' healthy hours; fit, calibrate and save the memory."""
    wanted = curriculum(args.shown, args.episodes, args.seed, args.reaching)
    with stage("babbling", console, {}) as progress:
        make = partial(record_lesson, config=args.config, folder=args.out.resolve())
        files = make_missing(
            make, wanted, lambda lesson: args.out / lesson.path, args.workers, progress
        )
    # in whichever order tasks were named
    lessons = healthy([load_episode(file) for file in sorted(files)])
    seeds = {task: role_seeds(HOURS_SEED, task, "hours", args.healthy(task)) for task in args.shown}
    trials = [
        trial
        for task, own in seeds.items()
        for trial in nominal_trials(task_spec(task).id, "nominal", own)
    ]
    with stage("healthy hours", console, {}) as progress:
        files = record_missing(trials, args.config, args.out / "hours", args.workers, progress)
    found = [load_episode(file) for file in files]
    if args.corpus is not None:
        found += Corpus.open(args.corpus).episodes(
            *NOMINAL_ROLES, policies=("scripted",), tasks=args.shown
        )
    hours = [episode for episode in found if episode.success]
    inner: Any = environment(task_spec(args.shown[0]).id, args.config.settings).unwrapped
    with stage("learning", console, {}) as progress:
        memory = learn_body(lessons, inner.stream_spec, args.seed, progress)
    calibrate_body(memory, lessons, hours, args.false_alarms_per_hour)
    name = args.robot.lower() + (f"_{args.stream_freq}hz" if args.stream_freq else "")
    memory.about = {
        "name": name,
        "controller": inner.controller,
        "tasks": list(args.shown),
        **{n: getattr(args, n) for n in ("reaching", "episodes", "seed", "false_alarms_per_hour")},
        "lessons": len(lessons.fit),
        "rows": sum(map(len, lessons.fit)),
        "hours": sum(len(e) * e.spec.dt for e in [*lessons.whole, *hours]) / 3600,
        **versions(),
    }
    memory.save(args.out / f"{name}.asm")
    return memory


def examined(args: Args, memory: NeuralASM, console: Console) -> list[Marks]:
    """Record the missing episodes of each exam, and score them; faults happen where a policy or a task is unknown."""
    marks = []
    usual: dict[str, float] = {}  # of each task, by its expert, who comes first
    for exam in args.exams:
        config = replace(args.config, policy=exam.policy)
        inner: Any = environment(task_spec(exam.task).id, config.settings).unwrapped
        kinds = [] if exam.known else [k for k in kinds_of((TEST,)) if possible(k, inner)]
        trials = exam.trials(args.exam_episodes, kinds, args.seed)
        with stage(exam.name, console, {}) as progress:
            files = record_missing(
                trials, config, args.out / "exams" / exam.policy, args.workers, progress
            )
            recordings = [load_episode(file) for file in files]
            expected = usual.setdefault(exam.task, usual_force(recordings))
            marks.append(examine(memory, exam.name, recordings, WINDOW_S, expected))
    return marks


def babble(args: Args, console: Console) -> None:
    """Record, learn, examine, and print the results."""
    claim = {n: getattr(args, n) for n in ("robot", "stream_freq", "seed", "reaching")}
    with claimed(args.out, "babble.json", claim):
        memory = learn(args, console)
        marks = examined(args, memory, console) if args.exam_episodes else []
        if marks:
            own = args.false_alarms_per_hour
            rates = [*(r for r in PROMISES if r > own), own]
            thresholds = {r: memory.threshold_at(false_alarms_per_hour=r) for r in rates}
            tables = card(marks, memory, WINDOW_S), promises_table(marks, thresholds, WINDOW_S)
            said = f"{summary(marks)}\nWith an adaptive threshold: {summary([m.adapted(own) for m in marks])}"
            write_text(args.out / "card.md", "\n\n".join([*map(markdown, tables), said]) + "\n")
            console.print(*tables, said, sep="\n")
    console.print(
        f"Wrote {args.out}/{memory.about['name']}.asm: NeuralASMSafety(env, NeuralASM.load(...)) watches with it"
    )


main = partial(run, "babble", Args, babble)
