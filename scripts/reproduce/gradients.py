"""The same network, differentiated: what backpropagation through time and through inference would change.

    E = Σ_t F_t(z_t, z_{t-1}),   z_t = the inferred state          L = ½ Σ_t Π_x ‖x_t - x̂(μ_t)‖²
    exact: dE/dW and dL/dW, through all states and all steps of inference       local: Σ_t of the Hebbian changes

At converged inference ∂F_t/∂z_t = 0: of dE/dW the local change then leaves out only what a state does to later steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asm_gym.memory.energy import STEEPEST, Array
from asm_gym.memory.inference import STRIDE, Weights, expect, infer
from asm_gym.memory.learning import Batch, hebbian_change

COMPARED = ("W_H", "W_U", "W_F", "b_F")
"""The synapses that the energy depends on; W_A reads out the action and changes nothing else."""


TARGETS = ("energy", "error")


class Changes(NamedTuple):
    """One array for each of ``COMPARED``, and what it was derived from."""

    arrays: dict[str, NDArray[np.float64]]
    energy: float  # E, over the mean of the batch
    error: float  # L
    saved: int  # bytes kept for the way back; for local learning, of the two states and the row of a step


def local(weights: Weights, batch: Batch, iterations: int, pi: float = 1.0) -> Changes:
    """Σ_t of the Hebbian changes along a batch of episodes of one length, weights held still."""
    curvature = pi + pi * float(np.linalg.norm(weights.W_F, 2)) ** 2
    z: Array = np.zeros((batch.senses.shape[1], weights.W_H.shape[0]), np.float32)
    total = {name: np.zeros(getattr(weights, name).shape) for name in COMPARED}
    energy = error = 0.0
    for x, u in zip(batch.senses, batch.commands, strict=True):
        mu = expect(z, u, weights.W_H, weights.W_U)
        after = infer(mu, x, weights.W_F, weights.b_F, pi, np.full_like(x, pi), curvature, iterations)
        change = hebbian_change(weights, z, mu, after, u, x, pi, pi)
        for name in COMPARED:
            total[name] += getattr(change, name)
        left = x - np.tanh(after) @ weights.W_F.T - weights.b_F
        missed = x - np.tanh(mu) @ weights.W_F.T - weights.b_F
        energy += 0.5 * pi * float((np.sum((after - mu) ** 2) + np.sum(left**2)) / len(x))
        error += 0.5 * pi * float(np.sum(missed**2) / len(x))
        z = after
    return Changes(total, energy, error, 3 * z.nbytes + x.nbytes)


def exact(
    weights: Weights, batch: Batch, iterations: int, targets: Sequence[str] = TARGETS, pi: float = 1.0
) -> dict[str, Changes]:
    """The negative gradient of each of ``targets``, by backpropagation through time."""
    W = {name: torch.from_numpy(getattr(weights, name).copy()).requires_grad_() for name in COMPARED}
    saved: list[int] = []

    def keep(tensor: Tensor) -> Tensor:
        saved.append(tensor.nbytes)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        both = dict(zip(TARGETS, _unrolled(W, batch, iterations, pi), strict=True))
    found = {}
    for target in targets:
        gradient = torch.autograd.grad(both[target], list(W.values()), retain_graph=True)
        arrays = {n: -g.numpy().astype(np.float64) for n, g in zip(W, gradient, strict=True)}
        found[target] = Changes(arrays, both["energy"].item(), both["error"].item(), sum(saved))
    return found


def _unrolled(W: dict[str, Tensor], batch: Batch, iterations: int, pi: float) -> tuple[Tensor, Tensor]:
    """E and L, over the mean of the batch."""
    W_H, W_U, W_F, b_F = (W[name] for name in COMPARED)
    curvature = pi + pi * float(torch.linalg.matrix_norm(W_F.detach(), 2)) ** 2
    z = torch.zeros(batch.senses.shape[1], len(W_H))
    energy, error = torch.zeros(()), torch.zeros(())
    for x, u in zip(torch.from_numpy(batch.senses), torch.from_numpy(batch.commands), strict=True):
        mu = torch.tanh(z) @ W_H.T + u @ W_U.T
        error = error + 0.5 * pi * torch.sum((x - torch.tanh(mu) @ W_F.T - b_F) ** 2) / len(x)
        z = mu
        for _ in range(iterations):
            f = torch.tanh(z)
            feedback = pi * (x - f @ W_F.T - b_F) @ W_F
            bend = float(STEEPEST) * feedback.detach().abs().amax(dim=1, keepdim=True)
            z = z - float(STRIDE) / (curvature + bend) * (pi * (z - mu) - (1 - f * f) * feedback)
        left = torch.sum((x - torch.tanh(z) @ W_F.T - b_F) ** 2)
        energy = energy + 0.5 * pi * (torch.sum((z - mu) ** 2) + left) / len(x)
    return energy, error


def cosine(a: Changes, b: Changes, names: tuple[str, ...] = COMPARED) -> float:
    """Of the angle between two changes of these arrays; 0 where either is none."""
    p, q = (np.concatenate([c.arrays[n].ravel() for n in names]) for c in (a, b))
    length = float(np.linalg.norm(p) * np.linalg.norm(q))
    return float(p @ q) / length if length > 0 else 0.0
