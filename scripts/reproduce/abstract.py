"""The experiment of the abstract: one network, six skills, no label, by traces and by settling.

Claim: one network learns a repertoire by local rules, expresses and recognises each skill from context, is surprised by
faults, and reacts to them by the same energy. An arm of two links writes letters (``two_links``). A memory learns them
without their names, and after a cue of one of them writes on by its own motor prediction:

    left alone   how far the hand is from the letter, and whether that letter is the nearest
    pushed       the joints are displaced: is it surprised, and does it go on better by lowest F
    stuck        an encoder sticks: is it surprised, at which sense, and does it go on without it
    named        does the state tell the letter; only the readout is given the names

A GRU with about as many weights, trained through time on the same writings, stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from asm_gym.data.episode import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.skills import name_skills
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import (
    FREE,
    Backpropagated,
    Expresser,
    ExpressionMemory,
    mean_demonstrations,
    reached,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, shown
from asm_gym.scripts.reproduce.two_links import (
    CUE,
    DT,
    EVENT,
    HAND,
    JUDGED,
    SPEC,
    WAYS,
    WINDOW,
    Course,
    Floats,
    MemoryDriver,
    RecurrentDriver,
    closed_loop,
    demonstrations,
)

TITLES = {"traces": "traces", "settling": "settling", "gru": "GRU, BPTT"}
UNITS = {"traces": 144, "settling": 112}
GRU: dict[str, Any] = {"hidden": 64, "rate": 3e-2}
"""All have about as many weights through time, chosen on seeds 100 to 104."""
RATE = 0.05  # false alarms asked for
EVENTS = ("pushed", "stuck")
AROUND = slice(EVENT, EVENT + WINDOW)


@dataclass(frozen=True)
class Config(kit.Config):
    """One network, six skills."""

    skills: int = option(6, quick=2, check=partial(check_letters, low=2))
    """Letters."""
    writings: int = option(20, quick=6, least=2)
    """Writings of each letter to learn from."""
    tests: int = option(3, quick=1, least=1)
    """Times that each letter is to be expressed."""
    epochs: int = option(70, quick=10, least=1)
    """Passes over the writings."""
    updates: int = option(600, quick=20, least=1)
    """Batches of the GRU."""
    calibration: int = option(16, quick=12, least=1)
    """Writings of each letter that set the threshold."""


class Lessons(NamedTuple):
    """The letters of one seed."""

    train: list[Episode]
    calibration: list[Episode]
    tests: list[Episode]
    means: Floats  # (K, T, 2) the mean path of each letter


def lessons(seed: int, config: Config) -> Lessons:
    """Draw the letters of a seed."""
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, rng)
    train, calibration, tests = (
        demonstrations(letters, n, rng) for n in (config.writings, config.calibration, config.tests)
    )
    return Lessons(train, calibration, tests, mean_demonstrations(train, HAND))


def written(course: Course, given: Lessons) -> Record:
    """Return the distance from the letter [cm], whole and once there was time to react, and the share of right ones."""
    cm, right = reached(course.path, given.tests, given.means, CUE, HAND)
    late, _ = reached(course.path, given.tests, given.means, EVENT + WINDOW // 2, HAND)
    return {"cm": cm, "late_cm": late, "right": right}


def noticed(courses: Mapping[str, Course], threshold: float) -> Record:
    """Return what surprise and F tell of both events, against the same rows left alone."""
    found: Record = {}
    nominal = courses["left alone"]
    for event in EVENTS:
        for what in ("surprise", "energy"):
            good, bad = (getattr(c, what)[AROUND].max(axis=0) for c in (nominal, courses[event]))
            found[f"{event}, {what}"] = auroc(bad, good)
        found[f"{event}, found"] = float((courses[event].surprise[AROUND] > threshold).any(axis=0).mean())
    late = courses["stuck"]
    named = [name for name, t in zip(late.attributed, late.alarm, strict=True) if t < len(late.path)]
    found["attributed"] = float(np.mean([name == "encoder" for name in named])) if named else None
    found["alarms"] = float((nominal.surprise > threshold).any(axis=0).mean())
    return found


def one(job: tuple[str, int], config: Config) -> tuple[list[Record], dict[str, Course]]:
    """Measure a memory of one dynamics, or a GRU, with one seed."""
    name, seed = job
    given = lessons(seed, config)
    cues = np.stack([e.stream for e in given.tests], axis=1).astype(np.float64)
    made: list[Record] = []

    def note(measure: str, **values: Any) -> None:
        made.append({"model": name, "seed": seed, "measure": measure, **values})

    def express(model: Expresser) -> None:
        for measure, cue in (("next row", STEPS), ("recalled", CUE)):
            note(measure, cm=recalled(model, given.tests, given.means, cue, HAND)[0])

    if name == "gru":
        gru = Backpropagated.learned(given.train, rng=np.random.default_rng(seed), updates=config.updates, **GRU)
        with torch.no_grad():
            course = closed_loop(RecurrentDriver(gru, cues.shape[1]), cues, WAYS[0], seed)
        express(gru)
        note(WAYS[0], **written(course, given))
        return made, {WAYS[0]: course}
    sizes: dict[str, Any] = {"hidden_size": UNITS[name], "association_size": 64}
    asm = NeuralASM(SPEC, dynamics=name, seed=seed, epochs=config.epochs, free_running_probability=FREE, **sizes)
    asm = asm.fit(given.train).calibrate(given.calibration, RATE)
    express(ExpressionMemory(asm.senses_, asm.model.network))
    energy = asm.model.free_energy(given.calibration[::4])
    courses = {}
    for way in WAYS:
        driver = MemoryDriver(asm, cues.shape[1])
        courses[way] = closed_loop(driver, cues, way, seed, energy, asm.threshold)
        note(way, **written(courses[way], given))
    note("surprise", **noticed(courses, asm.threshold))
    name_skills(asm, given.train)
    named = [asm.score(e).skill for e in given.tests]
    for row in (CUE, EVENT, STEPS - 1):
        right = [said is not None and said[row] == e.info["skill"] for said, e in zip(named, given.tests, strict=True)]
        note("named", row=row, right=float(np.mean(right)))
    return made, courses


def tables(records: Sequence[Record], skills: int) -> list[Table]:
    """Return what was expressed, noticed and named, and the difference from the GRU."""

    def rows(value: str, labels: Mapping[str, Record], models: Sequence[str]) -> list[tuple[str, ...]]:
        return [(label, *(shown(records, value, model=m, **own) for m in models)) for label, own in labels.items()]

    every, memories, head = tuple(TITLES), tuple(UNITS), ("", *TITLES.values())
    by_way = {f"written, {way}": {"measure": way} for way in WAYS}
    known = {m: {"measure": m} for m in ("next row", "recalled")}
    late = {f"{way}, from half a second after the event": {"measure": way} for way in WAYS}
    expressed = [*rows("cm", known | by_way, every), *rows("late_cm", late, every)]
    right = rows("right", by_way, every)
    names = {r: {"measure": "named", "row": r} for r in (CUE, EVENT, STEPS - 1)}
    named = rows("right", {f"after {r + 1} rows": own for r, own in names.items()}, memories)
    words = {"surprise": "AUROC of surprise", "energy": "AUROC of F", "found": "found within a second"}
    keys = {f"{event}, {what}": f"{event}, {label}" for event in EVENTS for what, label in words.items()}
    keys |= {"attributed": "stuck: the encoders have the largest share", "alarms": "left alone: letters with an alarm"}
    noticed = [row for key, label in keys.items() for row in rows(key, {label: {"measure": "surprise"}}, memories)]
    asked = f"{skills} letters, cue of {CUE} rows; mean ± SD over seeds"
    return [
        Table(f"Expected, and written in closed loop, off by [cm]: {asked}", head, expressed),
        Table("Share of right letters", head, right),
        behind(records),
        Table("What is noticed", head[:3], noticed),
        Table("Share of letters that the state names rightly", head[:3], named),
    ]


def behind(records: Sequence[Record]) -> Table:
    """Return how much further off each dynamics is than the GRU, over the same repertoires."""

    def cell(model: str, measure: str) -> str:
        found = kit.paired(records, "cm", {"model": model}, {"model": "gru"}, measure=measure)
        verdict = "ahead" if found.high < 0 else "behind" if found.low > 0 else "within chance"
        return f"{found.value:+.2f} ({found.low:+.2f} to {found.high:+.2f}), {verdict}"

    lines = [(f"{m} [cm]", *(cell(name, m) for name in UNITS)) for m in ("next row", "recalled", WAYS[0])]
    count = len({r["seed"] for r in records})
    caption = f"Further off than the GRU, in the same {count} repertoires; 95 % intervals of the paired difference"
    return Table(caption, ("", *(TITLES[name] for name in UNITS)), lines)


def drawn(courses: Mapping[str, Mapping[str, Course]], truth: Floats) -> Figure:
    """Draw a letter (T, 2) by each dynamics: the hand, surprise and F."""
    with figure(height=5.6, width=11) as fig:
        for axes, name in zip(fig.subplots(len(UNITS), 4, squeeze=False), UNITS, strict=True):
            own = courses[name]
            for ax, ways in zip(axes[:2], (WAYS[:3], (WAYS[0], *WAYS[3:])), strict=True):
                ax.plot(*truth.T, color="#cccccc", linewidth=4, label="demonstrated")
                for way in ways:
                    colour, line, _ = look(WAYS.index(way))
                    ax.plot(*own[way].path[CUE:, 0].T, color=colour, linestyle=line, label=way)
                ax.plot(*own[WAYS[0]].path[EVENT, 0], "k.", markersize=6, label="the event")
                ax.set(title=name, xlabel="x [cm]", ylabel="y [cm]", aspect="equal", adjustable="datalim")
                ax.legend(fontsize=6)
            for ax, value, label in zip(axes[2:], ("surprise", "energy"), ("surprise", "F [nats]"), strict=True):
                for way in JUDGED:
                    colour, line, _ = look(WAYS.index(way))
                    ax.plot(DT * np.arange(STEPS), getattr(own[way], value)[:, 0], color=colour, linestyle=line)
                ax.set(title=name, xlabel="time [s]", ylabel=label, yscale="symlog")
            axes[2].axhline(own[WAYS[0]].threshold, color="#888888", linewidth=1)
    return fig


def run(config: Config) -> Findings:
    """Run both dynamics and the GRU for every seed."""
    jobs = [(m, s) for s in config.repetitions for m in TITLES]
    found = kit.each("learning and writing", partial(one, config=config), jobs, config)
    records = kit.together([own for own, _ in found])
    first = {name: courses for (name, seed), (_, courses) in zip(jobs, found, strict=True) if seed == config.seed}
    letter = lessons(config.seed, config).tests[0].stream[:, HAND].astype(np.float64)
    return Findings(records, tables(records, config.skills), drawn(first, letter))
