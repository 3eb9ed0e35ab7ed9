"""The same network, differentiated: what backpropagation through time and through inference would change.

    E = Σ_t F_t(z_t),   z_t = the inferred state          L = ½ Σ_t Π_x ‖[x_t, a_t] - [x̂_t, â_t](μ_t)‖²
    L_alone: the same along a stream that reads a cue and then runs on alone, its traces taking up its own predictions
    exact: the gradient of each, through all steps of inference and of time      local: Σ_t of the Hebbian changes

Along a stream that is read, the traces hold what was sensed, which no weight changes: there is nothing that could
travel back through time. Along one that runs on alone there is, and the local changes leave it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asm_gym.memory.energy import STEEPEST
from asm_gym.memory.inference import STRIDE, Weights, direct, direct_synapses, expect, infer, sense
from asm_gym.memory.learning import Batch, hebbian_change
from asm_gym.memory.traces import DECAYS, advance, at_rest

COMPARED = ("W_C", "W_F", "W_D")
"""The synapses that are learned."""

TARGETS = ("energy", "error", "alone")

CUE = 10
"""Rows that are read before a stream runs on alone."""


class Changes(NamedTuple):
    """One array for each of ``COMPARED``, and what it was derived from."""

    arrays: dict[str, NDArray[np.float64]]
    energy: float  # E, over the mean of the batch
    error: float  # L, or L_alone
    saved: int  # bytes kept for the way back; for local learning, of the traces, the state and the row of a step


def local(weights: Weights, batch: Batch, iterations: int, pi_z: float, alone: bool = False) -> Changes:
    """Σ_t of the Hebbian changes along a batch of episodes of one length, weights held still."""
    w, pi_x = weights, 1.0
    curvature = pi_z + pi_x * float(np.linalg.norm(w.W_F, 2)) ** 2
    sensory = batch.senses.shape[2]
    c = at_rest(batch.senses.shape[1], len(w.W_F) + 1)
    total = {name: np.zeros(getattr(w, name).shape) for name in COMPARED}
    energy = error = 0.0
    for t, (x, u) in enumerate(zip(batch.senses, batch.commands, strict=True)):
        mu, taken = expect(c, w.W_C), u
        if alone and t >= CUE:
            action = (direct(c, u, w.W_D) + sense(mu, w.W_F))[:, sensory:]
            taken = np.hstack([action, u[:, -1:]])
        past = direct(c, taken, w.W_D)
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, pi_z, np.full_like(left, pi_x), curvature, iterations)
        settled, missed = left - sense(z, w.W_F), left - sense(mu, w.W_F)
        change = hebbian_change(c, taken, mu, z, np.float32(pi_x) * settled, pi_z)
        for name in COMPARED:
            total[name] += getattr(change, name)
        energy += 0.5 * float((pi_z * np.sum((z - mu) ** 2) + pi_x * np.sum(settled**2)) / len(x))
        error += 0.5 * pi_x * float(np.sum(missed**2) / len(x))
        expected = (past + sense(mu, w.W_F))[:, :sensory]
        c = advance(c, np.hstack([expected if alone and t >= CUE else x, taken]), w.gains)
    return Changes(total, energy, error, c.nbytes + 2 * mu.nbytes + x.nbytes)


def exact(
    weights: Weights, batch: Batch, iterations: int, pi_z: float, targets: Sequence[str] = TARGETS
) -> dict[str, Changes]:
    """The negative gradient of each of ``targets``, by backpropagation through time."""
    W = {name: torch.from_numpy(getattr(weights, name).copy()).requires_grad_() for name in COMPARED}
    found = {}
    for target in targets:
        saved: list[int] = []

        def keep(tensor: Tensor, kept: list[int] = saved) -> Tensor:
            kept.append(tensor.nbytes)
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            energy, error = _unrolled(W, weights.gains, batch, iterations, pi_z, target)
        gradient = torch.autograd.grad(energy if target == "energy" else error, list(W.values()))
        arrays = {n: -g.numpy().astype(np.float64) for n, g in zip(W, gradient, strict=True)}
        found[target] = Changes(arrays, energy.item(), error.item(), sum(saved))
    return found


def _unrolled(
    W: dict[str, Tensor], gains: NDArray[np.float32], batch: Batch, iterations: int, pi_z: float, target: str
) -> tuple[Tensor, Tensor]:
    """E and L, over the mean of the batch; only what the target needs is computed."""
    W_C, W_F = W["W_C"], W["W_F"]
    S, A = batch.senses.shape[2], batch.commands.shape[2] - 1
    W_D = W["W_D"] * torch.from_numpy(direct_synapses(S, A))
    curvature = pi_z + float(torch.linalg.matrix_norm(W_F.detach(), 2)) ** 2
    decays, g = torch.from_numpy(DECAYS)[:, None], torch.from_numpy(gains)[:, None]
    c = torch.zeros(batch.senses.shape[1], len(DECAYS), S + A + 1)
    energy, error = torch.zeros(()), torch.zeros(())
    for t, (x, u) in enumerate(zip(torch.from_numpy(batch.senses), torch.from_numpy(batch.commands), strict=True)):
        flat = c.flatten(1)
        mu, taken, read = flat @ W_C.T, u, x
        state = torch.tanh(mu) @ W_F.T
        if target == "alone" and t >= CUE:
            action = (torch.cat([flat, u], dim=1) @ W_D.T + state)[:, S:]
            taken = torch.cat([action, u[:, -1:]], dim=1)
        past = torch.cat([flat, taken], dim=1) @ W_D.T
        left = torch.cat([x, u[:, :-1]], dim=1) - past
        error = error + 0.5 * torch.sum((left - state) ** 2) / len(x)
        if target == "energy":
            z = mu
            for _ in range(iterations):
                f = torch.tanh(z)
                feedback = (left - f @ W_F.T) @ W_F
                bend = float(STEEPEST) * feedback.detach().abs().amax(dim=1, keepdim=True)
                z = z - float(STRIDE) / (curvature + bend) * (pi_z * (z - mu) - (1 - f * f) * feedback)
            settled = torch.sum((left - torch.tanh(z) @ W_F.T) ** 2)
            energy = energy + 0.5 * (pi_z * torch.sum((z - mu) ** 2) + settled) / len(x)
        elif target == "alone" and t >= CUE:
            read = (past + state)[:, :S]
        c = decays * c + g * torch.cat([read, taken], dim=1)[:, None]
    return energy, error


def cosine(a: Changes, b: Changes, names: tuple[str, ...] = COMPARED) -> float:
    """Of the angle between two changes of these arrays; 0 where either is none."""
    p, q = (np.concatenate([c.arrays[n].ravel() for n in names]) for c in (a, b))
    length = float(np.linalg.norm(p) * np.linalg.norm(q))
    return float(p @ q) / length if length > 0 else 0.0
