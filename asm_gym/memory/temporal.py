"""What every temporal network does, whichever way it carries on what was: by traces, or by a state that settles.

time          c_{t-1} → μ_t → z_t → c_t    c: traces (``network``), or z itself (``settling``)
association   a_t → Δ̂_t, σ_t               beside it, and the same for both
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, association_shapes, normalised_errors, spans
from asm_gym.memory.energy import Array, Scalar
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.scaling import ScaledRows


class Step(NamedTuple):
    """What the network made of a row."""

    mu: Array  # (B, H) the state expected before it was read
    expected: Array  # (B, S + A) x̂_t and â_t, expected then
    z: Array  # (B, H) the state inferred from what was read of it
    traces: Array  # (B, I) c_t, what is carried on; what was unseen in it is as the rest has it


class TemporalNetwork(ABC):
    """Weights that no longer change, and what is needed to run them.

    Args:
        weights: the synapses through time; ``W_F`` (N, H) of them says how long a step of inference may be.
        association: the synapses between senses.
        iterations: inference steps per control step.
        prior_precision: Π_z.
        sensory_precision: Π_x.
    """

    weights: Any
    """The synapses through time, a NamedTuple of arrays whose fields each kind of network has of its own."""

    def __init__(
        self, weights: Any, association: Association, iterations: int, prior_precision: float, sensory_precision: float
    ) -> None:
        self.weights = weights
        self.association, self.spans = association, spans(association.U)
        self.iterations = iterations
        # Of single precision all of them, or the compiled loops would compute in double.
        self.prior_precision, self.sensory_precision = np.float32(prior_precision), np.float32(sensory_precision)
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.curvature = np.float32(prior_precision + sensory_precision * norm**2)

    def with_association(self, association: Association) -> Self:
        """The same network with other synapses between senses; this one keeps its own."""
        other = copy.copy(self)
        other.association, other.spans = association, spans(association.U)
        return other

    def with_iterations(self, iterations: int) -> Self:
        """The same network with other steps of inference, at most so many; this one keeps its own."""
        other = copy.copy(self)
        other.iterations = iterations
        return other

    def associate(self, reading: ScaledRows) -> tuple[Array, Array]:
        """(Δ_t - Δ̂_t)/σ_t (B, X), 0 where a row was not whole; and f(h_t) (B, M) of association."""
        error, units = normalised_errors(reading.inputs, reading.changes, reading.whole, *self.association, self.spans)
        return error, units

    @property
    def inference(self) -> tuple[Scalar, Scalar, Scalar, int]:
        """Π_z, Π_x, the curvature, and iterations."""
        return self.prior_precision, self.sensory_precision, self.curvature, self.iterations

    @property
    @abstractmethod
    def hidden_size(self) -> int:
        """H."""

    @property
    @abstractmethod
    def motor(self) -> int:
        """A."""

    @abstractmethod
    def at_rest(self, batch: int) -> NDArray[np.float32]:
        """c_0 (B, I), before the first row."""

    @abstractmethod
    def predict(self, c: Array, u: Array) -> Array:
        """[x̂_t, â_t] (B, S + A), before a row is read; arguments as in ``follow``."""

    @abstractmethod
    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        """A row is expected, then read, and its state inferred.

        Args:
            c: (B, I) what was carried on so far.
            u: (B, A + 1) the action as commanded, standardised, and a constant 1.
            x: (B, S) what was sensed, standardised.
            seen: (B, S) 1 where ``x`` is a measurement, 0 where it is to be ignored.
        """

    @abstractmethod
    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        """f(μ_t) (B, H) and c_t (B, I): what of ``follow`` is needed to watch."""

    @abstractmethod
    def run_on(self, c: Array) -> Step:
        """A row that is not read: the action is the network's own, and so are the senses it leads to."""


class Trained(NamedTuple):
    """A finished network, and how its energy fell."""

    network: TemporalNetwork
    energy: NDArray[np.float64]  # (epochs,) mean energy of a step in each epoch


Learn = Callable[[Sequence[Trajectory], int, Schedule, np.random.Generator, Callable[[], None]], Trained]
"""Learns the synapses through time of so many hidden units; what it makes has no association yet. Called with
trajectories, H, how to learn, what draws at random, and what to call after each epoch."""


def unassociated() -> Association:
    """An association without units."""
    return Association(*(np.zeros(shape, np.float32) for shape in association_shapes(1, 0, 0).values()))
