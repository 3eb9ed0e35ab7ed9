"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Claim: local rules recall letters about as well as networks trained by backpropagation through time. Compared are the
temporal predictive coding network by traces, with as many units as its rivals and with four times as many; the settling
network and an LSTM with as many weights as a GRU; the GRU; and a modern Hopfield network, which keeps every window.
Online, every row is read after it was predicted; offline, none after the cue. The settings of each were chosen by the
same search of nine, on letters of seed 100, which is not among those reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.memory.dynamics import SETTLING
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    Hopfield,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, check_letters, copybook, repertoire, wide_enough
from asm_gym.scripts.reproduce.kit import Findings, Record, curves

MODELS = {
    "memory": "traces, local",
    "memory_wide": "traces, local, 4 × the units",
    "settling": "settling, local",
    "gru": "GRU, BPTT",
    "lstm": "LSTM, BPTT",
    "hopfield": "modern Hopfield",
}

UNITS = {"memory_wide": 4.0, "settling": 1.75, "lstm": 0.86}
"""Units for each of a GRU's. A GRU of 64 has 13,700 weights; these then have 11,400, 13,300 and 13,600."""

CHOSEN: dict[str, dict[str, float]] = {
    "memory": {"rate": 1e-2, "gain": 4.0},
    "memory_wide": {"rate": 6e-3, "gain": 8.0},
    "settling": {"rate": 3e-3},
    "gru": {"rate": 6e-2, "noise": 0.3},
    "lstm": {"rate": 6e-2, "noise": 0.3},
    "hopfield": {"window": 8, "beta": 100.0},
}

LARGE, LARGE_RATE = 256, 3e-2
"""From so many units on a GRU diverges by its rate, and learns by this."""


LABELS = ("offline error [cm]", "online error [cm]", "offline error [cm]", "share of right skills")
"""Of the figure's panels."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Recall from a cue."""

    repertoires: tuple[int, ...] = option((1, 2, 4, 8, 16, 32), quick=(1, 4), least=1, check=check_letters)
    """Letters that one network learns."""
    widths: tuple[int, ...] = option((), quick=(), check=partial(wide_enough, channels=4))
    """Other numbers of hidden units, for a repertoire of eight."""
    cues: tuple[int, ...] = option((1, 2, 5, 10, 20, 30), least=1)
    """Rows that are read before recall begins."""
    models: tuple[str, ...] = option(tuple(MODELS), least=1, known=MODELS)
    """Models to compare."""
    steps: int = option(16000, quick=1500, least=1)
    """Batches of 64 rows for the networks of the memory."""
    updates: int = option(1200, quick=40, least=1)
    """Batches of 16 letters for the networks trained by backpropagation through time."""
    hidden: int = option(64, quick=32, check=partial(wide_enough, channels=4))
    """Hidden units of a GRU."""
    writings: int = option(8, quick=4, least=1)
    """Writings of each letter to learn from."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for cue in self.cues:
            if not 1 <= cue < STEPS:
                raise ValueError(f"a cue must be shorter than the letter, 1 to {STEPS - 1} steps, got {cue}")


Condition = tuple[int, int, int]
"""Seed, letters, hidden units of a GRU."""


def conditions(config: Config) -> list[Condition]:
    """Return every repertoire for every seed, and other widths for one repertoire."""
    every = [(s, n, config.hidden) for s in config.repetitions for n in config.repertoires]
    wide = [(s, middle(config), h) for s in config.repetitions for h in config.widths]
    return list(dict.fromkeys(every + wide))


def middle(config: Config) -> int:
    """Return the repertoire for which widths and cues are compared."""
    return 8 if 8 in config.repertoires else max(config.repertoires)


def recall(condition: Condition, config: Config) -> list[Record]:
    """Measure every model on one repertoire."""
    seed, skills, hidden = condition
    rng = np.random.default_rng([seed, 2])
    letters = repertoire(len(NAMES), 2, rng)[:skills]
    train, tests = copybook(letters, config.writings, 2, rng), copybook(letters, 4, 2, rng)
    means = mean_demonstrations(train, 2)
    records: list[Record] = []
    for name in config.models:
        model = learned(name, train, hidden, config, rng)
        for cue in (*config.cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {"seed": seed, "skills": skills, "hidden": hidden, "model": name, "cue": cue}
            records.append({**where, "error_cm": error, "right": right})
    return records


def learned(name: str, train: Sequence[Episode], hidden: int, config: Config, rng: np.random.Generator) -> Expresser:
    """Return one of ``MODELS``, trained; ``hidden`` is the units of a GRU."""
    how: dict[str, Any] = dict(CHOSEN[name])
    units = round(hidden * UNITS.get(name, 1.0))
    if name == "hopfield":
        return Hopfield.learned(train, **how)
    if name in ("gru", "lstm"):
        if name == "gru" and hidden >= LARGE:
            how["rate"] = LARGE_RATE
        return Backpropagated.learned(train, name, units, rng, config.updates, **how)
    if name == "settling":
        how["dynamics"] = SETTLING
    return ExpressionMemory.learned(train, units, rng, config.steps, **how)


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Return errors and right skills by repertoire, by cue and by width."""
    models = {MODELS[m]: {"model": m} for m in config.models}
    sizes, longest = kit.by("skills", config.repertoires), max(config.cues)
    own: Record = {"hidden": config.hidden}
    offline = f"{config.hidden} units, cue of {longest}; mean ± SD over seeds"
    made = [
        kit.grid(f"Offline error [cm] by letters, {offline}", records, "error_cm", models, sizes, cue=longest, **own),
        kit.grid("Share of right skills by letters, offline", records, "right", models, sizes, cue=longest, **own),
        kit.grid("Online error [cm] by letters", records, "error_cm", models, sizes, cue=STEPS, **own),
    ]
    cues = kit.by("cue", config.cues)
    for n in [n for n in config.repertoires if n >= middle(config)]:
        for value, label in (("error_cm", "Offline error [cm]"), ("right", "Share of right skills")):
            made.append(kit.grid(f"{label} by cue, {n} letters", records, value, models, cues, skills=n, **own))
    if config.widths:
        widths, where = kit.by("hidden", config.widths), {"skills": middle(config), "cue": longest}
        caption = f"Offline error [cm] by hidden units, {middle(config)} letters"
        made.append(kit.grid(caption, records, "error_cm", models, widths, **where))
    return made


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Draw errors by repertoire and cue."""
    models = {MODELS[m]: {"model": m} for m in config.models}
    sizes, cues = ("skills", config.repertoires), ("cue", config.cues)
    own: Record = {"hidden": config.hidden}
    with figure(height=3.4, width=11) as fig:
        axes = fig.subplots(1, 4)
        curves(axes[0], records, "error_cm", sizes, models, cue=max(config.cues), **own)
        curves(axes[1], records, "error_cm", sizes, models, cue=STEPS, **own)
        for ax, value in zip(axes[2:], ("error_cm", "right"), strict=True):
            curves(ax, records, value, cues, models, skills=middle(config), **own)
        for ax, label in zip(axes, LABELS, strict=True):
            ax.set(ylabel=label, ylim=0, xlabel="cue [rows]")
        for ax in axes[:2]:
            ax.set(xlabel="skills in the repertoire", xscale="log")
            ax.set_xticks(config.repertoires, [str(n) for n in config.repertoires])
        fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize=8)
    return fig


def run(config: Config) -> Findings:
    """Run every condition."""
    work = partial(recall, config=config)
    records = kit.together(kit.each("learning", work, conditions(config), config))
    return Findings(records, tables(records, config), drawn(records, config))
