"""Inference of the state, and the synapses of the network by traces.

    μ_t = W_C c_{t-1}                                expected state; c are traces of the senses and the actions
    [x̂_t, â_t] = W_F f(z_t) + W_D [c_{t-1}, a_t, 1]  prediction from a state; â has no synapse from the action itself
    z ← z - η ∂F/∂z,  η = 1.5 / (Π_z + Π_x‖W_F‖² + max|f''| ‖W_Fᵀ Π_x ε_x‖_∞)

Inference begins at μ. The bracket bounds the largest curvature of F, so that a step shorter than 2 over it cannot raise
F, however large W_F grows.

Sources: Millidge et al. 2024 (PLOS Comput Biol); Tang et al. 2023 (NeurIPS). Their networks carry the state itself, as
``settling`` does; this one carries traces, which need no gradient through time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asm_gym.memory.energy import Array, Scalar, activate, energy_gradient, kernel, outward
from asm_gym.memory.traces import DECAYS, advance
from asm_gym.validation import check_number

STRIDE = np.float32(1.5)
"""Length of an inference step times the curvature; inference diverges from 2 on."""

STILL = np.float32(1e-8)
"""Inference ends when no unit moves further than this in a step."""


class Weights(NamedTuple):
    """The synapses of H hidden units, S senses, A motor and I = K (S + A + 1) traces; all float32."""

    W_C: Array  # (H, I) from the traces to the state
    W_F: Array  # (S + A, H) from the state to senses and action
    W_D: Array  # (S + A, I + A + 1) from the traces, the action and a constant 1 to senses and action
    gains: Array  # (K,) of the traces; not learned


def weight_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``Weights`` by name."""
    H, N, traces = hidden, sensory + motor, len(DECAYS) * (sensory + motor + 1)
    return {"W_C": (H, traces), "W_F": (N, H), "W_D": (N, traces + motor + 1), "gains": (len(DECAYS),)}


def direct_synapses(sensory: int, motor: int) -> Array:
    """Return the mask (S + A, I + A + 1) of W_D: 0 from an action to its own prediction, else 1."""
    exists = np.ones(weight_shapes(1, sensory, motor)["W_D"], np.float32)
    exists[sensory:, exists.shape[1] - motor - 1 : -1] = 0.0
    return exists


def iterations_within(budget: float, dt: float) -> int:
    """Return the inference steps for each row.

    Args:
        budget: inference steps a second.
        dt: seconds between rows.

    Raises:
        ValueError: the budget is less than one step for each row.
    """
    each = check_number("budget", budget, above=0.0) * dt
    if each < 1.0 - 1e-9:
        rows = f"{1 / dt:.4g} rows a second"
        raise ValueError(f"a budget of {budget:g} steps of inference a second is less than one for each of {rows}")
    return int(each + 1e-9)


@kernel
def expect(c: Array, W_C: Array) -> Array:
    """Return μ_t (B, H) from the traces ``c`` (B, I)."""
    return outward(c, W_C)


def direct(c: Array, u: Array, W_D: Array) -> Array:
    """Return the prediction (B, S + A) past the state, from traces ``c`` (B, I) and action and 1 ``u`` (B, A + 1)."""
    found: Array = outward(np.hstack([c, u]), W_D)
    return found


@kernel
def sense(z: Array, W_F: Array) -> Array:
    """Return what the state ``z`` (B, H) adds to it (B, S + A)."""
    return outward(activate(z), W_F)


@kernel
def infer(mu: Array, x: Array, W_F: Array, pi_z: Scalar, pi_x: Array, curvature: Scalar, iterations: int) -> Array:
    """Return z_t (B, H) after steps down the energy from ``mu``; arguments as in ``energy_gradient``.

    Args:
        curvature: Π_z + max Π_x ‖W_F‖², spectral norm.
        iterations: largest number of steps.
    """
    z = mu.copy()
    for _ in range(iterations):
        gradient, bend = energy_gradient(z, mu, x, W_F, pi_z, pi_x)
        farthest = np.float32(0)
        for n in range(z.shape[0]):
            step = STRIDE / (curvature + bend[n])
            for j in range(z.shape[1]):
                move = step * gradient[n, j]
                z[n, j] -= move
                farthest = max(farthest, abs(move))
        if farthest < STILL:
            break
    return z


@kernel
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
    """Return f(μ_t) (B, H) and c_t (B, I); the state is inferred only where a sense is missing.

    Args:
        c, u, x, seen: (B, I), (B, A + 1), (B, S), (B, S) as in ``Network.follow``.
        context: whether f(μ_t) is wanted; if not, and all senses are seen, it is 0.
    """
    B, S = x.shape
    rows = np.hstack((x, u))
    whole = seen.all()
    if whole and not context:
        return np.zeros((B, W_C.shape[0]), c.dtype), advance(c, rows, gains)
    mu = expect(c, W_C)
    if not whole:
        past = outward(np.hstack((c, u)), W_D)  # (B, S + A)
        left, precision = rows[:, :-1] - past, np.full((B, past.shape[1]), pi_x, c.dtype)
        precision[:, :S] *= seen
        found = sense(infer(mu, left, W_F, pi_z, precision, curvature, iterations), W_F)
        for n in range(B):
            for i in range(S):
                if seen[n, i] == 0:
                    rows[n, i] = past[n, i] + found[n, i]
    return activate(mu), advance(c, rows, gains)
