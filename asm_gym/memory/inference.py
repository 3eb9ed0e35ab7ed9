"""Prediction before the senses are read, and inference after.

    μ_t = W_H f(z_{t-1}) + W_U u_t                 expected state; u_t is the commanded action and a constant 1
    h_t = W_H f(z_{t-1}) + b_U,  â_t = W_A f(h_t)  the action that belongs to the state; b_U stands for the constant 1
    z ← z - η ∂F/∂z,  η = 1.5 / (Π_z + Π_x‖W_F‖² + max|f''| ‖W_Fᵀ Π_x ε_x‖_∞)

The bracket bounds the largest curvature of F, so a step below 2 over it cannot raise F, however W_F grows.

Source: Millidge et al. 2024 (PLOS Comput Biol); Tang et al. 2023 (NeurIPS).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asm_gym.memory.energy import Array, Scalar, activate, energy_gradient, kernel, outward

STRIDE = np.float32(1.5)
"""Length of an inference step over the inverse of the curvature; from 2 on it would diverge."""


class Weights(NamedTuple):
    """The synapses. H hidden units, X sensory, A motor; all float32."""

    W_H: Array  # (H, H) from the last state to the next
    W_U: Array  # (H, A + 1) from the commanded action and a constant 1 to the state
    W_F: Array  # (X, H) from the state to the senses
    b_F: Array  # noqa: N815 (X,)
    W_A: Array  # (A, H) from the expected state to the action


def weight_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """The shape of each array in ``Weights``, by name."""
    H, X, A = hidden, sensory, motor
    return {"W_H": (H, H), "W_U": (H, A + 1), "W_F": (X, H), "b_F": (X,), "W_A": (A, H)}


@kernel
def expect(z: Array, u: Array, W_H: Array, W_U: Array) -> Array:
    """μ_t (B, H), the state expected after ``z`` (B, H) once ``u`` (B, A + 1) is commanded."""
    mu = outward(activate(z), W_H)
    mu += outward(u, W_U)
    return mu


@kernel
def sense(z: Array, W_F: Array, b_F: Array) -> Array:
    """x̂ (B, X), the senses that ``z`` (B, H) predicts."""
    x = outward(activate(z), W_F)
    x += b_F
    return x


def motor_prediction(z: Array, weights: Weights) -> tuple[Array, Array]:
    """h_t (B, H) and â_t (B, A), from the state ``z`` (B, H) before: what comes next, were no action commanded."""
    h: Array = outward(activate(z), weights.W_H) + weights.W_U[:, -1]
    return h, outward(activate(h), weights.W_A)


@kernel
def infer(
    mu: Array, x: Array, W_F: Array, b_F: Array, pi_z: Scalar, pi_x: Array, curvature: Scalar, iterations: int
) -> Array:
    """z_t (B, H): ``iterations`` steps down the energy, from ``mu`` on; arguments as in ``energy``.

    Args:
        curvature: Π_z + max Π_x ‖W_F‖², spectral norm.
    """
    z = mu.copy()
    for _ in range(iterations):
        gradient, bend = energy_gradient(z, mu, x, W_F, b_F, pi_z, pi_x)
        for n in range(z.shape[0]):
            step = STRIDE / (curvature + bend[n])
            for j in range(z.shape[1]):
                z[n, j] -= step * gradient[n, j]
    return z
