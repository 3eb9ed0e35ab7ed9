"""The nearest baseline: each group of senses from all others, the past and the command, by ridge regression alone.

    ε_t = (Δ_t - D a_t)/s        D, s and a_t as in the memory's association, without its hidden units

What the memory's hidden units, precision and temporal network are worth is what it finds beyond this.
Source: Hoerl and Kennard 1970; ``memory.linear`` for one inverse that serves all groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.linear import check_inputs, learn_linear
from asm_gym.memory.state import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context, read_next
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.spec import StreamSpec

FAINTEST = 1e-4
"""Smallest spread of what is left of a standardised change."""


class LinearAssociation(StreamModel):
    """Ridge regression of each group's changes; it has no context."""

    kind = "association_linear"

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        self.lag = rows_apart(spec.dt)
        self.shortest = 1 + self.lag

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams, self.lag)
        check_inputs(senses.inputs)
        a = np.concatenate([senses.read_episode(s).inputs[self.lag :] for s in streams])
        D = learn_linear(a, senses.groups, senses.changes)
        left = np.sqrt(np.mean((a[:, senses.changes] - a @ D.T) ** 2, axis=0))
        return self.restore({**senses.arrays, "D": D, "remainder": np.maximum(left, FAINTEST)})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.senses_ = StreamScaler.of(self.spec, learned, self.lag)
        return super().restore(learned, skills)

    def start(self, batch: int) -> RowHistory:
        return RowHistory.empty(batch, self.lag, self.spec.size)

    def predict(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, r, known = read_next(self.senses_, state, rows)
        error = known * (r.changes - r.inputs @ self.learned_["D"].T) / self.learned_["remainder"]
        return state, ModelOutput(error, no_context(rows))
