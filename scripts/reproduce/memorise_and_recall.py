"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Claim: local rules recall letters about as well as networks trained by backpropagation through time. Compared are the
temporal predictive coding network by traces, with as many units as its rivals and with four times as many; the settling
network with as many weights as a GRU, and as the papers set it; and the GRU.
Online, every row is read after it was predicted; offline, none after the cue. The settings of each were chosen by the
same search of nine, on letters of seed 100, which is not among those reported; those of the papers are their own.

Source: Tang, Barron and Bogacz 2023 (NeurIPS), and their code, C16Mftang/sequential-memory, ``multilayer.py``.
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
from asm_gym.memory.dynamics import DYNAMICS, SETTLING
from asm_gym.memory.learning import Moment, Practice, Schedule
from asm_gym.memory.settling import SettlingLearner, SettlingNetwork, initial_settling_weights
from asm_gym.memory.temporal import unassociated
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    mean_demonstrations,
    recalled,
    trajectories,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, curves
from asm_gym.scripts.reproduce.recurrent import side_by_side
from asm_gym.validation import check_number

MODELS = {
    "memory": "traces, local",
    "memory_wide": "traces, local, 4 × the units",
    "settling": "settling, local",
    "published": "settling, as published, 480 units",
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


PUBLISHED_UNITS, PUBLISHED_RATE = 480, 1e-4


@dataclass(frozen=True)
class Config(kit.Config):
    """Recall from a cue."""

    repertoires: tuple[int, ...] = option(
        (1, 2, 4, 8, 16, 32), quick=(1, 4), least=1, check=check_letters
    )
    """Letters that one network learns."""
    cues: tuple[int, ...] = option(
        (1, 2, 5, 10, 20, 30),
        least=1,
        check=partial(check_number, "cue", low=1, high=STEPS - 1, whole=True),
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
    memorised: bool = False
    """Recall the very writings that were learned, as the papers do, and not other ones of the same letters."""
    epochs: int = option(200, quick=2, least=1)
    """Passes of the network as published over whole writings, side by side."""


def run(config: Config) -> Findings:
    """Measure every model on every repertoire."""
    jobs = list(product(config.repetitions, config.repertoires))
    each = kit.each("learning", partial(recall, config=config), jobs, config)
    records = [record for own in each for record in own]
    models, longest = {MODELS[m]: {"model": m} for m in config.models}, max(config.cues)
    sizes, cues = kit.by("skills", config.repertoires), kit.by("cue", config.cues)
    cued = f"{config.hidden} units, cue of {longest}; mean ± SD over seeds"
    tables = [
        kit.grid(
            f"Offline error [cm] by letters, {cued}",
            records,
            "error_cm",
            models,
            sizes,
            cue=longest,
        ),
        kit.grid(
            "Share of right skills by letters, offline",
            records,
            "right",
            models,
            sizes,
            cue=longest,
        ),
        kit.grid("Online error [cm] by letters", records, "error_cm", models, sizes, cue=STEPS),
        *(
            kit.grid(
                f"Offline error [cm] by cue, {n} letters",
                records,
                "error_cm",
                models,
                cues,
                skills=n,
            )
            for n in config.repertoires
        ),
    ]
    with figure(height=3.4, width=7) as fig:
        axes = fig.subplots(1, 2)
        for ax, cue, label in zip(
            axes, (longest, STEPS), ("offline error [cm]", "online error [cm]"), strict=True
        ):
            curves(ax, records, "error_cm", ("skills", config.repertoires), models, cue=cue)
            ax.set(xlabel="skills in the repertoire", xscale="log", ylabel=label, ylim=0)
            ax.set_xticks(config.repertoires, [str(n) for n in config.repertoires])
        fig.legend(
            *axes[0].get_legend_handles_labels(),
            loc="outside upper center",
            ncols=len(models),
            fontsize=8,
        )
    return Findings(records, tables, fig)


def recall(job: tuple[int, int], config: Config) -> list[Record]:
    """Measure every model with one seed and number of letters."""
    seed, skills = job
    rng = np.random.default_rng([seed, 2])
    letters = repertoire(len(NAMES), rng)[:skills]
    train, others = copybook(letters, config.writings, rng), copybook(letters, 4, rng)
    tests = train if config.memorised else others
    means = mean_demonstrations(train)
    records: list[Record] = []
    for name in config.models:
        model = learned(name, train, config, rng)
        for cue in (*config.cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {"seed": seed, "skills": skills, "model": name, "cue": cue}
            records.append({**where, "error_cm": error, "right": right})
    return records


def learned(
    name: str, train: Sequence[Episode], config: Config, rng: np.random.Generator
) -> Expresser:
    """Return one of ``MODELS``, trained."""
    units = round(config.hidden * UNITS.get(name, 1.0))
    if name == "gru":
        return Backpropagated.learned(train, units, rng, config.updates, **CHOSEN[name])
    if name == "published":
        return as_published(train, config.epochs, rng)
    return ExpressionMemory.learned(train, units, rng, config.steps, **CHOSEN[name])


def as_published(
    train: Sequence[Episode], epochs: int, rng: np.random.Generator
) -> ExpressionMemory:
    """Return the settling network learned as in the papers: side by side, at one rate, never running on alone.

    Inference is this package's, which goes at least as far down the energy as a hundred steps of 0.01.
    """
    reader, how, count = (
        StreamScaler.fit(train[0].spec, [e.stream for e in train]),
        DYNAMICS[SETTLING],
        len(train),
    )
    rows = zip(*side_by_side(trajectories(reader, train)), strict=True)
    moments = [Moment(x, u, np.full((count, 1), t == 0)) for t, (x, u) in enumerate(rows)]
    schedule = Schedule(
        epochs, count, PUBLISHED_RATE, how.iterations, how.prior_precision, 1.0, 0.0
    )
    sensory, motor = moments[0].senses.shape[1], moments[0].commands.shape[1] - 1
    weights = initial_settling_weights(PUBLISHED_UNITS, sensory, motor, rng)
    practice = Practice(SettlingLearner(weights, schedule, rng), count, rng)
    for _ in range(epochs):
        practice.run(moments, PUBLISHED_RATE, 0.0)
    return ExpressionMemory(
        reader, SettlingNetwork(weights, unassociated(), how.iterations, how.prior_precision, 1.0)
    )
