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

from asm_gym.memory.energy import (
    Array,
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
    Moment,
    Schedule,
    Tick,
    Trajectory,
    coincidence,
    practise,
)
from asm_gym.memory.temporal import Step, TemporalNetwork, Trained, unassociated

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
    squares, width = np.zeros(len(DECAYS)), ordered[0].shape[1]
    traces = np.zeros((len(ordered), len(DECAYS) * width), np.float32)
    for t in range(len(ordered[0])):
        rows = np.array([episode[t] for episode in ordered if t < len(episode)], np.float32)
        traces = advance(traces[: len(rows)], rows, plain)
        squares += np.sum(
            traces.reshape(len(rows), len(DECAYS), width) ** 2, axis=(0, 2), dtype=np.float64
        )
    count = width * sum(len(episode) for episode in episodes)
    return (plain / np.maximum(np.sqrt(squares / count), FAINTEST)).astype(np.float32)


class Weights(NamedTuple):
    """The synapses of H hidden units, S senses, A motor and I = K (S + A + 1) traces; all float32."""

    W_C: Array  # (H, I) from the traces to the state
    W_F: Array  # (S + A, H) from the state to senses and action
    W_D: Array  # (S + A, I + A + 1) from the traces, the action and a constant 1 to senses and action
    gains: Array  # (K,) of the traces; not learned


def weight_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``Weights`` by name."""
    H, N, traces = hidden, sensory + motor, len(DECAYS) * (sensory + motor + 1)
    return {
        "W_C": (H, traces),
        "W_F": (N, H),
        "W_D": (N, traces + motor + 1),
        "gains": (len(DECAYS),),
    }


@lru_cache(maxsize=8)
def direct_synapses(sensory: int, motor: int) -> Array:
    """Return the mask (S + A, I + A + 1) of W_D: 0 from an action to its own prediction, else 1."""
    exists = np.ones(weight_shapes(1, sensory, motor)["W_D"], np.float32)
    exists[sensory:, exists.shape[1] - motor - 1 : -1] = 0.0
    return exists


@kernel
def expect(c: Array, W_C: Array) -> Array:
    """Return μ_t (B, H) from the traces ``c`` (B, I)."""
    return outward(c, W_C)


def direct(c: Array, u: Array, W_D: Array) -> Array:
    """Return the prediction (B, S + A) past the state, from traces ``c`` (B, I) and action and 1 ``u`` (B, A + 1)."""
    return outward(np.hstack([c, u]), W_D)


@kernel
def sense(z: Array, W_F: Array) -> Array:
    """Return what the state ``z`` (B, H) adds to it (B, S + A)."""
    return outward(activate(z), W_F)


@inner_kernel
def carry(
    c: Array,
    u: Array,
    x: Array,
    seen: Array,
    W_C: Array,
    W_F: Array,
    W_D: Array,
    gains: Array,
    pi_z: Scalar,
    pi_x: Scalar,
    curvature: Scalar,
    iterations: int,
    context: bool,
) -> tuple[Array, Array]:
    """Return f(μ_t) (B, H), 0 unless ``context`` or a sense is missing, and c_t (B, I)."""
    B, S = x.shape
    rows, whole = beside(x, u), True
    for n in range(B):
        for i in range(S):
            whole = whole and seen[n, i] != 0
    mu = np.zeros((B, W_C.shape[0]), c.dtype)
    if context or not whole:
        mu = outward(c, W_C)
    if not whole:
        past = outward(beside(c, u), W_D)  # (B, S + A)
        left, precision = np.empty_like(past), np.empty_like(past)
        for n in range(B):
            for i in range(past.shape[1]):
                left[n, i] = rows[n, i] - past[n, i]
                precision[n, i] = pi_x * seen[n, i] if i < S else pi_x
        found = sense(infer(mu, left, W_F, pi_z, precision, curvature, iterations), W_F)
        for n in range(B):
            for i in range(S):
                if seen[n, i] == 0:
                    rows[n, i] = past[n, i] + found[n, i]
    return activate(mu), advance(c, rows, gains)


class Network(TemporalNetwork):
    """The temporal network by traces; arguments as in ``TemporalNetwork``."""

    weights: Weights

    @property
    def hidden_size(self) -> int:
        return int(self.weights.W_C.shape[0])

    @property
    def motor(self) -> int:
        return int(self.weights.W_D.shape[1] - self.weights.W_C.shape[1] - 1)

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return np.zeros((batch, self.weights.W_C.shape[1]), np.float32)

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        w = self.weights
        mu, past = expect(c, w.W_C), direct(c, u, w.W_D)
        precision = self.sensory_precision * np.hstack([seen, np.ones_like(u[:, :-1])])
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        whole = np.where(seen > 0, x, (past + sense(z, w.W_F))[:, : x.shape[1]])
        return Step(mu, past + sense(mu, w.W_F), z, advance(c, np.hstack([whole, u]), w.gains))

    def run_on(self, c: Array) -> Step:
        w = self.weights
        S, A = w.W_F.shape[0] - self.motor, self.motor
        mu = expect(c, w.W_C)
        state = sense(mu, w.W_F)
        u = np.zeros((len(c), A + 1), np.float32)
        u[:, -1] = 1.0
        u[:, :A] = (direct(c, u, w.W_D) + state)[:, S:]  # no synapse leads from an action to itself
        expected = direct(c, u, w.W_D) + state
        return Step(mu, expected, mu, advance(c, np.hstack([expected[:, :S], u]), w.gains))


class HebbianChange(NamedTuple):
    """The change of each weight array: local products, averaged over a batch."""

    W_C: Array
    W_F: Array
    W_D: Array


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Return random weights of about unit gain into the state and of gain 0.1 out of it, and no direct ones."""
    shapes = weight_shapes(hidden, sensory, motor)
    W_C, W_F = (
        (gain * rng.standard_normal(shapes[name]) / np.sqrt(shapes[name][1])).astype(np.float32)
        for name, gain in (("W_C", 1.0), ("W_F", 0.1))
    )
    return Weights(W_C, W_F, np.zeros(shapes["W_D"], np.float32), np.float32(1) - DECAYS)


def hebbian_change(
    c: Array, u: Array, mu: Array, z: Array, error: Array, pi_z: float
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
    early = 0

    def __init__(self, weights: Weights, schedule: Schedule, rng: np.random.Generator) -> None:
        super().__init__(weights, HebbianChange._fields, schedule, rng)

    def at_rest(self, size: int) -> Array:
        return np.zeros((size, self.weights.W_C.shape[1]), np.float32)

    def practise(
        self,
        state: Array,
        now: Moment,
        own: NDArray[np.bool_],
        alone: NDArray[np.bool_],
        rate: float,
    ) -> tuple[Array, float]:
        w, pi_z, pi_x = self.weights, self.schedule.prior_precision, self.schedule.sensory_precision
        x, u, taken, S = now.senses, now.commands, now.commands, now.senses.shape[1]
        mu = expect(state, w.W_C)
        if own.any():
            action = (direct(state, u, w.W_D) + sense(mu, w.W_F))[:, S:]
            taken = np.hstack([np.where(own, action, u[:, :-1]), u[:, -1:]])
        past = direct(state, taken, w.W_D)
        left = np.hstack([x, u[:, :-1]]) - past  # (B, S + A)
        precision = np.full_like(left, pi_x)
        z = infer(
            mu, left, w.W_F, pi_z, precision, pi_z + pi_x * self.norm, self.schedule.iterations
        )
        error = np.float32(pi_x) * (left - sense(z, w.W_F))
        change = hebbian_change(state, taken, mu, z, error, pi_z)
        energy = 0.5 * (pi_z * float(np.sum((z - mu) ** 2)) + float(np.sum(error**2)) / pi_x)
        senses = np.where(alone, (past + sense(mu, w.W_F))[:, :S], x)
        self.learn(change, rate)
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
    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in trajectories])
    weights.W_C[:] *= np.float32(gain)
    energy = practise(
        TracesLearner(weights, schedule, rng), hidden, trajectories, schedule, rng, tick
    )
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(Network(weights, unassociated(), *how), energy)
