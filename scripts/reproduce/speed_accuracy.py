"""Speed and accuracy: more inference or slower movements give smaller errors.

Claim: a settling network knows the past by its state alone, which it must infer on every row, so that its errors fall
with the time of inference. Traces need one pass, and inference only for missing senses. Both learn the same letters.
With 1 to 100 steps of inference a row, as long as this package's or a twentieth as long, the study measures the pen's

    recalled     position after a cue, from memory alone
    next row     position in the next row, while it is seen

A second memory learns letters at several speeds, and is asked at each with the same inference a second.

Sources: Fitts 1954 (J. Exp. Psychol. 47(6)); Wickelgren 1977 (Acta Psychologica 41(1)); Schmidt et al. 1979
(Psychological Review 86(5)) for error that grows with speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.memory.dynamics import DYNAMICS
from asm_gym.memory.energy import iterations_within
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import ExpressionMemory, Rows
from asm_gym.scripts.reproduce.handwriting import DT, Letter, check_letters, copybook, repertoire, written
from asm_gym.scripts.reproduce.kit import Findings, Record, curves
from asm_gym.validation import check_number

CUE = 20

SHORTER = (20, 1)  # how many times shorter than this package's the steps of inference are
TESTS = 8  # writings of each letter to recall
MEASURES = {"recalled_cm": "recalled [cm]", "next_cm": "next row [cm]"}

_COUNT = partial(check_number, "iterations", low=1, whole=True)


@dataclass(frozen=True)
class Config(kit.Config):
    """Accuracy by inference and by speed."""

    iterations: tuple[int, ...] = option((1, 2, 3, 5, 8, 12, 20, 35, 60, 100), quick=(1, 3, 8, 20, 60), check=_COUNT)
    """Steps of inference."""
    speeds: tuple[float, ...] = option(
        (0.6, 0.8, 1.0, 1.25, 1.6, 2.0), quick=(0.8, 2.0), check=partial(check_number, "speed", low=0.2, high=4.0)
    )
    """Speeds of writing, as multiples of the usual one."""
    budgets: tuple[int, ...] = option((120, 6000), check=partial(iterations_within, dt=DT))
    """Short steps of inference a second, at every speed."""
    skills: int = option(4, quick=2, check=check_letters)
    """Letters."""
    hidden: int = option(64, quick=32, least=4)
    """Hidden units."""
    writings: int = option(12, quick=4, least=1)
    """Writings of each letter."""
    steps: int = option(16000, quick=1500, least=1)
    """Batches of 64 rows."""


def one_seed(seed: int, config: Config) -> list[Record]:
    """Measure both questions for both dynamics on one repertoire."""
    rng, records = np.random.default_rng(seed), []
    letters = repertoire(config.skills, rng)
    for name in DYNAMICS:
        own = by_iterations(letters, config, rng, name) + by_speed(letters, config, rng, name)
        records += [{"seed": seed, "dynamics": name, **r} for r in own]
    return records


def errors(memory: ExpressionMemory, rows: Rows, cue: int) -> Record:
    """Return the mean distances [cm] of the recalled and of the next position."""
    hand, online = memory.express(rows, cue)[cue:, :, :2], memory.express(rows, len(rows))[1:, :, :2]
    distances = (np.linalg.norm(h - rows[-len(h) :, :, :2], axis=2).mean() for h in (hand, online))
    return {name: float(d) for name, d in zip(MEASURES, distances, strict=True)}


def by_iterations(letters: Sequence[Letter], config: Config, rng: np.random.Generator, dynamics: str) -> list[Record]:
    """Measure errors by steps of inference and their length."""
    learned = copybook(letters, config.writings, rng)
    memory = ExpressionMemory.learned(learned, config.hidden, rng, config.steps, dynamics=dynamics)
    rows = np.stack([e.stream for e in copybook(letters, TESTS, rng)], axis=1).astype(np.float64)
    return [
        {"iterations": n, "shorter": shorter, **errors(memory.with_inference(n, shorter), rows, CUE)}
        for n, shorter in product(config.iterations, SHORTER)
    ]


def by_speed(letters: Sequence[Letter], config: Config, rng: np.random.Generator, dynamics: str) -> list[Record]:
    """Measure errors by speed of writing, with a cue of a third of the letter."""
    learned = copybook(letters, max(2, config.writings // 3), rng, config.speeds)
    memory = ExpressionMemory.learned(learned, config.hidden, rng, config.steps, dynamics=dynamics)
    records = []
    for speed in config.speeds:
        tests = [written(letter, rng, speed) for letter in letters for _ in range(TESTS)]
        rows = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
        for budget in config.budgets:
            asked = memory.with_inference(iterations_within(budget, DT), SHORTER[0])
            records.append({"speed": speed, "budget": budget, **errors(asked, rows, len(rows) // 3)})
    return records


def lines(name: str, values: Sequence[int], words: str) -> dict[str, Record]:
    """Return the rows of a table, or curves: both dynamics with each value of what ``name`` names."""
    return {f"{d}, {words.format(v)}": {"dynamics": d, name: v} for d, v in product(DYNAMICS, values)}


def run(config: Config) -> Findings:
    """Run every seed."""
    records = kit.together(kit.each("learning letters", partial(one_seed, config=config), config.repetitions, config))
    shorter = lines("shorter", SHORTER, "steps 1/{} as long")
    budgets = lines("budget", config.budgets, "{} short steps a second")
    counts, speeds = kit.by("iterations", config.iterations), kit.by("speed", config.speeds)
    tables: list[Table] = []
    for value, label in MEASURES.items():
        tables.append(kit.grid(f"{label} by steps of inference; cue of {CUE}", records, value, shorter, counts, 3))
        tables.append(kit.grid(f"{label} by speed", records, value, budgets, speeds, 3))
    with figure(height=3.2, width=10) as fig:
        axes = fig.subplots(1, 3)
        for ax, (value, label) in zip(axes, MEASURES.items(), strict=False):
            curves(ax, records, value, ("iterations", config.iterations), shorter)
            ax.set(xlabel="steps of inference", ylabel=label, xscale="log", ylim=0)
        curves(axes[2], records, "next_cm", ("speed", config.speeds), budgets)
        axes[2].set(xlabel="speed of writing", ylabel=MEASURES["next_cm"], ylim=0)
        for ax in axes[1:]:
            ax.legend(fontsize=7)
    return Findings(records, tables, fig)
