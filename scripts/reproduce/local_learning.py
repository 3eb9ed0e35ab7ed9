"""Local learning: the Hebbian changes against the exact gradient of backpropagation through time.

    E = Σ_t F_t(z_t),   z_t = the inferred state          L = ½ Σ_t Π_x ‖[x_t, a_t] - [x̂_t, â_t](μ_t)‖²
    L_alone: the same along a stream that reads a cue and then runs on its own predictions
    exact: the gradient of each, through all steps of inference and of time      local: Σ_t of the Hebbian changes

Claim: along streams that are read, local changes are the gradient. Their traces hold what was sensed, which no weight
changes, so that nothing would travel back through time. Along streams that run on alone there is something, and local
changes leave it out. A memory learns letters by its local rules, and on the way the angles to the three gradients are
measured, with the weights held still. Then the same network learns from the same letters by backpropagation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asm_gym.evaluation.figures import figure
from asm_gym.memory.energy import STEEPEST, STRIDE, Inference, infer
from asm_gym.memory.learning import Practice, Schedule, Trajectory, cosine_decay, one_after_another
from asm_gym.memory.traces import (
    DECAYS,
    TracesLearner,
    Weights,
    advance,
    direct,
    direct_synapses,
    expect,
    fit_gains,
    hebbian_change,
    initial_weights,
    sense,
)
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import trajectories
from asm_gym.scripts.reproduce.handwriting import check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, curves
from asm_gym.scripts.reproduce.recurrent import Batch, batches, side_by_side

COMPARED = ("W_C", "W_F", "W_D")  # the synapses that are learned
CUE = 10  # rows that are read before a stream runs on alone
TARGETS = {
    "energy": "gradient of the energy",
    "error": "gradient of the prediction error",
    "alone": f"gradient of the error alone, after a cue of {CUE}",
}
# learning rate of a change a row, and of one a batch
RATES = {
    "local": 3e-3,
    "backpropagation": 1e-2,
}
PRIOR_PRECISION = 30.0  # Π_z
ITERATIONS = 5  # inference steps of learning


@dataclass(frozen=True)
class Config(kit.Config):
    """Angles between local changes and exact gradients."""

    skills: int = option(8, quick=2, check=check_letters)
    """Letters."""
    hidden: int = option(64, quick=16, least=4)
    """Hidden units."""
    writings: int = option(8, quick=4, least=1)
    """Writings of each letter."""
    epochs: int = option(40, quick=3, least=1)
    """Passes over them."""


class Changes(NamedTuple):
    """One array for each of ``COMPARED``, with what it was derived from."""

    arrays: dict[str, NDArray[np.float64]]
    energy: float  # E, mean over the batch
    error: float  # L, or L_alone


def local(
    weights: Weights,
    batch: Batch,
    iterations: int,
    alone: bool = False,
    pi_z: float = PRIOR_PRECISION,
) -> Changes:
    """Return Σ_t of the Hebbian changes along a batch of episodes of one length, with the weights held still."""
    w, curvature = weights, pi_z + float(np.linalg.norm(weights.W_F, 2)) ** 2
    inference = Inference(pi_z, 1.0, curvature, iterations)
    sensory = batch.senses.shape[2]
    c = np.zeros((batch.senses.shape[1], w.W_C.shape[1]), np.float32)
    total = {name: np.zeros(getattr(w, name).shape) for name in COMPARED}
    energy = error = 0.0
    for t, (x, u) in enumerate(zip(batch.senses, batch.commands, strict=True)):
        mu, taken = expect(c, w.W_C), u
        if alone and t >= CUE:
            action = (direct(c, u, w.W_D) + sense(mu, w.W_F))[:, sensory:]
            taken = np.hstack([action, u[:, -1:]])
        past = direct(c, taken, w.W_D)
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, np.ones_like(left), inference)
        settled, missed = left - sense(z, w.W_F), left - sense(mu, w.W_F)
        change = hebbian_change(c, taken, mu, z, settled, pi_z)
        for name in COMPARED:
            total[name] += getattr(change, name)
        energy += 0.5 * float((pi_z * np.sum((z - mu) ** 2) + np.sum(settled**2)) / len(x))
        error += 0.5 * float(np.sum(missed**2) / len(x))
        expected = (past + sense(mu, w.W_F))[:, :sensory]
        c = advance(c, np.hstack([expected if alone and t >= CUE else x, taken]), w.gains)
    return Changes(total, energy, error)


def exact(
    weights: Weights, batch: Batch, iterations: int, target: str, pi_z: float = PRIOR_PRECISION
) -> Changes:
    """Return the negative gradient of one of ``TARGETS``, by backpropagation through time."""
    W = {
        name: torch.from_numpy(getattr(weights, name).copy()).requires_grad_() for name in COMPARED
    }
    energy, error = _unrolled(W, weights.gains, batch, iterations, target, pi_z)
    gradient = torch.autograd.grad(energy if target == "energy" else error, list(W.values()))
    arrays = {n: -g.numpy().astype(np.float64) for n, g in zip(W, gradient, strict=True)}
    return Changes(arrays, energy.item(), error.item())


def _unrolled(
    W: dict[str, Tensor],
    gains: NDArray[np.float32],
    batch: Batch,
    iterations: int,
    target: str,
    pi_z: float,
) -> tuple[Tensor, Tensor]:
    """Return E and L, means over the batch; E is computed for its own gradient only."""
    W_C, W_F = W["W_C"], W["W_F"]
    S, A = batch.senses.shape[2], batch.commands.shape[2] - 1
    W_D = W["W_D"] * torch.from_numpy(direct_synapses(S, A))
    curvature = pi_z + float(torch.linalg.matrix_norm(W_F.detach(), 2)) ** 2
    decays, g = torch.from_numpy(DECAYS)[:, None], torch.from_numpy(gains)[:, None]
    c = torch.zeros(batch.senses.shape[1], len(DECAYS), S + A + 1)
    energy, error = torch.zeros(()), torch.zeros(())
    for t, (x, u) in enumerate(
        zip(torch.from_numpy(batch.senses), torch.from_numpy(batch.commands), strict=True)
    ):
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
                z = z - float(STRIDE) / (curvature + bend) * (
                    pi_z * (z - mu) - (1 - f * f) * feedback
                )
            settled = torch.sum((left - torch.tanh(z) @ W_F.T) ** 2)
            energy = energy + 0.5 * (pi_z * torch.sum((z - mu) ** 2) + settled) / len(x)
        elif target == "alone" and t >= CUE:
            read = (past + state)[:, :S]
        c = decays * c + g * torch.cat([read, taken], dim=1)[:, None]
    return energy, error


def cosine(a: Changes, b: Changes) -> float:
    """Return the cosine between two changes; 0 where one of them is 0."""
    p, q = (np.concatenate([c.arrays[n].ravel() for n in COMPARED]) for c in (a, b))
    length = float(np.linalg.norm(p) * np.linalg.norm(q))
    return float(p @ q) / length if length > 0 else 0.0


def checkpoints(epochs: int) -> list[int]:
    """Return the epochs before which angles are measured, dense at first."""
    return sorted({0, *(round(epochs ** (k / 6)) for k in range(7)), epochs})


def one_seed(seed: int, config: Config) -> list[Record]:
    """Measure angles during learning, and the error that each way of learning reaches."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, rng)
    train, tests = copybook(letters, config.writings, rng), copybook(letters, 2, rng)
    reader = StreamScaler.fit(train[0].spec, [e.stream for e in train])
    taught, judged = trajectories(reader, train), side_by_side(trajectories(reader, tests))
    weights = initial_weights(config.hidden, reader.size, 2, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in taught])
    probe, start = (
        side_by_side(taught[:: max(1, len(taught) // 16)]),
        Weights(*(w.copy() for w in weights)),
    )
    records: list[Record] = []
    schedule = Schedule(config.epochs, 16, RATES["local"], ITERATIONS, PRIOR_PRECISION, 1.0, 0.0)
    streams = Practice(TracesLearner(weights, schedule, rng), 16, rng)
    moments, steps = (
        one_after_another(taught, 16, rng),
        -(-sum(len(t.senses) for t in taught) // 16),
    )
    for epoch in range(config.epochs + 1):
        if epoch in checkpoints(config.epochs):
            records += angles(weights, probe, epoch)
            records.append(_reached("local", weights, judged, epoch))
        if epoch < config.epochs:
            streams.run(
                islice(moments, steps), cosine_decay(RATES["local"], epoch / config.epochs), 0.0
            )
    records += backpropagated(start, taught, judged, config, np.random.default_rng(seed))
    return [{"seed": seed, **r} for r in records]


def angles(weights: Weights, probe: Batch, epoch: int) -> list[Record]:
    """Return the angles [°] between the local change and each gradient."""
    records = []
    read, alone = (local(weights, probe, ITERATIONS, alone) for alone in (False, True))
    for target in TARGETS:
        theirs, ours = (
            exact(weights, probe, ITERATIONS, target),
            alone if target == "alone" else read,
        )
        degrees = math.degrees(math.acos(min(1.0, cosine(ours, theirs))))
        records.append({"epoch": epoch, "target": target, "degrees": degrees})
    return records


def backpropagated(
    weights: Weights,
    taught: Sequence[Trajectory],
    judged: Batch,
    config: Config,
    rng: np.random.Generator,
) -> list[Record]:
    """Train the same network from the same weights by Adam on the exact gradient of the prediction error."""
    records = []
    # shares memory with the weights
    W = {name: torch.from_numpy(getattr(weights, name)) for name in COMPARED}
    adam = torch.optim.Adam(W.values(), RATES["backpropagation"])
    for epoch in range(config.epochs + 1):
        if epoch in checkpoints(config.epochs):
            records.append(_reached("backpropagation", weights, judged, epoch))
        for group in adam.param_groups:
            group["lr"] = cosine_decay(RATES["backpropagation"], epoch / config.epochs)
        for batch in batches(taught, rng) if epoch < config.epochs else ():
            gradient = exact(weights, batch, ITERATIONS, "error").arrays
            for name, w in W.items():
                w.grad = torch.from_numpy(-gradient[name].astype(np.float32))
            adam.step()
    return records


def _reached(how: str, weights: Weights, judged: Batch, epoch: int) -> Record:
    """Return the mean squared error of a predicted number [variance of the stream]."""
    numbers = judged.senses[:, 0].size + judged.commands[:, 0, :-1].size
    return {
        "epoch": epoch,
        "learned_by": how,
        "mse": 2 * local(weights, judged, ITERATIONS).error / numbers,
    }


def run(config: Config) -> Findings:
    """Run every seed."""
    each = kit.each(
        "learning both ways", partial(one_seed, config=config), config.repetitions, config
    )
    records = [record for own in each for record in own]
    epochs = checkpoints(config.epochs)
    before, ways = kit.by("epoch", epochs), kit.by("learned_by", RATES)
    targets: dict[str, Record] = {label: {"target": t} for t, label in TARGETS.items()}
    angle = "Angle [°] between the local change and the exact one, before so many epochs; mean ± SD over seeds"
    missed = "Mean squared error of the next row [variance], before so many epochs"
    tables = [
        kit.grid(angle, records, "degrees", targets, before, 0),
        kit.grid(missed, records, "mse", ways, before, 3),
    ]
    with figure(height=3.3, width=8) as fig:
        left, right = fig.subplots(1, 2)
        curves(left, records, "degrees", ("epoch", epochs), targets)
        curves(right, records, "mse", ("epoch", epochs), ways)
        left.axhline(90, color="#999999", linewidth=1)
        left.set(
            xlabel="epochs", ylabel="angle to the local change [°]", ylim=(0, 95), xscale="symlog"
        )
        right.set(
            xlabel="epochs",
            ylabel="error of the next row [variance]",
            yscale="log",
            xscale="symlog",
        )
        for ax in (left, right):
            ax.legend(fontsize=7)
    return Findings(records, tables, fig)
