"""Ridge regression of the changes of each group of senses: association without hidden units.

    ε_t = (Δ_t - D a_t)/s      D, s, a_t: as of association

What the memory's hidden units, precision and temporal network are worth is what it finds beyond this.

Source: Hoerl and Kennard 1970.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.memory.association import ChangeLayout
from asm_gym.memory.linear_association import check_inputs, learn_linear
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.monitors.torque.crossfitting import LEAST_REMAINDER
from asm_gym.scaling import rows_apart
from asm_gym.spec import StreamSpec


class LinearAssociation(ScaledModel):
    """Ridge regression of each group's changes; it has no context."""

    kind = "association_linear"

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec, rows_apart(spec.dt))

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        readings = self.read_nominal(episodes)
        senses = self.senses_
        check_inputs(senses.inputs)
        inputs = np.concatenate([reading.inputs[self.lag :] for reading in readings])
        D = learn_linear(inputs, ChangeLayout.of(senses))
        rest = inputs[:, senses.changes] - inputs @ D.T
        remainder = np.sqrt(np.mean(rest**2, axis=0))
        learned = {"D": D, "remainder": np.maximum(remainder, LEAST_REMAINDER)}
        return self.restore({**senses.arrays, **learned})

    def predict(
        self, state: RowHistory, rows: NDArray[np.float64]
    ) -> tuple[RowHistory, ModelOutput]:
        state, reading, known = read_next(self.senses_, state, rows)
        rest = reading.changes - reading.inputs @ self.learned_["D"].T
        error = known * rest / self.learned_["remainder"]
        return state, ModelOutput(error, no_context(rows))
