"""Random problems for the memory's mathematics, and its energy in plain NumPy."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from asm_gym.memory.association import (
    Association,
    association_shapes,
    unbounded,
    without_leverage,
)
from asm_gym.memory.learning import Schedule, Trajectory

CHANGES = slice(5, 10)
"""Where the changes of five senses stand among the inputs."""


def called(function):
    """Return what only compiled functions call, as Python can call it."""
    return numba.njit(function.py_func, error_model="numpy")


def energy(z, mu, x, W_F, pi_z, pi_x):
    """F (B,) of the temporal network, the oracle of ``energy_gradient``; its arguments are those."""
    error = x - np.tanh(z) @ W_F.T
    return 0.5 * pi_z * np.sum((z - mu) ** 2, axis=1) + 0.5 * np.sum(pi_x * error**2, axis=1)


def problem(
    seed: int,
    batch: int = 3,
    hidden: int = 8,
    sensory: int = 5,
    scale: float = 1.0,
    dtype=np.float32,
):
    """Random (z, mu, x, W_F, pi_z, pi_x) of an energy."""
    rng = np.random.default_rng(seed)
    arrays = [
        rng.normal(size=s) * scale
        for s in ((batch, hidden), (batch, hidden), (batch, sensory), (sensory, hidden))
    ]
    pi_x = rng.uniform(0.0, 3.0, size=(batch, sensory))
    return *(a.astype(dtype) for a in arrays), 1.5, pi_x.astype(dtype)


def some_association(
    rng: np.random.Generator, inputs: int, units: int, changes: int
) -> Association:
    shapes = association_shapes(inputs, units, changes).values()
    drawn = Association(*(rng.normal(scale=0.3, size=s).astype(np.float32) for s in shapes))
    known = {"remainder": np.exp(drawn.remainder), "span_S": unbounded(changes)}
    return drawn._replace(**known, **without_leverage(inputs, changes))


def some_rows(steps: int, batch: int, sensory: int, motor: int) -> tuple[np.ndarray, np.ndarray]:
    """Random senses (T, B, S), and commands (T, B, A + 1) whose last number is 1."""
    rng = np.random.default_rng(1)
    commands = rng.normal(size=(steps, batch, motor + 1))
    commands[:, :, -1] = 1.0
    return rng.normal(size=(steps, batch, sensory)).astype(np.float32), commands.astype(np.float32)


def trajectory(senses: np.ndarray, commands: np.ndarray) -> Trajectory:
    """With inputs of association made from the senses: each before, each one's change, and the commands."""
    before = np.vstack([senses[:1], senses[:-1]])
    return Trajectory(senses, commands, np.hstack([before, senses - before, commands]))


def schedule(**changes: Any) -> Schedule:
    return Schedule(3, 4, 1e-3, 10, 1.0, 1.0, 0.0)._replace(**changes)
