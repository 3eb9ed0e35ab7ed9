"""What recalls letters and splines: the memory, and its rivals.

The temporal predictive coding network on traces, learned by local rules, with as many units as its rivals, and with
four times as many; the one whose state is carried on and settles, with as many weights as a GRU; a GRU, an LSTM of as
many weights and a plain RNN trained by backpropagation through time; the GRU with errors that go back one step, which
is as local; a modern continuous Hopfield network, which keeps every window.

How each is set was chosen by the same search for all, of nine settings each, on letters of seed 100,
which is none of those that are reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.episode import Episode
from asm_gym.memory.dynamics import SETTLING
from asm_gym.scripts.reproduce import splines
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    ExpressionMemory,
    Hopfield,
    between_glimpses,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Record

MODELS = ("memory", "memory_wide", "settling", "gru", "lstm", "rnn", "gru_one_step", "hopfield")
CALLED = {
    "memory": "temporal predictive coding, local",
    "memory_wide": "the same, 4 × the units",
    "settling": "settling, local",
    "gru": "GRU, BPTT",
    "lstm": "LSTM, BPTT",
    "rnn": "RNN, BPTT",
    "gru_one_step": "GRU, BPTT of one step",
    "hopfield": "modern Hopfield",
}

WIDER = 4
"""Units of the wide memory for each of a rival's. With 256 it has 11,400 weights, and a GRU of 64 units has 13,700."""

AS_HEAVY = {"settling": 1.75, "lstm": 0.86}
"""Units of these for each of a GRU's, so that they have as many weights: 13,300, 13,600 and 13,700 where it has 64."""

EVERY = (4, 10)
"""Where senses come and go, one row in so many is sensed."""

WIDEST = 512
"""Units up to which there is a wide memory."""

Setting = Mapping[str, float]
"""Arguments by which a model learns."""

CHOSEN: dict[str, Setting] = {
    "memory": {"rate": 1e-2, "gain": 4.0},
    "memory_wide": {"rate": 6e-3, "gain": 8.0},
    "settling": {"rate": 3e-3},
    "gru": {"rate": 6e-2, "noise": 0.3},
    "lstm": {"rate": 6e-2, "noise": 0.3},
    "rnn": {"rate": 3e-2, "noise": 0.6},
    "gru_one_step": {"rate": 3e-2, "noise": 0.3},
    "hopfield": {"window": 8, "beta": 100.0},
}
"""How each learns; what each number means is said where it is taken."""

LARGE = 256
CHOSEN_LARGE = CHOSEN | {"gru": {"rate": 3e-2, "noise": 0.3}, "rnn": {"rate": 1e-2, "noise": 0.6}}
"""How each learns with so many units or more, for which the steps of few are too large."""


class Condition(NamedTuple):
    """What one network is asked to learn."""

    seed: int
    skills: int
    hidden: int
    dims: int
    domain: str = "letters"


class Practice(NamedTuple):
    """How much they are shown, and how often."""

    each: int  # writings of every skill
    steps: int  # in which the synapses of the memory change, by 64 rows each
    updates: int  # of the networks trained by backpropagation through time, by 16 writings each


def recall(
    condition: Condition, practice: Practice, cues: Sequence[int], models: Sequence[str] = MODELS
) -> list[Record]:
    """Every model on one repertoire.

    Args:
        practice: how much each learns from.
        cues: rows that are read before recall begins.
        models: which of ``MODELS``.
    """
    rng = np.random.default_rng([condition.seed, condition.dims])
    train, tests = writings(condition, practice.each, rng)
    means = mean_demonstrations(train, condition.dims)
    records: list[Record] = []
    for name in models:
        if name == "memory_wide" and WIDER * condition.hidden > WIDEST:
            continue
        how = (CHOSEN if condition.hidden < LARGE else CHOSEN_LARGE)[name]
        model = learned(name, how, train, condition.hidden, practice, rng)
        for cue in (*cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {**condition._asdict(), "model": name, "cue": cue, "online": cue == STEPS}
            records.append({**where, "error_cm": error, "right": right})
        if isinstance(model, ExpressionMemory | Backpropagated):
            gaps = {every: between_glimpses(model, tests, condition.dims, every) for every in EVERY}
            records += [{**condition._asdict(), "model": name, "every": e, "glimpsed_cm": g} for e, g in gaps.items()]
    return records


def learned(
    name: str,
    setting: Setting,
    train: Sequence[Episode],
    hidden: int,
    practice: Practice,
    rng: np.random.Generator,
) -> Expresser:
    """One of ``MODELS``, as it is set.

    Args:
        hidden: units of a rival.
    """
    how: dict[str, Any] = dict(setting)
    if name in ("memory", "memory_wide"):
        return ExpressionMemory.learned(
            train, hidden * (WIDER if name == "memory_wide" else 1), rng, practice.steps, **how
        )
    units = round(hidden * AS_HEAVY.get(name, 1.0))
    if name == "settling":
        return ExpressionMemory.learned(train, units, rng, practice.steps, dynamics=SETTLING, **how)
    if name == "hopfield":
        return Hopfield.learned(train, **how)
    cell, truncated, _ = name.partition("_one_step")
    return Backpropagated.learned(train, cell, units, rng, practice.updates, truncated=bool(truncated), **how)


def writings(condition: Condition, each: int, rng: np.random.Generator) -> tuple[list[Episode], list[Episode]]:
    """So many of every skill to learn from, and four to be asked for."""
    _, skills, _, dims, domain = condition
    if domain == "splines":
        paths = splines.repertoire(skills, dims, rng)
        return splines.copybook(paths, each, rng), splines.copybook(paths, 4, rng)
    letters = repertoire(len(NAMES), dims, rng)[:skills]
    return copybook(letters, each, dims, rng), copybook(letters, 4, dims, rng)
