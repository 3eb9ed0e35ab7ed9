"""One memory of a body under policies and in tasks that it never met: false alarms, faults found, and its rivals.

The memory of the body learns from motor babbling (``asm-gym babble``), and so do all rivals. It is compared with a
memory of one policy, the experts'; with itself after a few episodes of the policy that it watches; with a running
threshold; and without senses that a stream may lack. Nobody has met the agents, the speeds, the noise and the tasks.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.faults.suite import kinds_of
from asm_gym.monitors import EVIDENCE, MONITORS, CalibratedMonitor, NeuralASM
from asm_gym.rollouts.pretraining.babbling import curriculum, record_lesson
from asm_gym.rollouts.pretraining.healthy import harmless, healthy, held_out, learn_body
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.scoring import fitted
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import Common, Findings, Record, demonstrations, reproduce
from asm_gym.scripts.reproduce.transfer_judge import Judge, Own, fewer_senses, role
from asm_gym.scripts.reproduce.transfer_report import drawn, tables
from asm_gym.scripts.reproduce.transfer_watched import KNOWN, POLICIES, WATCHED, Watched, record_watched
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

SHIPPED = "panda"
"""The memory of this body that comes with the package, at the rate that it was shipped with."""


@dataclass(frozen=True)
class Args(Common):
    """A memory of a body, under policies and in tasks that it never met."""

    seeds: int = 1
    """How often every memory and rival is fitted anew; what is recorded is the same for all."""
    out: Path = Path("runs/transfer")
    """Folder of the study."""
    tasks: tuple[str, ...] = (
        *("Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal"),
    )
    """Tasks to babble in; among them those of the memory of one policy."""
    lessons: int = 24
    """Lessons of babbling in each task; a third of them to calibrate on."""
    demonstrations: int = 20
    """Episodes of each expert for the memory of one policy."""
    calibration_episodes: int = 20
    """As many others to set its threshold on."""
    nominal_episodes: int = 12
    """Healthy episodes of each policy that is watched."""
    own_episodes: int = 20
    """Episodes of a policy to specialise on, and as many to calibrate on."""
    specialised: tuple[str, ...] = ("lift_sac", "stack_sac")
    """Policies to specialise on."""
    scratch_episodes: int = 0
    """Episodes of such a policy for a memory that learns of it alone, from scratch, to compare with; 0 for none."""
    agents: tuple[tuple[str, str], ...] = ()
    """Further agents to watch: a task and the file of an agent for each, such as Lift runs/train/clone.npz."""
    broken: tuple[str, ...] = ("lift_sac", "stack_sac", "door_sac")
    """Policies under which there are faults."""
    faults: tuple[str, ...] = ("test",)
    """Kinds of fault; development and test stand for halves of the suite."""
    faulty_episodes: int = 1
    """Faulty episodes of each policy, kind and severity."""
    without: tuple[str, ...] = ("Door",)
    """Tasks that are left out of babbling, one at a time, for a memory that has not met their expert either."""
    rivals: tuple[str, ...] = ("gru", "lstm_vae", "logpzo", "kalman", "association_linear")
    """Monitors by the same protocol, each with its authors' detection and with ours."""
    false_alarm_rate: float = 0.05
    """Share of healthy episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.tasks, *self.without):
            task_spec(name)
        for name in self.without:
            check_choice("task to leave out", name, self.tasks)
        for name, _ in self.agents:
            task_spec(name)
        at_least(0, self, "scratch_episodes")
        for name in self.rivals:
            check_choice("monitor", name, MONITORS)
        kinds_of(self.faults)
        at_least(1, self, "nominal_episodes")
        at_least(0, self, "faulty_episodes")
        needed = conformal_episodes(self.false_alarm_rate)
        calm = sum(map(held_out, range(self.lessons)))  # lessons to calibrate on
        given = (len(self.tasks) - bool(self.without)) * calm, 3 * self.calibration_episodes
        if min(given) < needed:
            raise ValueError(
                f"a rate of {self.false_alarm_rate:g} needs {needed} episodes to calibrate on, got {given}"
            )

    def scaled(self) -> Args:
        """With ``quick``, two policies and little of everything."""
        if not self.quick:
            return self
        return replace(
            self,
            tasks=("Lift", "Stack", "Door"),
            lessons=12,
            demonstrations=4,
            calibration_episodes=5,
            nominal_episodes=2,
            own_episodes=4,
            specialised=("lift_sac",),
            broken=("lift_sac",),
            faults=("push", "frozen_encoder"),
            without=(),
            rivals=("kalman",),
            false_alarm_rate=0.2,
        )

    @property
    def watched(self) -> tuple[Watched, ...]:
        given = tuple(Watched(task, str(Path(file).resolve()), group=POLICIES) for task, file in self.agents)
        return ((WATCHED[0], WATCHED[3]) if self.quick else WATCHED) + given


def labels(watched: Watched, args: Args) -> list[EpisodeLabel]:
    """What is recorded of it."""
    own = args.own_episodes if watched.policy in args.specialised else 0
    faulty = args.faulty_episodes if watched.policy in args.broken else 0
    learned = max(own, args.scratch_episodes) if own else 0
    return watched.labels(args.nominal_episodes, learned, args.faults, faulty, calibration=own)


def recordings(args: Args, console: Console, seconds: dict[str, float]) -> tuple[list[Episode], Own]:
    """Lessons of babbling, and the episodes of each policy that is watched; recorded where they are not there yet."""
    folder, config = args.out.resolve(), RolloutConfig()
    with stage("babbling", console, seconds) as progress:
        wanted = curriculum(args.tasks, args.lessons, 0)
        make = partial(record_lesson, config=config, folder=folder)
        files = make_missing(make, wanted, lambda lesson: folder / lesson.path, args.workers, progress)
    jobs = [(watched, label) for watched in args.watched for label in labels(watched, args)]
    with stage("recording policies", console, seconds) as progress:
        watch = partial(record_watched, folder=folder)
        make_missing(watch, jobs, lambda j: folder / j[0].folder / j[1].path, args.workers, progress)
    own: dict[Watched, list[Episode]] = {watched: [] for watched in args.watched}
    for watched, label in jobs:
        own[watched].append(load_episode(folder / watched.folder / label.path))
    return [load_episode(file) for file in files], own


def of_its_own(
    bodies: Mapping[str, NeuralASM], own: Sequence[Episode], args: Args, seed: int
) -> Iterator[tuple[str, CalibratedMonitor]]:
    """Memories of one policy, by name: of a body, specialised on a few of its episodes, and from scratch on many.

    All are calibrated on the same few others.
    """
    few, few_others = (
        harmless([e for e in own if e.labelled.role == r and e.success][: args.own_episodes])
        for r in ("fit", "calibration")
    )
    rate = max(args.false_alarm_rate, 1.0 / (len(few_others) + 1))  # what so few can promise
    for name, body in bodies.items():
        yield f"{name}, specialised", copy.deepcopy(body).fit(few, warm_start=True).calibrate(few_others, rate)
    if args.scratch_episodes:
        scratch = fitted(args.out.resolve(), "neural_asm", harmless(role(own, "fit")), seed)
        yield "of its own policy, from scratch", scratch.calibrate(few_others, rate)


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Records, fits, judges."""
    args = args.scaled()
    babbled, own = recordings(args, console, seconds)
    known = tuple(w.task for w in args.watched if w.group == KNOWN)
    roles = {"fit": args.demonstrations, "calibration": args.calibration_episodes}
    shown = {r: demonstrations(args, known, r, n, console, seconds) for r, n in roles.items()}
    records: list[Record] = []
    senses: list[Record] = []
    with stage("fitting and judging", console, seconds) as progress:
        for n, seed in enumerate(args.repetitions):
            progress(n, args.seeds)
            found, cut = judged(args, Judge(args.window, own, seed), babbled, shown)
            records, senses = records + found, senses + cut
            progress(n + 1, args.seeds)
    return Findings([*records, *senses], tables(records, senses, args), drawn(records), {"lessons": len(babbled)})


def judged(
    args: Args, judge: Judge, babbled: Sequence[Episode], shown: Mapping[str, Sequence[Episode]]
) -> tuple[list[Record], list[Record]]:
    """What all memories and rivals make of everything, and the memory of the body of less."""

    def made(name: str, fit: Sequence[Episode], calibration: Sequence[Episode]) -> CalibratedMonitor:
        return fitted(args.out.resolve(), name, fit, judge.seed).calibrate(calibration, args.false_alarm_rate)

    everywhere, lessons = args.watched, healthy(babbled)
    records = judge.records("of one policy", made("neural_asm", **shown), everywhere)
    body = learn_body(lessons, args.false_alarm_rate, judge.seed, lambda done, total: None)
    records += judge.records("of the body", body, everywhere)
    shipped = NeuralASM.pretrained(SHIPPED)
    records += judge.records("of the body, as shipped", shipped, everywhere)
    records += judge.adaptive("of the body, adaptive", body)
    for watched in everywhere:
        if watched.policy in args.specialised:
            bodies = {"of the body": body, "of the body, as shipped": shipped}
            for name, memory in of_its_own(bodies, judge.own[watched], args, judge.seed):
                records += judge.records(name, memory, [watched])
    for task in args.without:
        others = healthy([e for e in babbled if e.labelled.task != task])
        less = learn_body(others, args.false_alarm_rate, judge.seed, lambda done, total: None)
        records += judge.records(f"of the body, without {task}", less, [w for w in everywhere if w.task == task])
    for rival in args.rivals:
        for name in (rival, rival + EVIDENCE):
            records += judge.records(name, made(name, *lessons), everywhere)
    return records, fewer_senses(body, judge)


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("transfer", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
