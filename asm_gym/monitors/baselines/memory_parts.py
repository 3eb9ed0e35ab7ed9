"""The parts of the Neural ASM, each alone: what one finds without the other is what it is worth.

memory_temporal      ε_t = (x_t - x̂_t)/s    x̂_t from traces or a settled state, and the command; context: the state
memory_association   ε_t as in the memory    from the other senses, what came before and the command; no context

``association_linear`` is association without hidden units. All are judged by the detection of the memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.dynamics import TRACES
from asm_gym.memory.state import MemoryState
from asm_gym.monitors.base import Progress
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.stream_model import StreamModel, model_outputs, no_context
from asm_gym.spec import StreamSpec

FAINTEST = 1e-4
"""Smallest spread of an error, in standard deviations of the sense."""


class _Part(StreamModel):
    """A whole memory of one of ``memory.dynamics.DYNAMICS``, of which a part is heard."""

    def __init__(self, spec: StreamSpec, dynamics: str = TRACES) -> None:
        super().__init__(spec)
        self.dynamics = dynamics
        self.memory = NeuralASM(spec, dynamics=dynamics).model
        self.shortest = self.memory.shortest

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        return self.restore(self.memory.fit(episodes, rng, progress).learned_)

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.memory.restore(learned)
        return super().restore(learned, skills)

    def start(self, batch: int) -> MemoryState:
        return self.memory.start(batch)


class AssociationPart(_Part):
    """Association, without the context that the temporal network gives."""

    kind = "memory_association"

    def predict(self, state: MemoryState, rows: NDArray[np.float64]) -> tuple[MemoryState, ModelOutput]:
        state, output = self.memory.predict(state, rows)
        return state, ModelOutput(output.errors, no_context(rows))


class TemporalPart(_Part):
    """What the temporal network expects of the senses, and its state as the context."""

    kind = "memory_temporal"

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """Of values, then of the changes of slow channels."""
        return np.concatenate([self.spec.sensory, self.memory.senses_.slow])

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        learned = self.memory.fit(episodes, rng, progress).learned_
        self.restore({**learned, "temporal_spread": np.ones(self.memory.senses_.size)})
        errors = np.concatenate([output.errors for output in model_outputs(self, episodes)])
        spread = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), FAINTEST)
        return self.restore({**learned, "temporal_spread": spread})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.memory.restore({n: a for n, a in learned.items() if n != "temporal_spread"})
        return StreamModel.restore(self, learned, skills)

    def predict(self, state: MemoryState, rows: NDArray[np.float64]) -> tuple[MemoryState, ModelOutput]:
        reading = self.memory.senses_.read(rows, *state.history.past(rows))
        expected = self.memory.network.predict(state.traces, reading.commands)
        error = (reading.senses - expected[:, : self.memory.senses_.size]) * reading.seen
        # Nothing is expected of the first row, nor of rows in between, which the traces do not take up.
        steps = state.history.steps
        error[(steps == 0) | (steps % self.memory.lag != 0)] = 0.0
        state, output = self.memory.predict(state, rows)
        return state, ModelOutput(error / self.learned_["temporal_spread"], output.contexts)
