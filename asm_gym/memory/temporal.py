"""What every temporal network does, by ``recurrent`` units or by a state that settles (``settling``).

time          c_{t-1} → μ_t → z_t → c_t    c: what is carried on: units and the last row, or z itself
association   a_t → Δ̂_t, σ_t               beside it, the same for both; they share rows and no state

Association compares each row with that of l rows before, so that l rows and those before them are kept; the network
takes up every l-th row. l is 1 at a control rate (``scaling``).
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, association_shapes
from asm_gym.memory.energy import Array, Inference
from asm_gym.memory.learning import Learner, Schedule, Tick, Trajectory, practise

Rows = NDArray[np.float64]

# weight of an error while only one earlier row is known, and with it no speed
UNSURE = np.float32(0.1)


class RowHistory(NamedTuple):
    """The rows that the next ones are compared with, one entry a stream; never changed in place."""

    before: Rows  # (B, l, D) the rows seen last, the oldest first
    earlier: Rows  # (B, l, D) those before
    steps: NDArray[np.int64]  # (B,) rows seen so far

    @classmethod
    def empty(cls, batch: int, lag: int, size: int) -> Self:
        """Return the history before the first row of ``size`` numbers."""
        rows = np.zeros((batch, lag, size))
        return cls(rows, rows, np.zeros(batch, np.int64))

    @property
    def lag(self) -> int:
        """l."""
        return self.before.shape[1]

    def past(self, rows: Rows) -> tuple[Rows, Rows]:
        """Return the rows l before ``rows`` (B, D), and as long before those; at first nothing moves."""
        steps = self.steps[:, None]
        before = np.where(steps >= self.lag, self.before[:, 0], rows)
        earlier = np.where(steps >= 2 * self.lag, self.earlier[:, 0], before)
        return before, earlier

    def followed_by(self, rows: Rows) -> RowHistory:
        """Return the history after the next rows (B, D)."""
        last, _ = self.past(rows)
        return RowHistory(
            before=np.concatenate([self.before[:, 1:], rows[:, None]], axis=1),
            earlier=np.concatenate([self.earlier[:, 1:], last[:, None]], axis=1),
            steps=self.steps + 1,
        )


class MemoryState(NamedTuple):
    """State of the memory, one entry a stream; never changed in place."""

    # (B, I) c, of what was sensed and done; or the state z that settled on it
    carried: NDArray[np.float32]
    expected: NDArray[np.float32]  # (B, H) f(μ), of the state that was expected then
    history: RowHistory
    skill: NDArray[np.float32]  # (B, K) L, evidence for each skill; K is 0 where none has a name


class Step(NamedTuple):
    """Outcome of a row."""

    mu: Array  # (B, H) the state expected before it was read
    expected: Array  # (B, S + A) x̂_t and â_t, expected then
    z: Array  # (B, H) the inferred state
    carried: Array  # (B, I) c_t, the new carried state; missing senses in it are completed
    senses: Array  # (B, S) what was sensed; what was missing is inferred


class TemporalNetwork(ABC):
    """A network whose weights no longer change.

    Args:
        weights: the synapses, a NamedTuple with an array ``W_F`` (N, H).
        association: the synapses between senses.
        iterations: most steps of inference.
        prior_precision: Π_z.
        sensory_precision: Π_x.
    """

    def __init__(
        self,
        weights: Any,
        association: Association,
        iterations: int,
        prior_precision: float,
        sensory_precision: float,
    ) -> None:
        self.weights = weights
        self.association = association
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.inference = Inference(
            prior_precision=np.float32(prior_precision),
            sensory_precision=np.float32(sensory_precision),
            curvature=np.float32(prior_precision + sensory_precision * norm**2),
            iterations=iterations,
        )

    def with_association(self, association: Association) -> Self:
        """Return a copy with other synapses between senses."""
        other = copy.copy(self)
        other.association = association
        return other

    def with_iterations(self, iterations: int) -> Self:
        """Return a copy with another number of inference steps."""
        other = copy.copy(self)
        other.inference = self.inference._replace(iterations=iterations)
        return other

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
        """Return c_0 (B, I), before the first row."""

    @abstractmethod
    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        """Expect a row from the carried state ``c`` (B, I), read it, and infer its state.

        ``u`` (B, A + 1) is the action and a constant 1, ``x`` (B, S) what was sensed, ``seen`` 0 where it is ignored.
        """

    @abstractmethod
    def run_on(self, c: Array) -> Step:
        """Predict a row without reading it: both the action and the senses are the network's own."""


class Trained(NamedTuple):
    """A finished network."""

    network: TemporalNetwork
    energy: NDArray[np.float64]  # (epochs,) mean energy of a step in each epoch
    errors: Array = np.zeros((0, 0))  # (N, X) of association, see ``learn_association``


Learn = Callable[[Sequence[Trajectory], int, Schedule, np.random.Generator, Tick], Trained]
"""Learns the synapses through time, of H hidden units; ticks after each epoch. The network has no association yet."""


def learned_network(
    kind: type[TemporalNetwork],
    learner: Learner,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    tick: Tick,
) -> Trained:
    """Let a learner pass over the episodes; return the network of its weights."""
    energy = practise(learner, trajectories, rng, tick)
    network = kind(
        learner.weights,
        unassociated(),
        learner.schedule.iterations,
        learner.schedule.prior_precision,
        learner.schedule.sensory_precision,
    )
    return Trained(network, energy)


def unassociated() -> Association:
    """Return an association without units."""
    shapes = association_shapes(1, 0, 0).values()
    return Association._make(np.zeros(shape, np.float32) for shape in shapes)
