"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Claim: local rules recall letters about as well as networks trained by backpropagation through time. Compared are the
network of recurrent units with as many weights as a GRU and with four times its units; the settling network with as
many weights, and as the papers set it; the GRU.
Online, every row is read after it was predicted; offline, none after the cue. The settings of each were chosen by the
same search of nine, on letters of seed 100, which is not among those reported; those of the papers are their own.

Source: Tang, Barron and Bogacz 2023 (NeurIPS), and their code, C16Mftang/sequential-memory, ``multilayer.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

from asm_gym.data.episode import Episode
from asm_gym.evaluation.tables import Table
from asm_gym.memory.dynamics import ITERATIONS, PRIOR_PRECISION, SETTLING
from asm_gym.memory.learning import Moment, Practice, Schedule
from asm_gym.memory.settling import SettlingLearner, SettlingNetwork, initial_settling_weights
from asm_gym.memory.temporal import unassociated
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.backpropagation import Training, side_by_side
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    LocalTraining,
    fit_reader,
    mean_demonstrations,
    recalled,
    trajectories,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.validation import check_number

MODELS = {
    "recurrent": "recurrent, local",
    "recurrent_wide": "recurrent, local, 4 × the units",
    "settling": "settling, local",
    "published": "settling, as published, 480 units",
    "gru": "GRU, BPTT",
}
UNITS = {"recurrent": 1.875, "recurrent_wide": 4.0, "settling": 1.75}
"""Units for each of a GRU's. A GRU of 64 has 13,700 weights; these then have 13,700, 55,300 and 13,300."""
AGAINST_NOISE = LocalTraining(rate=3e-3, free_running=0.0, noise=0.3)
LOCAL = {
    "recurrent": AGAINST_NOISE,
    "recurrent_wide": AGAINST_NOISE,
    "settling": LocalTraining(rate=3e-3, dynamics=SETTLING),
}
BACKPROPAGATION = Training(rate=6e-2, noise=0.3)
PUBLISHED_UNITS = 480
PUBLISHED_RATE = 1e-4


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
    records = kit.records_of("learning", partial(recall, config=config), jobs, config)
    frame = pd.DataFrame(records).replace({"model": MODELS})
    longest = max(config.cues)
    offline = frame[frame.cue == longest]
    online = frame[frame.cue == STEPS]
    cued = f"{config.hidden} units, cue of {longest}; mean ± SD over seeds"
    right = "Share of right skills by letters, offline"
    tables = [
        errors(f"Offline error [cm] by letters, {cued}", offline, "skills"),
        kit.grid(right, offline, "right", "model", "skills"),
        errors("Online error [cm] by letters", online, "skills"),
    ]
    for n in config.repertoires:
        own = frame[(frame.skills == n) & (frame.cue < STEPS)]
        tables.append(errors(f"Offline error [cm] by cue, {n} letters", own, "cue"))
    return Findings(records, tables)


def errors(caption: str, records: pd.DataFrame, columns: str) -> Table:
    """Return the table of the errors of each model."""
    return kit.grid(caption, records, "error_cm", "model", columns)


def recall(job: tuple[int, int], config: Config) -> list[Record]:
    """Measure every model with one seed and number of letters."""
    seed, skills = job
    rng = np.random.default_rng([seed, 2])
    letters = repertoire(len(NAMES), rng)[:skills]
    train = copybook(letters, config.writings, rng)
    tests = copybook(letters, 4, rng)
    if config.memorised:
        tests = train
    means = mean_demonstrations(train)

    records = []
    for name in config.models:
        model = learned(name, train, config, rng)
        for cue in (*config.cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            records.append(
                {
                    "seed": seed,
                    "skills": skills,
                    "model": name,
                    "cue": cue,
                    "error_cm": error,
                    "right": right,
                }
            )
    return records


def learned(
    name: str, train: Sequence[Episode], config: Config, rng: np.random.Generator
) -> Expresser:
    """Return one of ``MODELS``, trained."""
    if name == "published":
        return as_published(train, config.epochs, rng)
    if name == "gru":
        training = replace(BACKPROPAGATION, hidden=config.hidden, updates=config.updates)
        return Backpropagated.learned(train, training, rng)
    hidden = round(config.hidden * UNITS.get(name, 1.0))
    settings = replace(LOCAL[name], hidden=hidden, steps=config.steps)
    return ExpressionMemory.learned(train, settings, rng)


def as_published(
    train: Sequence[Episode], epochs: int, rng: np.random.Generator
) -> ExpressionMemory:
    """Return the settling network learned as in the papers: side by side, at one rate, never running on alone.

    Inference is this package's, which goes at least as far down the energy as a hundred steps of 0.01.
    """
    reader = fit_reader(train)
    batch = side_by_side(trajectories(reader, train))
    begins = np.zeros((len(batch.senses), len(train), 1), np.bool_)
    begins[0] = True
    moments = list(map(Moment, batch.senses, batch.commands, begins))
    schedule = Schedule(
        epochs=epochs,
        batch_size=len(train),
        learning_rate=PUBLISHED_RATE,
        iterations=ITERATIONS,
        prior_precision=PRIOR_PRECISION,
        sensory_precision=1.0,
        free_running_probability=0.0,
    )
    sensory = batch.senses.shape[2]
    motor = batch.commands.shape[2] - 1
    weights = initial_settling_weights(PUBLISHED_UNITS, sensory, motor, rng)
    practice = Practice(SettlingLearner(weights, schedule, rng), len(train), rng)
    for _ in range(epochs):
        practice.run(moments, PUBLISHED_RATE, free=0.0)
    network = SettlingNetwork(
        weights, unassociated(), schedule.iterations, schedule.prior_precision, 1.0
    )
    return ExpressionMemory(reader, network)
