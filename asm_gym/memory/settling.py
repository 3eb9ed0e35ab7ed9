"""The temporal predictive coding network of the papers: its state is carried on, and is inferred on every row.

    μ_t = W_H f(z_{t-1}) + W_U [a_t, 1]                              state expected for the commanded action
    h_t = W_H f(z_{t-1}) + W_U [0, 1],   â_t = W_A f(h_t)            action that belongs to the state
    F = ½ Π_z ‖z - μ_t‖² + ½ Π_x ‖x_t - W_F f(z) - b_F‖² + ½ ‖a_t - â_t‖²      z_t is where inference from μ_t ends
    ΔW_H ∝ (Π_z ε_z + ε_h) f(z_{t-1})ᵀ    ΔW_U ∝ Π_z ε_z [a_t, 1]ᵀ + ε_h [0, 1]ᵀ    ε_h = f'(h_t) ⊙ W_Aᵀ ε_a
    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_A ∝ ε_a f(h_t)ᵀ

Each change is -∂F/∂W at the inferred state. The past is in z alone, and an error teaches one step back and no further.
W_H begins near the identity, so that units keep what is long past. A stream that runs on alone hands on μ_t in place of
z_t, and takes its own action.

Sources: Millidge et al. 2024 (PLOS Comput Biol) and Tang et al. 2023 (NeurIPS); Mahajan et al. 2025 (Neural
Computation 38(1)) for the motor prediction; Le et al. 2015 (arXiv 1504.00941) for beginning at the identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, Inference, activate, infer, inner_kernel, outward
from asm_gym.memory.learning import (
    Learner,
    Schedule,
    Tick,
    Trajectory,
    Turn,
    coincidence,
)
from asm_gym.memory.temporal import Step, TemporalNetwork, Trained, learned_network
from asm_gym.scaling import ScaledRows

LEAST = 0.9  # smallest initial weight of a unit on its own last state
FAINT = 0.1  # gain of the initial weights from all other units


class SettlingWeights(NamedTuple):
    """The synapses of H hidden units, S senses and A motor; all float32."""

    W_H: Array  # (H, H) from the last state to the next
    W_U: Array  # (H, A + 1) from the commanded action and a constant 1 to the state
    W_F: Array  # (S, H) from the state to the senses
    b_F: Array  # noqa: N815 (S,)
    W_A: Array  # (A, H) from the state to the action


def settling_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``SettlingWeights`` by name."""
    return {
        "W_H": (hidden, hidden),
        "W_U": (hidden, motor + 1),
        "W_F": (sensory, hidden),
        "b_F": (sensory,),
        "W_A": (motor, hidden),
    }


@inner_kernel
def settle(
    z: Array, rows: ScaledRows, weights: SettlingWeights, inference: Inference
) -> tuple[Array, Array]:
    """Return f(μ_t) (B, H) and z_t (B, H) from the states before (B, H) and the next rows of B streams."""
    mu = outward(activate(z), weights.W_H)
    driven = outward(rows.commands, weights.W_U)
    left = np.empty_like(rows.senses)
    precision = np.empty_like(rows.senses)
    for n in range(mu.shape[0]):
        for i in range(mu.shape[1]):
            mu[n, i] += driven[n, i]
        for i in range(left.shape[1]):
            left[n, i] = rows.senses[n, i] - weights.b_F[i]
            precision[n, i] = inference.sensory_precision * rows.seen[n, i]
    return activate(mu), infer(mu, left, weights.W_F, precision, inference)


class SettlingNetwork(TemporalNetwork):
    """The network whose state is carried on; arguments as in ``TemporalNetwork``."""

    weights: SettlingWeights

    @property
    def hidden_size(self) -> int:
        return int(self.weights.W_H.shape[0])

    @property
    def motor(self) -> int:
        return int(self.weights.W_A.shape[0])

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return np.zeros((batch, self.hidden_size), np.float32)

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        w = self.weights
        carried = carry_over(w, c)
        mu = carried.state + outward(u, w.W_U)
        precision = self.inference.sensory_precision * seen
        z = infer(mu, x - w.b_F, w.W_F, precision, self.inference)
        inferred = outward(activate(z), w.W_F) + w.b_F
        senses = np.where(seen > 0, x, inferred)
        return Step(mu, self._expected(mu, carried), z, z, senses)

    def run_on(self, c: Array) -> Step:
        carried = carry_over(self.weights, c)
        u = np.hstack([carried.action, np.ones((len(c), 1), c.dtype)])
        mu = carried.state + outward(u, self.weights.W_U)
        expected = self._expected(mu, carried)
        return Step(mu, expected, mu, mu, expected[:, : len(self.weights.b_F)])

    def _expected(self, mu: Array, carried: Carried) -> Array:
        """Return x̂ and â (B, S + A)."""
        senses = outward(activate(mu), self.weights.W_F) + self.weights.b_F
        return np.hstack([senses, carried.action])


class Carried(NamedTuple):
    """What follows from the state before, whatever is commanded."""

    state: Array  # (B, H) W_H f(z_{t-1})
    h: Array  # (B, H) the state of no action
    action: Array  # (B, A) â


def carry_over(weights: SettlingWeights, z: Array) -> Carried:
    """Return what follows from the states ``z`` (B, H)."""
    state = outward(activate(z), weights.W_H)
    h = state + weights.W_U[:, -1]
    return Carried(state, h, outward(activate(h), weights.W_A))


def initial_settling_weights(
    hidden: int, sensory: int, motor: int, rng: np.random.Generator, least: float = LEAST
) -> SettlingWeights:
    """Return random weights of about unit gain, W_H near the identity, with ``least`` to 1 on its diagonal."""
    weights = SettlingWeights._make(
        np.zeros(shape, np.float32) for shape in settling_shapes(hidden, sensory, motor).values()
    )
    for W in (weights.W_H, weights.W_U, weights.W_F, weights.W_A):
        W[:] = rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    own = np.linspace(least, 1.0, hidden, dtype=np.float32)
    weights.W_H[:] = FAINT * weights.W_H + np.diag(own)
    return weights


class SettlingErrors(NamedTuple):
    """Errors of a row at the inferred state."""

    state: Array  # (B, H) Π_z ε_z
    senses: Array  # (B, S) Π_x ε_x
    action: Array  # (B, A) ε_a


def settling_change(
    before: Array, u: Array, h: Array, errors: SettlingErrors, z: Array, W_A: Array
) -> SettlingWeights:
    """Return the change of each array: local products, averaged over the batch.

    ``before``, ``h`` and ``z`` (B, H) are the state before, that of the motor prediction, and the inferred one; ``u``
    (B, A + 1) is the action of μ and 1.
    """
    f = activate(h)
    motor = (np.float32(1) - f * f) * (errors.action @ W_A)  # (B, H) ε_h
    W_U = coincidence(errors.state, u)
    W_U[:, -1] += motor.mean(axis=0)
    return SettlingWeights(
        W_H=coincidence(errors.state + motor, activate(before)),
        W_U=W_U,
        W_F=coincidence(errors.senses, activate(z)),
        b_F=errors.senses.mean(axis=0),
        W_A=coincidence(errors.action, f),
    )


class SettlingLearner(Learner):
    """The settling network as it learns."""

    weights: SettlingWeights
    learned = SettlingWeights._fields
    early = True

    def at_rest(self, size: int) -> Array:
        return np.zeros((size, len(self.weights.W_H)), np.float32)

    def practise(self, state: Array, turn: Turn, rate: float) -> tuple[Array, float]:
        w = self.weights
        inference = self.inference
        pi_z = inference.prior_precision
        pi_x = inference.sensory_precision
        carried = carry_over(w, state)
        taken = turn.commands
        if turn.own.any():
            taken = turn.commands_with(carried.action)
        mu = carried.state + outward(taken, w.W_U)
        left = turn.senses - w.b_F
        z = infer(mu, left, w.W_F, np.full_like(left, pi_x), inference)

        of_state = z - mu
        of_senses = left - outward(activate(z), w.W_F)
        of_action = turn.commands[:, :-1] - carried.action
        energy = 0.5 * float(
            pi_z * np.sum(of_state**2) + pi_x * np.sum(of_senses**2) + np.sum(of_action**2)
        )
        errors = SettlingErrors(pi_z * of_state, pi_x * of_senses, of_action)
        self.learn(settling_change(state, taken, carried.h, errors, z, w.W_A), rate)
        return np.where(turn.alone, mu, z), energy


def learn_settling(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
) -> Trained:
    """Learn the synapses through time; see ``temporal.Learn``."""
    # A network that runs on alone must keep its state; one that reads hundreds of rows would drift
    # if it kept all.
    least = LEAST
    if schedule.free_running_probability > 0:
        least = 1.0
    sensory = trajectories[0].senses.shape[1]
    motor = trajectories[0].commands.shape[1] - 1
    weights = initial_settling_weights(hidden, sensory, motor, rng, least)
    learner = SettlingLearner(weights, schedule, rng)
    return learned_network(SettlingNetwork, learner, trajectories, rng, tick)
