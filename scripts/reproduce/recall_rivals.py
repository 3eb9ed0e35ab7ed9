"""What recalls letters and splines: the memory, and its rivals.

The temporal predictive coding network on traces, learned by local rules, with as many units as its rivals, and with
four times as many; a GRU and a plain RNN trained by backpropagation through time; the GRU with errors that go back one
step, which is as local; a modern continuous Hopfield network, which keeps every window; and a library of movement
primitives, which is told the skill.

Settings were chosen on sixteen and 32 letters of seed 100, which is none of those that are reported. Of the memory, in
nineteen runs: the rate (3e-3 to 2e-2), the gain (1 to 16), how often it runs alone, and the law of cues. Of the GRU and
the RNN, in five: the rate (3e-3, 1e-2) and the noise (0.1, 0.3); those from before were the best. The GRU of one step
has those of the GRU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.episodes import Episode
from asm_gym.scripts.reproduce import splines
from asm_gym.scripts.reproduce.common import Record
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    Hopfield,
    Library,
    Memory,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, copybook, repertoire

MODELS = ("memory", "memory_wide", "gru", "rnn", "gru_one_step", "hopfield", "library")
CALLED = {
    "memory": "temporal predictive coding, local",
    "memory_wide": "the same, 4 × the units",
    "gru": "GRU, BPTT",
    "rnn": "RNN, BPTT",
    "gru_one_step": "GRU, BPTT of one step",
    "hopfield": "modern Hopfield",
    "library": "primitives, told the skill",
}

WIDER = 4
"""Units of the wide memory for each of a rival's. With 256 it has 11,400 weights, and a GRU of 64 units has 13,700."""

WIDEST = 512
"""Units up to which there is a wide memory."""

RATE, GAIN = 1e-2, 1.0
WIDE_RATE, WIDE_GAIN = 6e-3, 8.0
"""How the memory learns, and the wide one; see ``Memory.learned``."""


class Condition(NamedTuple):
    """What one network is asked to learn."""

    seed: int
    skills: int
    hidden: int
    dims: int
    domain: str = "letters"


def recall(condition: Condition, each: int, steps: int, updates: int, cues: Sequence[int]) -> list[Record]:
    """Every model on one repertoire.

    Args:
        each: writings of every skill to learn from.
        steps: in which the synapses of the memory change, by 64 rows each.
        updates: of the networks trained by backpropagation through time, by 16 writings each.
        cues: rows that are read before recall begins.
    """
    hidden, dims = condition.hidden, condition.dims
    rng = np.random.default_rng([condition.seed, dims])
    train, tests = writings(condition, each, rng)
    told = [str(e.info["skill"]) for e in tests]
    models: dict[str, Expresser] = {"memory": Memory.learned(train, hidden, rng, steps, rate=RATE, gain=GAIN)}
    if WIDER * hidden <= WIDEST:
        wide = Memory.learned(train, WIDER * hidden, rng, steps, rate=WIDE_RATE, gain=WIDE_GAIN)
        models["memory_wide"] = wide
    models |= {
        "gru": Backpropagated.learned(train, "gru", hidden, rng, updates),
        "rnn": Backpropagated.learned(train, "rnn", hidden, rng, updates),
        "gru_one_step": Backpropagated.learned(train, "gru", hidden, rng, updates, truncated=True),
        "hopfield": Hopfield.learned(train),
        "library": Library.learned(train, told),
    }
    means = mean_demonstrations(train, dims)
    records: list[Record] = []
    for name, model in models.items():
        for cue in (*cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {**condition._asdict(), "model": name, "cue": cue, "online": cue == STEPS}
            records.append({**where, "error_cm": error, "right": right})
    return records


def writings(condition: Condition, each: int, rng: np.random.Generator) -> tuple[list[Episode], list[Episode]]:
    """So many of every skill to learn from, and four to be asked for."""
    _, skills, _, dims, domain = condition
    if domain == "splines":
        paths = splines.repertoire(skills, dims, rng)
        return splines.copybook(paths, each, rng), splines.copybook(paths, 4, rng)
    letters = repertoire(len(NAMES), dims, rng)[:skills]
    return copybook(letters, each, dims, rng), copybook(letters, 4, dims, rng)
