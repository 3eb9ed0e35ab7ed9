"""One memory of a body, for any policy: records motor babbling, learns from it, and examines what came of it.

The memory alarms at what no body does, whatever the policy wants. It is examined on policies and on tasks that babbling
never showed. A run lives in one folder and can be killed at any time: what was recorded is not recorded again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from asm_gym.detection import check_per_hour
from asm_gym.detection.hourly import check_hours
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.tables import ConsoleTable, markdown
from asm_gym.faults.suite import TEST, kinds_of, possible
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.shipped import USUAL
from asm_gym.policies import make_policy
from asm_gym.policies.registry import EXPERTS, agents, trained_in
from asm_gym.rollouts.corpus import Corpus
from asm_gym.rollouts.parallel import ParallelConfig
from asm_gym.rollouts.pretraining.babbling import curriculum, record_lesson
from asm_gym.rollouts.pretraining.healthy import (
    Lessons,
    apart,
    calibrate_body,
    for_threshold,
    healthy,
    held_out,
    learn_body,
)
from asm_gym.rollouts.pretraining.model_card import Exam, Marks, at_rates, card, examine, usual_force
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.record import record
from asm_gym.rollouts.run_folder import NOMINAL_ROLES, claimed, labelled, make_missing, versions
from asm_gym.rollouts.scoring import code_digest
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.staging import environment
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.tasks import ROBOTS, TASKS
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice, check_number

SHOWN = ("Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal")
LEFT_OUT = ("PickPlaceMilk", "NutAssemblyRound")
PER_HOUR, RATES = 5.0, (10.0, 3.0, 1.0)
"""False alarms an hour that a memory is calibrated for, and at which an examination is also told."""
HEALTHY, HOURS_SEED = 60, 11
"""Episodes of the expert of each task to calibrate on, and of what their seeds are drawn."""
LEARNING = (
    *("memory", "detection", "scaling.py", "spec.py", "rollouts/pretraining/healthy.py"),
    *("monitors/memory_model.py", "monitors/monitor.py", "monitors/neural_asm.py"),
)
"""What decides, in the package, over what a body learns of the same lessons."""
_PANDAS = {"Door", "NutAssemblySquare", "NutAssemblyRound"}
"""Tasks whose experts are at home with the Panda: with other arms some of them never succeed."""
_GRIPPED = tuple(name for name, task in TASKS.items() if task.arms == 1 and name in EXPERTS and name != "Wipe")
"""Tasks of one arm with a gripper, whose streams are alike."""


@dataclass(frozen=True)
class Args:
    """A memory of a body, from motor babbling."""

    robot: str = option("Panda", known=ROBOTS)
    """The arm."""
    guides: tuple[str, ...] = option((), metavar="AGENT")
    """Agents that lead in turn with the experts, by name or the files of asm-gym train; none by default."""
    episodes: int = option(60, quick=18, least=1)
    """Lessons in each task; a second call with more of them goes on."""
    reaching: bool = False
    """Whether hands reach for places where noise alone would move them; one lesson more for each three presses."""
    stream_freq: int | None = option(None, least=1, metavar="HZ")
    """Rows of the stream a second; one each control step by default."""
    exam_policies: tuple[str, ...] | None = fixed(None, quick=())
    """Agents to examine under, as guides are named; by default all that are shipped and fit this arm."""
    healthy_episodes: int = option(HEALTHY, quick=0, least=0)
    """Episodes of the expert of each task to calibrate on, beside the lessons that are left out."""
    corpus: Path | None = option(None, metavar="FOLDER")
    """What asm-gym corpus has recorded: the experts' healthy hours in it are calibrated on, too."""
    workers: str = option("2", check=ParallelConfig.named, metavar="N")
    """Processes; or a cluster that is running, as dask:tcp://host:8786 or ray:host:6379, which shares the folder."""
    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same result."""
    out: Path = option(Path("runs/babble"), metavar="FOLDER")
    """Folder of the run."""
    quick: bool = False
    """To see that everything runs, not to judge the figures."""
    exam_episodes: int = fixed(60, quick=2, least=0)
    """Healthy episodes of each examination; 0 examines nothing."""
    exam_faults: tuple[str, ...] = fixed((TEST,), quick=())
    """Kinds of fault, each medium and strong but for pushes of 20 N, where the policy or the task was left out."""
    exam_pushes: int = fixed(3, quick=0)
    """Pushes of 20 N in each examination in which there are faults; they are judged by how soon they are noticed."""
    tasks: tuple[str, ...] | None = fixed(None)
    """Tasks to babble in; by default seven with the Panda, and with other arms those of them that their experts do."""
    exam_tasks: tuple[str, ...] | None = fixed(None, quick=())
    """Further tasks to examine in; by default two that Panda experts do, with other arms those of them they do."""
    false_alarms_per_hour: float = fixed(PER_HOUR, quick=120.0, check=check_per_hour)
    """Faults that may be said in an hour of healthy episodes."""
    window: float = fixed(WINDOW_S, check=partial(check_number, "window", above=0))
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        check_options(self)
        for name in (*self.shown, *self.left_out):
            check_choice("task of one arm with a gripper", name, _GRIPPED)
        for name in (*self.guides, *(self.exam_policies or ())):
            if not name.endswith(".npz"):  # whether a file is there is asked later
                check_choice("agent", name, agents())
        if not self.shown:
            raise ValueError("there must be at least one task to babble in")
        kinds_of(self.exam_faults)
        each = sum(map(held_out, range(self.episodes))) + self.healthy_episodes
        check_hours(self.false_alarms_per_hour, each * sum(task_spec(t).horizon for t in self.shown) / USUAL / 3600)

    @property
    def parallel(self) -> ParallelConfig:
        """Who does the work."""
        return ParallelConfig.named(self.workers)

    @property
    def shown(self) -> tuple[str, ...]:
        """Tasks to babble in."""
        if self.tasks is not None:
            return self.tasks
        return self._able(SHOWN)[: 2 if self.quick else None]

    @property
    def left_out(self) -> tuple[str, ...]:
        """Further tasks to examine in."""
        return self._able(LEFT_OUT) if self.exam_tasks is None else self.exam_tasks

    def _able(self, tasks: Sequence[str]) -> tuple[str, ...]:
        return tuple(t for t in tasks if self.robot == "Panda" or t not in _PANDAS)

    @property
    def config(self) -> RolloutConfig:
        return RolloutConfig(robot=self.robot, stream_freq=self.stream_freq)

    @property
    def name(self) -> str:
        """Of the memory."""
        return self.robot.lower() + (f"_{self.stream_freq}hz" if self.stream_freq else "")

    @property
    def exams(self) -> list[Exam]:
        """What to examine it on."""
        policies = agents() if self.exam_policies is None else self.exam_policies
        homes = {p: task_spec(trained_in(p)).name for p in policies}
        if self.robot != "Panda":  # which all of them were trained with
            homes = {}
        return [
            *(Exam(t, "scripted", known=True) for t in self.shown),
            *(Exam(t, "scripted", known=False) for t in self.left_out if t not in self.shown),
            *(Exam(t, p, known=p in self.guides) for p, t in homes.items()),
        ]


def check(args: Args) -> None:
    """Raises what is wrong with the agents that are to lead or to be examined under, before the folder is claimed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, of another arm, or of a task in which nothing babbles.
    """
    there = {task_spec(name).id for name in args.shown}
    for guide in args.guides:
        home = trained_in(guide)
        if home not in there:
            raise ValueError(
                f"{guide} was trained in {home or 'an environment without a name'} and can lead only there; "
                f"tasks to babble in: {', '.join(args.shown)}"
            )
        make_policy(guide, environment(home, args.config.settings))
    for exam in args.exams:
        if exam.policy.endswith(".npz"):
            make_policy(exam.policy, environment(task_spec(exam.task).id, args.config.settings))


def learn(args: Args, console: Console) -> NeuralASM:
    """Records what is missing, and fits, calibrates and saves the memory, unless this code has learned it already."""
    lessons = healthy_lessons(args, console)
    hours = [e for e in healthy_hours(args, console) if e.success]
    inner: Any = environment(task_spec(args.shown[0]).id, args.config.settings).unwrapped
    whole = [*lessons.whole, *hours]
    about = {
        "name": args.name,
        "controller": inner.controller,
        "tasks": args.shown,
        **{n: getattr(args, n) for n in ("guides", "reaching", "episodes", "seed", "false_alarms_per_hour")},
        "lessons": len(lessons.fit),
        "rows": sum(map(len, lessons.fit)),
        **calibrated(whole, args.false_alarms_per_hour),
        "code": code_digest(names=LEARNING),
        **versions(),
    }
    about, path = json.loads(json.dumps(about)), args.out / f"{args.name}.asm"
    with suppress(FileNotFoundError, ValueError):  # one that is damaged is learned anew
        memory = NeuralASM.load(path)
        if memory.about == about:
            return memory
    with stage("learning", console, {}) as progress:
        memory = learn_body(lessons, inner.stream_spec, args.seed, progress)
    calibrate_body(memory, lessons, hours, args.false_alarms_per_hour)
    memory.about = about
    memory.save(path)
    return memory


def healthy_lessons(args: Args, console: Console) -> Lessons:
    """What is healthy of the lessons; those that are missing are recorded."""
    wanted = curriculum(args.shown, args.episodes, args.seed, args.guides, args.reaching)
    with stage("babbling", console, {}) as progress:
        make = partial(record_lesson, config=args.config, folder=args.out.resolve())
        files = make_missing(make, wanted, lambda lesson: args.out / lesson.path, args.parallel, progress)
    return healthy([load_episode(file) for file in sorted(files)])  # in whichever order tasks were named


def calibrated(whole: Sequence[Episode], per_hour: float) -> dict[str, Any]:
    """What a memory says of the episodes that its threshold was set on, and of those that told ceilings."""
    whole, told = for_threshold(whole)
    found = {"calibrated_on": len(whole), "hours": _hours(whole), "each": bool(apart(whole, per_hour))}
    return found | ({"ceilings_on": len(told), "ceilings_hours": _hours(told)} if told else {})


def _hours(episodes: Sequence[Episode]) -> float:
    return sum(len(e) * e.spec.dt for e in episodes) / 3600


def healthy_hours(args: Args, console: Console) -> list[Episode]:
    """Episodes of the experts of the tasks that are shown; those that are missing are recorded, a corpus is read."""
    folder = (args.out / "hours").resolve()
    labels = [
        EpisodeLabel(task, "nominal", seed=seed)
        for task in args.shown
        for seed in role_seeds(HOURS_SEED, task, "hours", args.healthy_episodes)
    ]
    with stage("healthy hours", console, {}) as progress:
        make = partial(record, config=args.config, folder=folder)
        make_missing(make, labels, partial(_place, folder=folder), args.parallel, progress)
    recorded = labelled(folder, labels)
    if args.corpus is None:
        return recorded
    return [*recorded, *Corpus.open(args.corpus).episodes(*NOMINAL_ROLES, policies=("scripted",), tasks=args.shown)]


def examined(args: Args, memory: NeuralASM, console: Console) -> list[Marks]:
    """What the memory made of each exam, whose missing episodes are recorded."""
    marks = []
    usual: dict[str, float] = {}  # of each task, by its expert, who comes first
    for exam in args.exams:
        config = replace(args.config, policy=exam.policy)
        folder = (args.out / "exams" / exam.policy.removesuffix(".npz").replace("/", "-")).resolve()
        inner: Any = environment(task_spec(exam.task).id, config.settings).unwrapped
        kinds = [] if exam.known else [k for k in kinds_of(args.exam_faults) if possible(k, inner)]
        labels = exam.labels(args.exam_episodes, kinds, args.seed, 0 if exam.known else args.exam_pushes)
        with stage(exam.name, console, {}) as progress:
            make = partial(record, config=config, folder=folder)
            make_missing(make, labels, partial(_place, folder=folder), args.parallel, progress)
            recordings = labelled(folder, labels)
            expected = usual.setdefault(exam.task, usual_force(recordings))
            marks.append(examine(memory, exam.name, recordings, args.window, expected))
    return marks


def _place(label: EpisodeLabel, folder: Path) -> Path:
    return folder / label.path


def babble(args: Args, console: Console) -> None:
    """Records, learns, examines, and says what came of it."""
    check(args)
    claim = {n: getattr(args, n) for n in ("robot", "guides", "stream_freq", "seed")}
    claim["reaching"] = "and pressing" if args.reaching else None  # as folders of before there was any say nothing
    with claimed(args.out, "babble.json", claim):
        memory = learn(args, console)
        marks = examined(args, memory, console) if args.exam_episodes else []
        if marks:
            others = [rate for rate in RATES if rate != args.false_alarms_per_hour]
            table, said = card(marks, memory, args.window), at_rates(marks, memory, others)
            (args.out / "card.md").write_text(f"{markdown(table)}\n\n{said}\n", encoding="utf-8")
            console.print(ConsoleTable(table))
            console.print(said)
    console.print(f"Wrote {args.out / args.name}.asm: NeuralASMSafety(env, NeuralASM.load(...)) watches with it")


def main(argv: list[str] | None = None) -> int:
    """Babbles, and returns the exit code."""
    return run("babble", Args, babble, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
