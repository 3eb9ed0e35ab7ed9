"""One memory of a body under policies and in tasks that it never met: false alarms, faults found, and its rivals.

The memory of the body learns from motor babbling (``asm-gym babble``), and so do all rivals. It is compared with a
memory of one policy, the experts'; with itself after a few episodes of the policy that it watches; with a running
threshold; and without senses that a stream may lack. Nobody has met the agents, the speeds, the noise and the tasks.
"""

from __future__ import annotations

import copy
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from asm_gym.choices import check_choice
from asm_gym.detection import AdaptiveThreshold, conformal_episodes
from asm_gym.episodes import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.comparison import visible_kinds
from asm_gym.evaluation.metrics import placements
from asm_gym.evaluation.trace import NOMINAL, Trace
from asm_gym.faults.suite import kinds_of
from asm_gym.monitors import EVIDENCE, MONITORS, CalibratedMonitor, NeuralASM
from asm_gym.rollouts.babbling import curriculum, record_lesson
from asm_gym.rollouts.benchmark import detectability_of, fitted, traces_of
from asm_gym.rollouts.body import CALIBRATED_ON, healthy
from asm_gym.rollouts.folder import make_missing
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.reproduce import adoption
from asm_gym.scripts.reproduce.common import Common, Findings, Record, at_least, at_least_one, demonstrations, reproduce
from asm_gym.scripts.reproduce.transfer_report import drawn, tables
from asm_gym.scripts.reproduce.transfer_watched import KNOWN, WATCHED, Watched, record_watched
from asm_gym.stream import StreamSpec
from asm_gym.tasks import task as task_spec

Own = Mapping[Watched, Sequence[Episode]]
ADAPTIVE = AdaptiveThreshold(rate=0.03, step=0.3, ceiling=4.0)
LACKING: Mapping[str, tuple[str, ...]] = {
    "nothing": (),
    "the gripper": ("gripper",),
    "the commands": ("action",),
    "gripper and commands": ("gripper", "action"),
    "the wrist": ("wrench",),
    "external torques": ("external_torque", "external_torque_peak"),
    "all torques": ("torque",),
    "the hand": ("hand",),
    "all but joints and commands": ("torque", "hand", "wrench", "gripper"),
    "all but joints": ("torque", "hand", "wrench", "gripper", "action"),
}
"""What a stream may lack: groups of channels, or channels."""


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
    false_alarm_rate: float = 0.03
    """Share of healthy episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.tasks, *self.without):
            task_spec(name)
        for name in self.without:
            check_choice("task to leave out", name, self.tasks)
        for name in self.rivals:
            check_choice("monitor", name, MONITORS)
        kinds_of(self.faults)
        at_least_one("nominal_episodes", self.nominal_episodes)
        at_least(0, "faulty_episodes", self.faulty_episodes)
        needed = conformal_episodes(self.false_alarm_rate)
        given = (len(self.tasks) - bool(self.without)) * (self.lessons // CALIBRATED_ON), 3 * self.calibration_episodes
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
            lessons=9,
            demonstrations=4,
            calibration_episodes=3,
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
        return (WATCHED[0], WATCHED[3]) if self.quick else WATCHED


def labels(watched: Watched, args: Args) -> list[EpisodeLabel]:
    """What is recorded of it."""
    own = args.own_episodes if watched.policy in args.specialised else 0
    faulty = args.faulty_episodes if watched.policy in args.broken else 0
    return watched.labels(args.nominal_episodes, own, args.faults, faulty)


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


def role(episodes: Sequence[Episode], name: str) -> list[Episode]:
    """Those of a role, and of the nominal roles to learn from only those that succeeded."""
    mine = [e for e in episodes if e.labelled.role == name]
    return [e for e in mine if e.success] if name in ("fit", "calibration") else mine


class Judge(NamedTuple):
    """How one memory's traces become records.

    Attributes:
        own: episodes of each policy that is watched.
        seed: of the fit.
    """

    args: Args
    own: Own
    seed: int

    def records(self, memory: str, monitor: CalibratedMonitor, of: Sequence[Watched]) -> list[Record]:
        """What it makes of all episodes of these policies."""
        found: list[Record] = []
        for watched in of:
            tested = [e for e in self.own[watched] if e.labelled.role in ("nominal", "faulty")]
            found += self._of(memory, watched, traces_of(memory, monitor, tested, monitor.threshold))
        return found

    def adaptive(self, memory: str, monitor: CalibratedMonitor) -> list[Record]:
        """Likewise with a running threshold, one policy after another; faults by what it came to."""
        running, found = ADAPTIVE.start(monitor.threshold), []
        for watched in self.args.watched:
            traces = traces_of(memory, monitor, role(self.own[watched], "nominal"), running.value)
            judged = []
            for trace in traces:
                judged.append(trace.at(running.value))
                running.follow(float(trace.surprise.max()))
            faulty = traces_of(memory, monitor, role(self.own[watched], "faulty"), running.value)
            found += self._of(memory, watched, [*judged, *faulty])
        return found

    def _of(self, memory: str, watched: Watched, traces: Sequence[Trace]) -> list[Record]:
        nominal = [t for t in traces if t.kind == NOMINAL]
        seen = visible_kinds(
            detectability_of(role(self.own[watched], "nominal"), role(self.own[watched], "faulty"), self.args.window)
        )
        where = {"memory": memory, "fit": self.seed, "watched": watched.name, "group": watched.group}
        records: list[Record] = [
            {
                **where,
                "seed": t.seed,
                "solved": t.outcome.success,
                "alarms": len(t.false_alarms),
                "hours": len(t) * t.dt / 3600,
                "threshold": t.threshold,
            }
            for t in nominal
        ]
        steps = round(self.args.window / nominal[0].dt)
        for t in traces:
            if t.onset is not None and seen[t.kind, t.severity]:
                placed = placements([t], nominal, self.args.window)
                late = t.detected_after
                records.append(
                    {
                        **where,
                        "seed": t.seed,
                        "kind": t.kind,
                        "severity": t.severity,
                        "found": late is not None and late < steps,
                        "auroc": float(1.0 - placed[0]) if placed.size else None,
                    }
                )
        return records


def fewer_senses(memory: NeuralASM, judge: Judge) -> list[Record]:
    """What is left of the memory of the body without some senses, at the threshold it had with all of them."""
    found: list[Record] = []
    for lacking, gone in LACKING.items():
        channels = tuple(c for c in memory.spec.channels if not {c.name, c.group} & set(gone))
        spec = StreamSpec(channels, memory.spec.dt, memory.spec.source)
        lost = {label for c in memory.spec.channels if c not in channels for label in c.labels}
        kept = {watched: [_cut(e, spec) for e in own if _shows(e, lost)] for watched, own in judge.own.items()}
        found += judge._replace(own=kept).records(f"without {lacking}", memory.for_stream(spec), judge.args.watched)
    return found


def _cut(episode: Episode, spec: StreamSpec) -> Episode:
    """The episode as a stream of ``spec`` has it."""
    return replace(episode, stream=np.ascontiguousarray(episode.stream[:, spec.columns_in(episode.spec)]), spec=spec)


def _shows(episode: Episode, lost: set[str]) -> bool:
    """Whether there may be more to see of its fault than in what is lost."""
    affected = episode.labelled.affected_channels
    return not affected or not affected <= lost


def recalibrated(body: NeuralASM, own: Sequence[Episode], rate: float) -> NeuralASM:
    """The memory of the body with a threshold from a few episodes of one policy."""
    few = role(own, "calibration")
    least = 1.0 / (len(few) + 1)  # what so few can promise
    return copy.deepcopy(body).calibrate(few, max(rate, least))


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
            found, cut = judged(args, Judge(args, own, seed), babbled, shown)
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
    body = made("neural_asm", *lessons)
    assert isinstance(body, NeuralASM)
    records += judge.records("of the body", body, everywhere)
    records += judge.adaptive("of the body, adaptive", body)
    for watched in everywhere:
        if watched.policy in args.specialised:
            own = recalibrated(body, judge.own[watched], args.false_alarm_rate)
            records += judge.records("of the body, re-calibrated", own, [watched])
    for task in args.without:
        less = made("neural_asm", *healthy([e for e in babbled if e.labelled.task != task]))
        records += judge.records(f"of the body, without {task}", less, [w for w in everywhere if w.task == task])
    for rival in args.rivals:
        for name in (rival, rival + EVIDENCE):
            records += judge.records(name, made(name, *lessons), everywhere)
    return records, fewer_senses(body, judge)


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code; with two folders it is ``adoption``, as it was before."""
    given = sys.argv[1:] if argv is None else argv
    if given and not given[0].startswith("-"):
        warnings.warn("reproduce transfer KNOWN WATCHED is now reproduce adoption", DeprecationWarning, stacklevel=2)
        return adoption.main(given)
    return reproduce("transfer", study, Args, __doc__, given)


if __name__ == "__main__":
    sys.exit(main())
