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

from asm_gym.memory.energy import Array, Scalar, activate, infer, inner_kernel, outward
from asm_gym.memory.learning import (
    Learner,
    Moment,
    Schedule,
    Tick,
    Trajectory,
    coincidence,
    practise,
)
from asm_gym.memory.temporal import Step, TemporalNetwork, Trained, unassociated

# smallest initial weight of a unit on its own last state, and the gain from all others
LEAST, FAINT = (
    0.9,
    0.1,
)


class SettlingWeights(NamedTuple):
    """The synapses of H hidden units, S senses and A motor; all float32."""

    W_H: Array  # (H, H) from the last state to the next
    W_U: Array  # (H, A + 1) from the commanded action and a constant 1 to the state
    W_F: Array  # (S, H) from the state to the senses
    b_F: Array  # noqa: N815 (S,)
    W_A: Array  # (A, H) from the state to the action


def settling_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``SettlingWeights`` by name."""
    H, S, A = hidden, sensory, motor
    return {"W_H": (H, H), "W_U": (H, A + 1), "W_F": (S, H), "b_F": (S,), "W_A": (A, H)}


@inner_kernel
def settle(
    z: Array,
    u: Array,
    x: Array,
    seen: Array,
    W_H: Array,
    W_U: Array,
    W_F: Array,
    b_F: Array,
    pi_z: Scalar,
    pi_x: Scalar,
    curvature: Scalar,
    iterations: int,
) -> tuple[Array, Array]:
    """Return f(μ_t) (B, H) and z_t (B, H) from the state before, the action and 1 (B, A + 1), and the senses (B, S)."""
    mu, driven = outward(activate(z), W_H), outward(u, W_U)
    left, precision = np.empty_like(x), np.empty_like(x)
    for n in range(x.shape[0]):
        for i in range(mu.shape[1]):
            mu[n, i] += driven[n, i]
        for i in range(x.shape[1]):
            left[n, i], precision[n, i] = x[n, i] - b_F[i], pi_x * seen[n, i]
    return activate(mu), infer(mu, left, W_F, pi_z, precision, curvature, iterations)


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
        w, precision = self.weights, self.sensory_precision * seen
        mu, action = self._expected(c, u)
        z = infer(
            mu, x - w.b_F, w.W_F, self.prior_precision, precision, self.curvature, self.iterations
        )
        return Step(mu, np.hstack([self._sense(mu), action]), z, z)

    def run_on(self, c: Array) -> Step:
        u = np.zeros((len(c), self.motor + 1), c.dtype)
        u[:, -1] = 1.0
        _, u[:, :-1] = self._expected(c, u)
        mu, action = self._expected(c, u)
        return Step(mu, np.hstack([self._sense(mu), action]), mu, mu)

    def _sense(self, z: Array) -> Array:
        """Return x̂ (B, S)."""
        return outward(activate(z), self.weights.W_F) + self.weights.b_F

    def _expected(self, z: Array, u: Array) -> tuple[Array, Array]:
        """Return μ_t (B, H), and â_t (B, A), which does not depend on the action."""
        w = self.weights
        carried = outward(activate(z), w.W_H)
        return carried + outward(u, w.W_U), outward(activate(carried + w.W_U[:, -1]), w.W_A)


def initial_settling_weights(
    hidden: int, sensory: int, motor: int, rng: np.random.Generator, least: float = LEAST
) -> SettlingWeights:
    """Return random weights of about unit gain, W_H near the identity, with ``least`` to 1 on its diagonal."""
    weights = {
        n: np.zeros(shape, np.float32)
        for n, shape in settling_shapes(hidden, sensory, motor).items()
    }
    for name in ("W_H", "W_U", "W_F", "W_A"):
        W = weights[name]
        W[:] = rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    weights["W_H"][:] = FAINT * weights["W_H"] + np.diag(
        np.linspace(least, 1.0, hidden, dtype=np.float32)
    )
    return SettlingWeights(**weights)


def settling_change(
    before: Array, u: Array, h: Array, errors: tuple[Array, Array, Array], z: Array, W_A: Array
) -> SettlingWeights:
    """Return the change of each array: local products, averaged over the batch.

    ``before``, ``h`` and ``z`` (B, H) are the state before, that of the motor prediction, and the inferred one; ``u``
    (B, A + 1) is the action of μ and 1; ``errors`` are Π_z ε_z (B, H), Π_x ε_x (B, S) at ``z``, and ε_a (B, A).
    """
    state, senses, action = errors
    f = activate(h)
    motor = (np.float32(1) - f * f) * (action @ W_A)  # (B, H) ε_h
    W_U = coincidence(state, u)
    W_U[:, -1] += motor.mean(axis=0)
    return SettlingWeights(
        W_H=coincidence(state + motor, activate(before)),
        W_U=W_U,
        W_F=coincidence(senses, activate(z)),
        b_F=senses.mean(axis=0),
        W_A=coincidence(action, f),
    )


class SettlingLearner(Learner):
    """The settling network as it learns."""

    weights: SettlingWeights
    early = 1

    def __init__(
        self, weights: SettlingWeights, schedule: Schedule, rng: np.random.Generator
    ) -> None:
        super().__init__(weights, SettlingWeights._fields, schedule, rng)

    def at_rest(self, size: int) -> Array:
        return np.zeros((size, len(self.weights.W_H)), np.float32)

    def practise(
        self,
        state: Array,
        now: Moment,
        own: NDArray[np.bool_],
        alone: NDArray[np.bool_],
        rate: float,
    ) -> tuple[Array, float]:
        w, how, x, u, taken = self.weights, self.schedule, now.senses, now.commands, now.commands
        pi_z, pi_x = np.float32(how.prior_precision), np.float32(how.sensory_precision)
        carried = outward(activate(state), w.W_H)
        h = carried + w.W_U[:, -1]
        if own.any():
            taken = np.hstack([np.where(own, outward(activate(h), w.W_A), u[:, :-1]), u[:, -1:]])
        mu, left, curvature = (
            carried + outward(taken, w.W_U),
            x - w.b_F,
            np.float32(pi_z + pi_x * self.norm),
        )
        z = infer(mu, left, w.W_F, pi_z, np.full_like(x, pi_x), curvature, how.iterations)
        of_state, of_senses = z - mu, left - outward(activate(z), w.W_F)
        of_action = np.ascontiguousarray(u[:, :-1]) - outward(activate(h), w.W_A)
        energy = 0.5 * float(
            pi_z * np.sum(of_state**2) + pi_x * np.sum(of_senses**2) + np.sum(of_action**2)
        )
        errors = pi_z * of_state, pi_x * of_senses, of_action
        self.learn(settling_change(state, taken, h, errors, z, w.W_A), rate)
        return np.where(alone, mu, z), energy


def learn_settling(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
) -> Trained:
    """Learn the synapses through time; see ``temporal.Learn``."""
    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    # A network that runs on alone must keep its state; one that reads hundreds of rows would drift if it kept all.
    least = 1.0 if schedule.free_running_probability > 0 else LEAST
    weights = initial_settling_weights(hidden, sensory, commands - 1, rng, least)
    energy = practise(
        SettlingLearner(weights, schedule, rng), hidden, trajectories, schedule, rng, tick
    )
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(SettlingNetwork(weights, unassociated(), *how), energy)
