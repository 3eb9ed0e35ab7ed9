"""The experiment of the abstract in one run: one network, six skills, no label, by traces and by settling.

An arm of two links writes letters (``two_links``). A memory learns them by local rules and is told none of their names.
Then it writes by its own motor prediction, in closed loop, after a cue of rows that belong to one of them:

    expressed    how far the hand is from the letter, and whether that letter is the nearest
    named        whether the memory's state says which one it is; a readout is told the names, the memory is not
    pushed       the joints are displaced while it writes: is it surprised, and does it go on better by lowest F
    stuck        an encoder says the same from then on: is it surprised, at which sense, and does it go on without it
    hurried      the same with one short step of inference a row

A GRU trained through time on the same writings, with about as many weights, stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import auroc
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.abstract_film import SHOWN, filmed
from asm_gym.scripts.reproduce.abstract_report import TITLES, drawn, tables
from asm_gym.scripts.reproduce.closed_loop import (
    CUE,
    EVENT,
    RATE,
    WAYS,
    WINDOW,
    Course,
    Memorised,
    Recurring,
    written,
)
from asm_gym.scripts.reproduce.expression import FREE, Backpropagated, ExpressionMemory
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.speed_accuracy import SHORTER, asked
from asm_gym.scripts.reproduce.two_links import DT, HAND, SPEC, Floats, demonstrations

SETTINGS: dict[str, dict[str, Any]] = {
    "traces": {"hidden_size": 144},
    "settling": {"hidden_size": 112},
}
GRU: dict[str, Any] = {"hidden": 64, "rate": 3e-2}
"""All have about as many weights through time, chosen on seeds 100 to 104."""


@dataclass(frozen=True)
class Config(kit.Config):
    """One network, six skills."""

    skills: int = option(6, quick=2, check=partial(check_letters, least=2))
    """Letters."""
    writings: int = option(20, quick=6, least=2)
    """How often each letter is written to learn from."""
    tests: int = option(3, quick=1, least=1)
    """How often each letter is to be expressed."""
    epochs: int = option(70, quick=10, least=1)
    """Passes over them."""
    updates: int = option(600, quick=20, least=1)
    """How often the GRU learns from a batch."""
    calibration: int = fixed(16, quick=12, least=1)
    """Writings of each letter that set the threshold."""


class Learned(NamedTuple):
    """What learned the letters of one seed, and what is asked of it."""

    train: list[Episode]
    calibration: list[Episode]
    tests: list[Episode]
    means: Floats  # (K, T, 2) the mean demonstration of each letter


def lessons(seed: int, config: Config) -> Learned:
    """The letters of a seed."""
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, 2, rng)
    train, calibration, tests = (
        demonstrations(letters, n, rng) for n in (config.writings, config.calibration, config.tests)
    )
    names = [letter.name for letter in letters]
    means = np.stack([np.mean([e.stream[:, HAND] for e in train if e.info["skill"] == k], axis=0) for k in names])
    return Learned(train, calibration, tests, means)


def ended(course: Course, told: Learned, since: int = CUE) -> Record:
    """How far the hand was from the letter [cm], and whether no other was nearer."""
    truth = np.stack([e.stream[:, HAND] for e in told.tests], axis=1)
    apart = np.linalg.norm(course.path[since:] - truth[since:], axis=2).mean()
    to_each = np.linalg.norm(course.path[CUE:, :, None] - told.means[:, CUE:].transpose(1, 0, 2)[:, None], axis=3)
    names = sorted({str(e.info["skill"]) for e in told.tests})
    right = [names[k] == e.info["skill"] for k, e in zip(to_each.mean(axis=0).argmin(axis=1), told.tests, strict=True)]
    return {"cm": float(apart), "right": float(np.mean(right))}


def online(model: Any, told: Learned, cue: int) -> Record:
    """Where the hand is expected: in the next row, or after a cue from memory alone [cm]."""
    rows = np.stack([e.stream for e in told.tests], axis=1).astype(np.float64)
    first = cue if cue < STEPS else 1
    found = model.express(rows, cue)[first:, :, HAND] - rows[first:, :, HAND]
    return {"cm": float(np.linalg.norm(found, axis=2).mean())}


def one(job: tuple[str, int], config: Config) -> tuple[list[Record], dict[str, Course]]:
    """A memory of one dynamics, or a GRU, with one seed."""
    name, seed = job
    told = lessons(seed, config)
    cues = np.stack([e.stream for e in told.tests], axis=1).astype(np.float64)
    B, made = cues.shape[1], []

    def note(measure: str, **values: Any) -> None:
        made.append({"model": name, "seed": seed, "measure": measure, **values})

    if name not in SETTINGS:
        gru = Backpropagated.learned(told.train, "gru", rng=np.random.default_rng(seed), updates=config.updates, **GRU)
        with torch.no_grad():
            course = written(Recurring(gru, B), cues, "left alone", seed)
        note("next row", **online(gru, told, STEPS))
        note("recalled", **online(gru, told, CUE))
        note("left alone", **ended(course, told))
        return made, {"left alone": course}
    how = {"association_size": 64, "epochs": config.epochs, "free_running_probability": FREE, **SETTINGS[name]}
    asm = NeuralASM(SPEC, dynamics=name, seed=seed, **how).fit(told.train).calibrate(told.calibration, RATE)
    memory, energy = ExpressionMemory(asm.senses_, asm.model.network), asm.model.free_energy(told.calibration[::4])
    for measure, cue in (("next row", STEPS), ("recalled", CUE)):
        note(measure, **online(memory, told, cue))
    short = asked(memory, 1, SHORTER[0])
    note("next row, hurried", **online(short, told, STEPS))
    courses = {}
    for way in WAYS:
        drives = Memorised(asm, B)
        if way == "hurried":
            drives.asm = asm.with_budget(1 / DT)
            drives.asm.model.network_ = short.network
        course = courses[way] = written(drives, cues, way, seed, energy, asm.threshold)
        note(way, **ended(course, told), **ended_late(course, told))
    note("surprise", **noticed(courses, asm.threshold))
    named = asm.name_skills(told.train)
    for row in (CUE, EVENT, STEPS - 1):
        right = [named.skills(e.stream[: row + 1])[-1] == e.info["skill"] for e in told.tests]
        note("named", row=row, right=float(np.mean(right)))
    for way in SHOWN:
        courses[way].named = [str(name) for name in named.skills(courses[way].rows[:, 0])]
    return made, courses


def ended_late(course: Course, told: Learned) -> Record:
    """How far the hand was from the letter once there was time to react [cm]."""
    return {"late_cm": ended(course, told, EVENT + WINDOW // 2)["cm"]}


def noticed(courses: dict[str, Course], threshold: float) -> Record:
    """What surprise and F tell of both events, against the same rows left alone; alarms within the window."""
    found: Record = {}
    within = slice(EVENT, EVENT + WINDOW)
    calm = courses["left alone"]
    for event in ("pushed", "stuck"):
        for what in ("surprise", "energy"):
            good, bad = (getattr(c, what)[within].max(axis=0) for c in (calm, courses[event]))
            found[f"{event}, {what}"] = auroc(bad, good)
        found[f"{event}, found"] = float((courses[event].surprise[within] > threshold).any(axis=0).mean())
    late = courses["stuck"]
    told = [name for name, t in zip(late.blamed, late.alarm, strict=True) if t < len(late.path)]
    found["blamed"] = float(np.mean([name == "encoder" for name in told])) if told else None
    found["alarms"] = float((calm.surprise > threshold).any(axis=0).mean())
    return found


def run(config: Config) -> Findings:
    """Both dynamics and the GRU, for every seed."""
    jobs = [(m, s) for s in config.repetitions for m in TITLES]
    found = kit.each("learning and writing", partial(one, config=config), jobs, config)
    records = kit.together([own for own, _ in found])
    first = {name: courses for (name, seed), (_, courses) in zip(jobs, found, strict=True) if seed == config.seed}
    letter = lessons(config.seed, config).tests[0].stream[:, HAND].astype(np.float64)
    return Findings(records, tables(records, config.skills), drawn(first, letter), film=filmed(first, letter))
