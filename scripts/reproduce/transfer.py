"""One memory of a body under policies and in tasks that it never met: false alarms, faults found, and its rivals.

The memory of the body learns from motor babbling (``asm-gym babble``), and so do all rivals. It is compared with a
memory of one policy, the experts'; with itself after a few episodes of the policy that it watches; with a running
threshold; and without senses that a stream may lack. Nobody has met the agents, the speeds, the noise and the tasks.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation import defaults
from asm_gym.faults.suite import TEST, kinds_of
from asm_gym.monitors import EVIDENCE, CalibratedMonitor, NeuralASM
from asm_gym.monitors.registry import check_monitor
from asm_gym.rollouts.pretraining.babbling import curriculum, record_lesson
from asm_gym.rollouts.pretraining.healthy import Lessons, harmless, healthy, held_out, learn_body
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.scoring import fitted
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import demonstrations
from asm_gym.scripts.reproduce.transfer_judge import Judge, Own, fewer_senses, role
from asm_gym.scripts.reproduce.transfer_report import drawn, tables
from asm_gym.scripts.reproduce.transfer_watched import KNOWN, POLICIES, WATCHED, Watched, record_watched
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

SHIPPED = "panda"
"""The memory of this body that comes with the package, at the rate that it was shipped with."""


@dataclass(frozen=True)
class Config(kit.Config):
    """A memory of a body, under policies and in tasks that it never met."""

    seeds: int = option(1, least=1)
    """How often every memory and rival is fitted anew; what is recorded is the same for all."""
    out: Path = option(Path("runs/transfer"), metavar="FOLDER")
    """Folder of the study."""
    demonstrations: int = option(20, quick=4, least=1)
    """Episodes of each expert for the memory of one policy."""
    calibration_episodes: int = option(20, quick=5, least=1)
    """As many others to set its threshold on."""
    nominal_episodes: int = option(12, quick=2, least=1)
    """Healthy episodes of each policy that is watched."""
    specialised: tuple[str, ...] = option(("lift_sac", "stack_sac"), quick=("lift_sac",))
    """Policies to specialise on."""
    scratch_episodes: int = option(0, least=0)
    """Episodes of such a policy for a memory that learns of it alone, from scratch, to compare with; 0 for none."""
    agents: tuple[tuple[str, str], ...] = option(())
    """Further agents to watch: a task and the file of an agent for each, such as Lift runs/train/clone.npz."""
    tasks: tuple[str, ...] = fixed(
        ("Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "PickPlaceBread", "PickPlaceCereal"),
        quick=("Lift", "Stack", "Door"),
        check=task_spec,
    )
    """Tasks to babble in; among them those of the memory of one policy."""
    lessons: int = fixed(24, quick=12)
    """Lessons of babbling in each task; a third of them to calibrate on."""
    own_episodes: int = fixed(20, quick=4)
    """Episodes of a policy to specialise on, and as many to calibrate on."""
    broken: tuple[str, ...] = fixed(("lift_sac", "stack_sac", "door_sac"), quick=("lift_sac",))
    """Policies under which there are faults."""
    faults: tuple[str, ...] = fixed((TEST,), quick=("push", "frozen_encoder"))
    """Kinds of fault; development and test stand for halves of the suite."""
    faulty_episodes: int = fixed(1, least=0)
    """Faulty episodes of each policy, kind and severity."""
    without: tuple[str, ...] = fixed(("Door",), quick=(), check=task_spec)
    """Tasks that are left out of babbling, one at a time, for a memory that has not met their expert either."""
    rivals: tuple[str, ...] = fixed(
        ("gru", "lstm_vae", "logpzo", "kalman", "association_linear"), quick=("kalman",), check=check_monitor
    )
    """Monitors by the same protocol, each with its authors' detection and with ours."""
    false_alarm_rate: float = fixed(defaults.FALSE_ALARM_RATE, quick=0.2, check=conformal_episodes)
    """Share of healthy episodes that may raise an alarm."""
    window: float = fixed(defaults.WINDOW_S)
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.without:
            check_choice("task to leave out", name, self.tasks)
        for name, _ in self.agents:
            task_spec(name)
        kinds_of(self.faults)
        needed = conformal_episodes(self.false_alarm_rate)
        calm = sum(map(held_out, range(self.lessons)))  # lessons to calibrate on
        given = (len(self.tasks) - bool(self.without)) * calm, 3 * self.calibration_episodes
        if min(given) < needed:
            raise ValueError(
                f"a rate of {self.false_alarm_rate:g} needs {needed} episodes to calibrate on, got {given}"
            )

    @property
    def watched(self) -> tuple[Watched, ...]:
        given = tuple(Watched(task, str(Path(file).resolve()), group=POLICIES) for task, file in self.agents)
        return ((WATCHED[0], WATCHED[3]) if self.quick else WATCHED) + given


def labels(watched: Watched, config: Config) -> list[EpisodeLabel]:
    """What is recorded of it."""
    own = config.own_episodes if watched.policy in config.specialised else 0
    faulty = config.faulty_episodes if watched.policy in config.broken else 0
    learned = max(own, config.scratch_episodes) if own else 0
    return watched.labels(config.nominal_episodes, learned, config.faults, faulty, calibration=own)


def recordings(config: Config) -> tuple[list[Episode], Own]:
    """Lessons of babbling, and the episodes of each policy that is watched; recorded where they are not there yet."""
    folder = config.out.resolve()
    with kit.stage("babbling") as progress:
        wanted = curriculum(config.tasks, config.lessons, 0)
        make = partial(record_lesson, config=RolloutConfig(), folder=folder)
        files = make_missing(make, wanted, lambda lesson: folder / lesson.path, config.workers, progress)
    jobs = [(watched, label) for watched in config.watched for label in labels(watched, config)]
    with kit.stage("recording policies") as progress:
        watch = partial(record_watched, folder=folder)
        make_missing(watch, jobs, lambda j: folder / j[0].folder / j[1].path, config.workers, progress)
    own: dict[Watched, list[Episode]] = {watched: [] for watched in config.watched}
    for watched, label in jobs:
        own[watched].append(load_episode(folder / watched.folder / label.path))
    return [load_episode(file) for file in files], own


def of_its_own(
    bodies: Mapping[str, NeuralASM], own: Sequence[Episode], config: Config, seed: int
) -> Iterator[tuple[str, CalibratedMonitor]]:
    """Memories of one policy, by name: of a body, specialised on a few of its episodes, and from scratch on many.

    All are calibrated on the same few others.
    """
    few, few_others = (
        harmless([e for e in own if e.labelled.role == r and e.success][: config.own_episodes])
        for r in ("fit", "calibration")
    )
    rate = max(config.false_alarm_rate, 1.0 / (len(few_others) + 1))  # what so few can promise
    for name, body in bodies.items():
        yield f"{name}, specialised", copy.deepcopy(body).fit(few, warm_start=True).calibrate(few_others, rate)
    if config.scratch_episodes:
        scratch = fitted(config.out.resolve(), "neural_asm", harmless(role(own, "fit")), seed)
        yield "of its own policy, from scratch", scratch.calibrate(few_others, rate)


def run(config: Config) -> Findings:
    """Records, fits, judges."""
    babbled, own = recordings(config)
    known = tuple(w.task for w in config.watched if w.group == KNOWN)
    roles = {"fit": config.demonstrations, "calibration": config.calibration_episodes}
    shown = {r: demonstrations(config, known, r, n) for r, n in roles.items()}
    records: list[Record] = []
    senses: list[Record] = []
    with kit.stage("fitting and judging") as progress:
        for n, seed in enumerate(config.repetitions):
            progress(n, config.seeds)
            found, cut = judged(config, Judge(config.window, own, seed), babbled, shown)
            records, senses = records + found, senses + cut
            progress(n + 1, config.seeds)
    return Findings([*records, *senses], tables(records, senses, config), drawn(records), {"lessons": len(babbled)})


def judged(
    config: Config, judge: Judge, babbled: Sequence[Episode], shown: Mapping[str, Sequence[Episode]]
) -> tuple[list[Record], list[Record]]:
    """What all memories and rivals make of everything, and the memory of the body of less."""

    def made(name: str, fit: Sequence[Episode], calibration: Sequence[Episode]) -> CalibratedMonitor:
        return fitted(config.out.resolve(), name, fit, judge.seed).calibrate(calibration, config.false_alarm_rate)

    def learned(lessons: Lessons) -> NeuralASM:
        body = learn_body(lessons, lessons.fit[0].spec, judge.seed, lambda done, total: None)
        return body.calibrate(lessons.calibration, config.false_alarm_rate)

    everywhere, lessons = config.watched, healthy(babbled)
    records = judge.records("of one policy", made("neural_asm", **shown), everywhere)
    body = learned(lessons)
    records += judge.records("of the body", body, everywhere)
    shipped = NeuralASM.pretrained(SHIPPED)
    records += judge.records("of the body, as shipped", shipped, everywhere)
    records += judge.adaptive("of the body, adaptive", body)
    for watched in everywhere:
        if watched.policy in config.specialised:
            bodies = {"of the body": body, "of the body, as shipped": shipped}
            for name, memory in of_its_own(bodies, judge.own[watched], config, judge.seed):
                records += judge.records(name, memory, [watched])
    for task in config.without:
        less = learned(healthy([e for e in babbled if e.labelled.task != task]))
        records += judge.records(f"of the body, without {task}", less, [w for w in everywhere if w.task == task])
    for rival in config.rivals:
        for name in (rival, rival + EVIDENCE):
            records += judge.records(name, made(name, lessons.fit, lessons.calibration), everywhere)
    return records, fewer_senses(body, judge)
