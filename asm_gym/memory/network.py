"""The network as a whole: predict, compare, infer; and how its weights come to be.

μ_t → x̂_t, log σ²_t (before x_t is seen) → ε_t = x_t - x̂_t → z_t
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.memory.energy import Array, activate
from asm_gym.memory.inference import Weights, expect, infer, sense, weight_shapes
from asm_gym.memory.learning import Batch, Schedule, Trajectory, batches, learn
from asm_gym.memory.precision import PRECISION_EPOCHS, RATE, learn_precision, log_variance


class Step(NamedTuple):
    """What the network made of one row of each stream in a batch."""

    hidden: Array  # (B, H) z_t, the state to carry on with
    expected: Array  # (B, H) μ_t, the state expected before the row was seen
    error: Array  # (B, X) ε_t of the prediction from μ_t; 0 where a number was not seen
    log_variance: Array  # (B, X) log σ²_t


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Random weights of about unit gain; no biases, and a precision that knows no context yet."""
    weights = {n: np.zeros(shape, np.float32) for n, shape in weight_shapes(hidden, sensory, motor).items()}
    for name in ("W_H", "W_U", "W_F", "W_A"):
        W = weights[name]
        W[:] = rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    return Weights(**weights)


class Network:
    """Weights that no longer change, and what is needed to run them.

    Args:
        weights: the synapses.
        iterations: inference steps per control step.
        prior_precision: Π_z.
        sensory_precision: Π_x.
    """

    def __init__(self, weights: Weights, iterations: int, prior_precision: float, sensory_precision: float) -> None:
        self.weights = weights
        self.iterations = iterations
        self.prior_precision = float(prior_precision)
        self.sensory_precision = np.float32(sensory_precision)
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.curvature = self.prior_precision + float(sensory_precision) * norm**2

    @property
    def hidden_size(self) -> int:
        return self.weights.W_H.shape[0]

    def step(self, z: Array, u: Array, x: Array, seen: Array) -> Step:
        """One control step.

        Args:
            z: (B, H) the state carried so far.
            u: (B, A + 1) the action as commanded, standardised, and a constant 1.
            x: (B, X) what was sensed, standardised.
            seen: (B, X) 1 where ``x`` is a measurement, 0 where it is to be ignored.
        """
        w = self.weights
        mu = expect(z, u, w.W_H, w.W_U)
        error = (x - sense(mu, w.W_F, w.b_F)) * seen
        precision = self.sensory_precision * seen
        hidden = infer(mu, x, w.W_F, w.b_F, self.prior_precision, precision, self.curvature, self.iterations)
        return Step(hidden, mu, error, log_variance(activate(mu), w.W_S, w.b_S))

    def run(self, batch: Batch) -> Iterator[Step]:
        """The steps of whole episodes, from the state zero on."""
        z = np.zeros((batch.senses.shape[1], self.hidden_size), np.float32)
        for x, u, n in zip(batch.senses, batch.commands, batch.active, strict=True):
            step = self.step(z[:n], u[:n], x[:n], np.ones_like(x[:n]))
            yield step
            z = step.hidden


class Trained(NamedTuple):
    """A finished network and what it left unexplained."""

    network: Network
    energy: Array  # (epochs,) mean energy of a step in each epoch
    normalised_errors: Array  # (N, X) ε/σ over all training steps


def train(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
) -> Trained:
    """Learns weights from whole episodes, then the precision from the errors the finished weights make."""
    done, total = 0, schedule.epochs + PRECISION_EPOCHS

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    energy = learn(weights, trajectories, schedule, rng, tick)
    network = Network(weights, schedule.iterations, schedule.prior_precision, schedule.sensory_precision)
    steps = [s for batch in batches(trajectories, schedule.batch_size, rng) for s in network.run(batch)]
    context = activate(np.concatenate([s.expected for s in steps]))  # (N, H)
    error = np.concatenate([s.error for s in steps])  # (N, X)
    learn_precision(context, error, weights.W_S, weights.b_S, RATE, rng, tick)
    normalised = error * np.exp(-0.5 * log_variance(context, weights.W_S, weights.b_S))
    return Trained(network, energy, normalised)
