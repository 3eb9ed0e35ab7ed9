"""The network as a whole: two ways to expect, one memory.

time          μ_t → z_t            what is going on: a state that carries on from step to step, and infers its skill
association   a_t → Δ̂_t, σ_t       what each sense should do: from what came before and what the others do now
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import TICKS, Association, learn_association, normalised_errors
from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights, expect, infer, weight_shapes
from asm_gym.memory.learning import Schedule, Trajectory, learn, passes
from asm_gym.memory.precision import PRECISION_EPOCHS
from asm_gym.memory.scheduled_sampling import learn_scheduled
from asm_gym.scaling import ScaledRows


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Random weights of about unit gain; no biases."""
    weights = {n: np.zeros(shape, np.float32) for n, shape in weight_shapes(hidden, sensory, motor).items()}
    for name in ("W_H", "W_U", "W_F", "W_A"):
        W = weights[name]
        W[:] = rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    return Weights(**weights)


class Network:
    """Weights that no longer change, and what is needed to run them.

    Args:
        weights: the synapses through time.
        association: the synapses between senses.
        iterations: inference steps per control step.
        prior_precision: Π_z.
        sensory_precision: Π_x.
    """

    def __init__(
        self,
        weights: Weights,
        association: Association,
        iterations: int,
        prior_precision: float,
        sensory_precision: float,
    ) -> None:
        self.weights, self.association = weights, association
        self.iterations = iterations
        # Of single precision all of them, or the compiled loops would compute in double.
        self.prior_precision, self.sensory_precision = np.float32(prior_precision), np.float32(sensory_precision)
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.curvature = np.float32(prior_precision + sensory_precision * norm**2)

    def with_association(self, association: Association) -> Self:
        """The same network with other synapses between senses; this one keeps its own."""
        other = copy.copy(self)
        other.association = association
        return other

    @property
    def hidden_size(self) -> int:
        return self.weights.W_H.shape[0]

    def associate(self, reading: ScaledRows) -> tuple[Array, Array]:
        """(Δ_t - Δ̂_t)/σ_t (B, X), 0 where a row was not whole; and f(h_t) (B, M) of association."""
        error, units = normalised_errors(reading.inputs, reading.changes, reading.whole, *self.association)
        return error, units

    def follow(self, z: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        """μ_t, expected before the row was seen, and z_t, the state to carry on with; (B, H).

        Args:
            z: (B, H) the state carried so far.
            u: (B, A + 1) the action as commanded, standardised, and a constant 1.
            x: (B, S) what was sensed, standardised.
            seen: (B, S) 1 where ``x`` is a measurement, 0 where it is to be ignored.
        """
        w = self.weights
        mu = expect(z, u, w.W_H, w.W_U)
        precision = self.sensory_precision * seen
        return mu, infer(mu, x, w.W_F, w.b_F, self.prior_precision, precision, self.curvature, self.iterations)


class Trained(NamedTuple):
    """A finished network, and how its energy fell."""

    network: Network
    energy: Array  # (epochs,) mean energy of a step in each epoch


def train(
    trajectories: Sequence[Trajectory],
    groups: NDArray[np.intp],
    changes: slice,
    hidden: int,
    units: int,
    schedule: Schedule,
    rng: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
) -> Trained:
    """Learns both kinds of synapses from whole episodes.

    Args:
        groups: (X,) the group of each change.
        changes: where the changes stand among the inputs of association.
        hidden: H.
        units: hidden units of association for each group.
    """
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    total = passes(trajectories, schedule) + TICKS + PRECISION_EPOCHS
    how_to = learn_scheduled if schedule.free_running_probability > 0 else learn
    energy = how_to(weights, trajectories, schedule, rng, tick)
    inputs = np.concatenate([t.inputs for t in trajectories])
    association = learn_association(inputs, np.ascontiguousarray(inputs[:, changes]), groups, changes, units, rng, tick)
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(Network(weights, association, *how), energy)
