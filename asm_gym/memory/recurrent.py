"""The temporal network by recurrent units: each remembers by itself, for a time and at a frequency of its own.

    c_t = λ ⊙ c_{t-1} + γ ⊙ B r_t                    λ = exp(-e^ν + iθ), complex; r_t = [x_t, a_t, 1], standardised
    m_t = [Re c_t, Im c_t, r_t]                      what is carried on; m_0 = 0
    μ_t = W_C m_{t-1}                                expected state; z_t is inferred from it (``energy``)
    [x̂_t, â_t] = W_F f(z_t) + W_D [m_{t-1}, a_t, 1]  prediction from a state; â has no synapse from the action itself

γ scales each unit to a mean square of about 1 and is not learned. Senses that are *felt*, such as forces, reach no unit
and no prediction but their own: what they tell of a touch must not move what acts. What is missing from a row is
inferred from the rest of it. ``recurrent_learning`` has the rules of learning.

Sources: Orvieto et al. 2023 (ICML) for the recurrence; Millidge et al. 2024 (PLOS Comput Biol) for inference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import (
    Array,
    Inference,
    activate,
    beside,
    infer,
    inner_kernel,
    kernel,
    outward,
)
from asm_gym.memory.temporal import Step, TemporalNetwork
from asm_gym.scaling import ScaledRows

UNITS_PER_HIDDEN = 3 / 8  # recurrent units for each hidden unit


class RecurrentWeights(NamedTuple):
    """The synapses of N recurrent and H hidden units, S senses and A motor; R = S + A + 1, I = 2 N + R.

    All are float32.
    """

    decay: Array  # (N,) ν
    turn: Array  # (N,) θ [rad a row]
    gain: Array  # (N,) γ; not learned
    reads: Array  # (R,) 0 where a number of the row is felt, else 1; not learned
    B_re: Array
    B_im: Array
    W_C: Array  # (H, I) from what is carried on to the state
    W_F: Array  # (S + A, H) from the state to senses and action
    W_D: Array  # (S + A, I + A + 1) from what is carried on, action and 1 to senses and action


def recurrent_units(hidden: int) -> int:
    """Return N for H hidden units."""
    return max(1, round(UNITS_PER_HIDDEN * hidden))


def recurrent_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``RecurrentWeights`` by name."""
    predicted = sensory + motor
    row = predicted + 1
    units = recurrent_units(hidden)
    carried = 2 * units + row
    return {
        "decay": (units,),
        "turn": (units,),
        "gain": (units,),
        "reads": (row,),
        "B_re": (units, row),
        "B_im": (units, row),
        "W_C": (hidden, carried),
        "W_F": (predicted, hidden),
        "W_D": (predicted, carried + motor + 1),
    }


@inner_kernel
def multiplier(weights: RecurrentWeights, i: int) -> tuple[float, float]:
    """Return the real and the imaginary part of λ of unit i."""
    size = np.exp(-np.exp(weights.decay[i]))
    return size * np.cos(weights.turn[i]), size * np.sin(weights.turn[i])


@kernel
def advance(m: Array, rows: Array, weights: RecurrentWeights) -> Array:
    """Return m_t (B, I) from m_{t-1} and the rows r_t (B, R)."""
    N = len(weights.decay)
    read = rows * weights.reads
    drive_re = outward(read, weights.B_re)
    drive_im = outward(read, weights.B_im)
    out = np.empty_like(m)
    for i in range(N):
        re, im = multiplier(weights, i)
        gain = weights.gain[i]
        for n in range(m.shape[0]):
            c_re = m[n, i]
            c_im = m[n, N + i]
            out[n, i] = re * c_re - im * c_im + gain * drive_re[n, i]
            out[n, N + i] = re * c_im + im * c_re + gain * drive_im[n, i]
    for n in range(m.shape[0]):
        for j in range(rows.shape[1]):
            out[n, 2 * N + j] = rows[n, j]
    return out


def direct(m: Array, u: Array, W_D: Array) -> Array:
    """Return the prediction (B, S + A) past the state, from ``m`` (B, I) and action and 1 ``u`` (B, A + 1)."""
    return outward(np.hstack([m, u]), W_D)


@kernel
def sense(z: Array, W_F: Array) -> Array:
    """Return what the state ``z`` (B, H) adds to it (B, S + A)."""
    return outward(activate(z), W_F)


@inner_kernel
def fill_missing(
    sensed: Array,
    m: Array,
    mu: Array,
    rows: ScaledRows,
    weights: RecurrentWeights,
    inference: Inference,
) -> None:
    """Write what is inferred of missing senses into ``sensed`` (B, S + A + 1), from m (B, I) and μ (B, H)."""
    S = rows.senses.shape[1]
    past = outward(beside(m, rows.commands), weights.W_D)  # (B, S + A)
    left = np.empty_like(past)
    precision = np.empty_like(past)
    for n in range(past.shape[0]):
        for i in range(past.shape[1]):
            left[n, i] = sensed[n, i] - past[n, i]
            precision[n, i] = inference.sensory_precision
            if i < S:
                precision[n, i] *= rows.seen[n, i]

    state = sense(infer(mu, left, weights.W_F, precision, inference), weights.W_F)
    for n in range(past.shape[0]):
        for i in range(S):
            if rows.seen[n, i] == 0:
                sensed[n, i] = past[n, i] + state[n, i]


@inner_kernel
def remember(
    m: Array, rows: ScaledRows, weights: RecurrentWeights, inference: Inference, wants_context: bool
) -> tuple[Array, Array]:
    """Return f(μ_t) (B, H), 0 unless wanted or a sense is missing, and m_t (B, I), after the next rows of B streams."""
    sensed = beside(rows.senses, rows.commands)
    whole = rows.seen.all()
    mu = np.zeros((m.shape[0], weights.W_C.shape[0]), m.dtype)
    if wants_context or not whole:
        mu = outward(m, weights.W_C)
    if not whole:
        fill_missing(sensed, m, mu, rows, weights, inference)
    return activate(mu), advance(m, sensed, weights)


class RecurrentNetwork(TemporalNetwork):
    """The network of recurrent units; arguments as in ``TemporalNetwork``."""

    weights: RecurrentWeights

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
        mu = outward(c, w.W_C)
        past = direct(c, u, w.W_D)
        action = u[:, :-1]
        precision = self.inference.sensory_precision * np.hstack([seen, np.ones_like(action)])
        z = infer(mu, np.hstack([x, action]) - past, w.W_F, precision, self.inference)
        inferred = past + sense(z, w.W_F)
        senses = np.where(seen > 0, x, inferred[:, : x.shape[1]])
        carried = advance(c, np.hstack([senses, u]), w)
        return Step(mu, past + sense(mu, w.W_F), z, carried, senses)

    def run_on(self, c: Array) -> Step:
        w = self.weights
        sensory = w.W_F.shape[0] - self.motor
        mu = outward(c, w.W_C)
        state = sense(mu, w.W_F)
        u = np.zeros((len(c), self.motor + 1), np.float32)
        u[:, -1] = 1.0
        # No synapse leads from an action to itself.
        u[:, :-1] = (direct(c, u, w.W_D) + state)[:, sensory:]
        expected = direct(c, u, w.W_D) + state
        senses = expected[:, :sensory]
        carried = advance(c, np.hstack([senses, u]), w)
        return Step(mu, expected, mu, carried, senses)
