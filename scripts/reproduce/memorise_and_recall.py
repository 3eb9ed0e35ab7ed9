"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Claim: local rules recall letters about as well as networks trained by backpropagation through time. Compared are the
temporal predictive coding network by traces, with as many units as its rivals and with four times as many; the settling
network with as many weights as a GRU; and the GRU.
Online, every row is read after it was predicted; offline, none after the cue. The settings of each were chosen by the
same search of nine, on letters of seed 100, which is not among those reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from asm_gym.data.episode import Episode
from asm_gym.evaluation.figures import figure
from asm_gym.memory.dynamics import SETTLING
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, curves
from asm_gym.validation import check_number

MODELS = {
    "memory": "traces, local",
    "memory_wide": "traces, local, 4 × the units",
    "settling": "settling, local",
    "gru": "GRU, BPTT",
}
UNITS = {"memory_wide": 4.0, "settling": 1.75}
"""Units for each of a GRU's. A GRU of 64 has 13,700 weights; these then have 11,400 and 13,300."""
CHOSEN: dict[str, dict[str, Any]] = {
    "memory": {"rate": 1e-2, "gain": 4.0},
    "memory_wide": {"rate": 6e-3, "gain": 8.0},
    "settling": {"rate": 3e-3, "dynamics": SETTLING},
    "gru": {"rate": 6e-2, "noise": 0.3},
}


@dataclass(frozen=True)
class Config(kit.Config):
    """Recall from a cue."""

    repertoires: tuple[int, ...] = option((1, 2, 4, 8, 16, 32), quick=(1, 4), least=1, check=check_letters)
    """Letters that one network learns."""
    cues: tuple[int, ...] = option(
        (1, 2, 5, 10, 20, 30), least=1, check=partial(check_number, "cue", low=1, high=STEPS - 1, whole=True)
    )
    """Rows that are read before recall begins."""
    models: tuple[str, ...] = option(tuple(MODELS), least=1, known=MODELS)
    """Models to compare."""
    steps: int = option(16000, quick=1500, least=1)
    """Batches of 64 rows for the networks of the memory."""
    updates: int = option(1200, quick=40, least=1)
    """Batches of 16 letters for the networks trained by backpropagation through time."""
    hidden: int = option(64, quick=32, least=4)
    """Hidden units of a GRU."""
    writings: int = option(8, quick=4, least=1)
    """Writings of each letter to learn from."""

    @property
    def middle(self) -> int:
        """The repertoire for which cues are drawn."""
        return 8 if 8 in self.repertoires else max(self.repertoires)


def run(config: Config) -> Findings:
    """Measure every model on every repertoire."""
    jobs = list(product(config.repetitions, config.repertoires))
    records = kit.together(kit.each("learning", partial(recall, config=config), jobs, config))
    models, longest = {MODELS[m]: {"model": m} for m in config.models}, max(config.cues)
    sizes, cues = kit.by("skills", config.repertoires), kit.by("cue", config.cues)
    cued = f"{config.hidden} units, cue of {longest}; mean ± SD over seeds"
    tables = [
        kit.grid(f"Offline error [cm] by letters, {cued}", records, "error_cm", models, sizes, cue=longest),
        kit.grid("Share of right skills by letters, offline", records, "right", models, sizes, cue=longest),
        kit.grid("Online error [cm] by letters", records, "error_cm", models, sizes, cue=STEPS),
    ]
    for n in [n for n in config.repertoires if n >= config.middle]:
        for value, label in (("error_cm", "Offline error [cm]"), ("right", "Share of right skills")):
            tables.append(kit.grid(f"{label} by cue, {n} letters", records, value, models, cues, skills=n))
    with figure(height=3.4, width=11) as fig:
        axes = fig.subplots(1, 4)
        for ax, cue, label in zip(axes, (longest, STEPS), ("offline error [cm]", "online error [cm]"), strict=False):
            curves(ax, records, "error_cm", ("skills", config.repertoires), models, cue=cue)
            ax.set(xlabel="skills in the repertoire", xscale="log", ylabel=label, ylim=0)
            ax.set_xticks(config.repertoires, [str(n) for n in config.repertoires])
        for ax, value in zip(axes[2:], ("error_cm", "right"), strict=True):
            curves(ax, records, value, ("cue", config.cues), models, skills=config.middle)
            label = "offline error [cm]" if value == "error_cm" else "share of right skills"
            ax.set(xlabel="cue [rows]", ylabel=label, ylim=0)
        fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(models), fontsize=8)
    return Findings(records, tables, fig)


def recall(job: tuple[int, int], config: Config) -> list[Record]:
    """Measure every model with one seed and number of letters."""
    seed, skills = job
    rng = np.random.default_rng([seed, 2])
    letters = repertoire(len(NAMES), rng)[:skills]
    train, tests = copybook(letters, config.writings, rng), copybook(letters, 4, rng)
    means = mean_demonstrations(train)
    records: list[Record] = []
    for name in config.models:
        model = learned(name, train, config, rng)
        for cue in (*config.cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {"seed": seed, "skills": skills, "model": name, "cue": cue}
            records.append({**where, "error_cm": error, "right": right})
    return records


def learned(name: str, train: Sequence[Episode], config: Config, rng: np.random.Generator) -> Expresser:
    """Return one of ``MODELS``, trained."""
    units = round(config.hidden * UNITS.get(name, 1.0))
    if name == "gru":
        return Backpropagated.learned(train, units, rng, config.updates, **CHOSEN[name])
    return ExpressionMemory.learned(train, units, rng, config.steps, **CHOSEN[name])
