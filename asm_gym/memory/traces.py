"""The temporal network by traces: the past is carried as traces of what was sensed and done.

    c^k_t = λ_k c^k_{t-1} + g_k r_t                  r_t = [x_t, a_t, 1], standardised;  c_0 = 0
    μ_t = W_C c_{t-1}                                expected state; z_t is inferred from it (``energy``)
    [x̂_t, â_t] = W_F f(z_t) + W_D [c_{t-1}, a_t, 1]  prediction from a state; â has no synapse from the action itself
    ΔW_C ∝ Π_z ε_z c_{t-1}ᵀ    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_D ∝ Π_x ε_x [c_{t-1}, a_t, 1]ᵀ
    ε_z = z_t - μ_t    ε_x = [x_t, a_t] - [x̂_t, â_t]

g gives all traces the same mean square. A trace has no learned weight, so no error travels back through time. For Π_z
large against Π_x, ε_z is the error that backpropagation would send to the state (Whittington and Bogacz 2017).

Sources: de Vries and Principe 1992 (Neural Networks 5(4)) and Shankar and Howard 2012 (Neural Computation 24(1)) for
the traces; Millidge et al. 2024 (PLOS Comput Biol) for inference and learning.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.carried_readout import (
    CarriedNetwork,
    Readout,
    direct,
    fill_missing,
    sense,
)
from asm_gym.memory.energy import (
    Array,
    Inference,
    Scalar,
    activate,
    beside,
    infer,
    inner_kernel,
    kernel,
    outward,
)
from asm_gym.memory.learning import (
    Learner,
    Schedule,
    Tick,
    Trajectory,
    Turn,
    coincidence,
)
from asm_gym.memory.temporal import Trained, learned_network
from asm_gym.scaling import ScaledRows

DECAYS = np.array([0.0, 0.5, 0.75, 0.875, 0.9375, 0.97, 0.985, 0.995], np.float32)  # λ (K,)
FAINTEST = 1e-3  # smallest root mean square of a trace that is scaled


@kernel
def advance(traces: Array, rows: Array, gains: Array) -> Array:
    """Return c_t (B, K R) from c_{t-1} and the rows r_t (B, R)."""
    B, R = rows.shape
    out = np.empty_like(traces)
    for n in range(B):
        for k in range(len(gains)):
            for i in range(R):
                out[n, k * R + i] = DECAYS[k] * traces[n, k * R + i] + gains[k] * rows[n, i]
    return out


def fit_gains(episodes: Sequence[Array]) -> NDArray[np.float32]:
    """Return g (K,) that give each trace of these episodes (T, R) a mean square of 1."""
    plain = np.float32(1) - DECAYS
    ordered = sorted(episodes, key=len, reverse=True)
    width = ordered[0].shape[1]
    squares = np.zeros(len(DECAYS))
    traces = np.zeros((len(ordered), len(DECAYS) * width), np.float32)
    for t in range(len(ordered[0])):
        rows = np.array([episode[t] for episode in ordered if t < len(episode)], np.float32)
        traces = advance(traces[: len(rows)], rows, plain)
        by_decay = traces.reshape(len(rows), len(DECAYS), width)
        squares += np.sum(by_decay**2, axis=(0, 2), dtype=np.float64)
    count = width * sum(map(len, episodes))
    return (plain / np.maximum(np.sqrt(squares / count), FAINTEST)).astype(np.float32)


class Weights(NamedTuple):
    """The synapses of H hidden units, S senses, A motor and I = K (S + A + 1) traces.

    All are float32.
    """

    W_C: Array  # (H, I) from the traces to the state
    W_F: Array  # (S + A, H) from the state to senses and action
    W_D: Array  # (S + A, I + A + 1) from traces, action and a constant 1 to senses and action
    gains: Array  # (K,) of the traces; not learned


def weight_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``Weights`` by name."""
    predicted = sensory + motor
    traces = len(DECAYS) * (predicted + 1)
    return {
        "W_C": (hidden, traces),
        "W_F": (predicted, hidden),
        "W_D": (predicted, traces + motor + 1),
        "gains": (len(DECAYS),),
    }


@lru_cache(maxsize=8)
def direct_synapses(sensory: int, motor: int) -> Array:
    """Return the mask (S + A, I + A + 1) of W_D: 0 from an action to its own prediction, else 1."""
    exists = np.ones(weight_shapes(1, sensory, motor)["W_D"], np.float32)
    exists[sensory:, exists.shape[1] - motor - 1 : -1] = 0.0
    return exists


@inner_kernel
def carry(
    c: Array, rows: ScaledRows, weights: Weights, inference: Inference, wants_context: bool
) -> tuple[Array, Array]:
    """Return f(μ_t) (B, H), 0 unless wanted or a sense is missing, and c_t (B, I), after the next rows of B streams."""
    sensed = beside(rows.senses, rows.commands)
    whole = rows.seen.all()
    mu = np.zeros((c.shape[0], weights.W_C.shape[0]), c.dtype)
    if wants_context or not whole:
        mu = outward(c, weights.W_C)
    if not whole:
        fill_missing(sensed, c, mu, rows, Readout(weights.W_F, weights.W_D), inference)
    return activate(mu), advance(c, sensed, weights.gains)


class Network(CarriedNetwork):
    """The temporal network by traces; arguments as in ``TemporalNetwork``."""

    weights: Weights

    def advance(self, m: Array, rows: Array) -> Array:
        return advance(m, rows, self.weights.gains)


class HebbianChange(NamedTuple):
    """The change of each weight array: local products, averaged over a batch."""

    W_C: Array
    W_F: Array
    W_D: Array


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Return random weights of about unit gain into the state and of gain 0.1 out of it, and no direct ones."""
    shapes = weight_shapes(hidden, sensory, motor)
    return Weights(
        W_C=_random(shapes["W_C"], 1.0, rng),
        W_F=_random(shapes["W_F"], 0.1, rng),
        W_D=np.zeros(shapes["W_D"], np.float32),
        gains=np.float32(1) - DECAYS,
    )


def _random(shape: tuple[int, ...], gain: float, rng: np.random.Generator) -> Array:
    return (gain * rng.standard_normal(shape) / np.sqrt(shape[1])).astype(np.float32)


def hebbian_change(
    c: Array, u: Array, mu: Array, z: Array, error: Array, pi_z: Scalar
) -> HebbianChange:
    """Apply the local learning rules to traces (B, I), action and 1 (B, A + 1), μ and z (B, H), and Π_x ε_x at z."""
    motor = u.shape[1] - 1
    return HebbianChange(
        W_C=coincidence(np.float32(pi_z) * (z - mu), c),
        W_F=coincidence(error, activate(z)),
        W_D=coincidence(error, np.hstack([c, u])) * direct_synapses(error.shape[1] - motor, motor),
    )


class TracesLearner(Learner):
    """The network by traces as it learns."""

    weights: Weights
    learned = HebbianChange._fields
    early = False
    scalar = float

    def at_rest(self, size: int) -> Array:
        return np.zeros((size, self.weights.W_C.shape[1]), np.float32)

    def practise(self, state: Array, turn: Turn, rate: float) -> tuple[Array, float]:
        w = self.weights
        inference = self.inference
        pi_z = inference.prior_precision
        pi_x = inference.sensory_precision
        sensory = turn.senses.shape[1]
        mu = outward(state, w.W_C)
        taken = turn.commands
        if turn.own.any():
            expected = direct(state, turn.commands, w.W_D) + sense(mu, w.W_F)
            taken = turn.commands_with(expected[:, sensory:])

        past = direct(state, taken, w.W_D)
        left = np.hstack([turn.senses, turn.commands[:, :-1]]) - past  # (B, S + A)
        z = infer(mu, left, w.W_F, np.full_like(left, pi_x), inference)
        error = np.float32(pi_x) * (left - sense(z, w.W_F))
        of_state = float(np.sum((z - mu) ** 2))
        energy = 0.5 * float(pi_z * of_state + float(np.sum(error**2)) / pi_x)
        expected = past + sense(mu, w.W_F)
        senses = np.where(turn.alone, expected[:, :sensory], turn.senses)
        self.learn(hebbian_change(state, taken, mu, z, error, pi_z), rate)
        return advance(state, np.hstack([senses, taken]), w.gains), energy


def learn_traces(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
    gain: float = 1.0,
) -> Trained:
    """Learn the synapses through time; see ``temporal.Learn``. ``gain`` scales the initial weights onto the state."""
    sensory = trajectories[0].senses.shape[1]
    motor = trajectories[0].commands.shape[1] - 1
    weights = initial_weights(hidden, sensory, motor, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in trajectories])
    weights.W_C[:] *= np.float32(gain)
    learner = TracesLearner(weights, schedule, rng)
    return learned_network(Network, learner, trajectories, rng, tick)
