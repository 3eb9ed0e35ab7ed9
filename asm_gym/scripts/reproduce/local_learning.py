"""Local learning: the Hebbian changes against the exact gradient of backpropagation through time.

    E = Σ_t F_t(z_t),   z_t = the inferred state          L = ½ Σ_t Π_x ‖[x_t, a_t] - [x̂_t, â_t](μ_t)‖²
    L_alone: the same along a stream that reads a cue and then runs on its own predictions
    exact: the gradient of each, through all steps of inference and of time      local: Σ_t of the Hebbian changes

Claim: along streams that are read, local changes are the gradient. Their traces hold what was sensed. No weight changes
that, so nothing travels back through time. Along streams that run on alone, traces hold predictions, which depend on
the weights; local changes leave that dependence out. A memory learns letters by its local rules. On the way the study
measures the angles to the three gradients, with the weights held still. Then the same network learns the same letters
by backpropagation.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from asm_gym.evaluation.figures import figure
from asm_gym.memory.carried_readout import direct, sense
from asm_gym.memory.energy import (
    STEEPEST,
    STRIDE,
    Inference,
    infer,
    outward,
)
from asm_gym.memory.learning import Practice, Schedule, Trajectory, cosine_decay, one_after_another
from asm_gym.memory.traces import (
    DECAYS,
    HebbianChange,
    TracesLearner,
    Weights,
    advance,
    direct_synapses,
    fit_gains,
    hebbian_change,
    initial_weights,
)
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.backpropagation import Batch, batches, side_by_side
from asm_gym.scripts.reproduce.expression import fit_reader, trajectories
from asm_gym.scripts.reproduce.handwriting import check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, curves

COMPARED = HebbianChange._fields  # the synapses that are learned
CUE = 10  # rows that are read before a stream runs on alone
TARGETS = {
    "energy": "gradient of the energy",
    "error": "gradient of the prediction error",
    "alone": f"gradient of the error alone, after a cue of {CUE}",
}
# learning rates
RATES = {
    # of the change of a row
    "local": 3e-3,
    # of the gradient of a batch
    "backpropagation": 1e-2,
}
PRIOR_PRECISION = 30.0  # Π_z
ITERATIONS = 5  # inference steps of learning
STREAMS = 16  # that local learning follows side by side
PROBED = 16  # about so many episodes measure the angles


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

    @property
    def flat(self) -> NDArray[np.float64]:
        """All arrays as one (N,)."""
        return np.concatenate([array.ravel() for array in self.arrays.values()])


def local(
    weights: Weights,
    batch: Batch,
    iterations: int,
    alone: bool = False,
    pi_z: float = PRIOR_PRECISION,
) -> Changes:
    """Return Σ_t of the Hebbian changes along a batch, with the weights held still.

    Args:
        weights: of the network.
        batch: episodes of one length.
        iterations: inference steps a row.
        alone: whether the streams run on alone after ``CUE`` rows.
        pi_z: Π_z.
    """
    _, streams, sensory = batch.senses.shape
    curvature = pi_z + float(np.linalg.norm(weights.W_F, 2)) ** 2
    inference = Inference(pi_z, 1.0, curvature, iterations)
    c = np.zeros((streams, weights.W_C.shape[1]), np.float32)
    total = {name: np.zeros(getattr(weights, name).shape) for name in COMPARED}
    energy = 0.0
    error = 0.0
    for t, (x, u) in enumerate(zip(batch.senses, batch.commands, strict=True)):
        runs_on = alone and t >= CUE
        senses = x
        commands = u
        mu = outward(c, weights.W_C)
        from_state = sense(mu, weights.W_F)
        if runs_on:
            expected = direct(c, u, weights.W_D) + from_state
            commands = np.hstack([expected[:, sensory:], u[:, -1:]])
        from_traces = direct(c, commands, weights.W_D)
        if runs_on:
            expected = from_traces + from_state
            senses = expected[:, :sensory]

        row = np.hstack([x, u[:, :-1]])
        to_explain = row - from_traces
        z = infer(mu, to_explain, weights.W_F, np.ones_like(to_explain), inference)
        unexplained = to_explain - sense(z, weights.W_F)
        change = hebbian_change(c, commands, mu, z, unexplained, pi_z)
        for name in COMPARED:
            total[name] += getattr(change, name)
        prior = pi_z * np.sum((z - mu) ** 2)
        likelihood = np.sum(unexplained**2)
        squares = np.sum((to_explain - from_state) ** 2)
        energy += 0.5 * float((prior + likelihood) / streams)
        error += 0.5 * float(squares / streams)
        c = advance(c, np.hstack([senses, commands]), weights.gains)
    return Changes(total, energy, error)


def exact(
    weights: Weights, batch: Batch, iterations: int, target: str, pi_z: float = PRIOR_PRECISION
) -> Changes:
    """Return the negative gradient of one of ``TARGETS``, by backpropagation through time.

    The other arguments are those of ``local``.
    """
    tensors: Any = Weights._make(
        torch.from_numpy(array.copy()).requires_grad_() for array in weights
    )
    energy, error = losses(tensors, batch, iterations, target, pi_z)
    loss = error
    if target == "energy":
        loss = energy
    gradients = torch.autograd.grad(loss, tensors[: len(COMPARED)])
    arrays = [-gradient.numpy().astype(np.float64) for gradient in gradients]
    return Changes(dict(zip(COMPARED, arrays, strict=True)), energy.item(), error.item())


def losses(
    weights: Any, batch: Batch, iterations: int, target: str, pi_z: float
) -> tuple[Tensor, Tensor]:
    """Return E and L, means over the batch, through all steps of inference and of time.

    ``weights`` are those of ``traces`` as tensors; E is computed for its own gradient only.
    """
    senses = torch.from_numpy(batch.senses)
    commands = torch.from_numpy(batch.commands)
    _, streams, S = senses.shape
    A = commands.shape[2] - 1
    W_D = weights.W_D * torch.from_numpy(direct_synapses(S, A))
    decays = torch.from_numpy(DECAYS)[:, None]
    c = torch.zeros(streams, len(DECAYS), S + A + 1)
    energy = torch.zeros(())
    error = torch.zeros(())
    for t, (x, u) in enumerate(zip(senses, commands, strict=True)):
        runs_on = target == "alone" and t >= CUE
        senses = x
        commands = u
        traces = c.flatten(1)
        mu = traces @ weights.W_C.T
        from_state = torch.tanh(mu) @ weights.W_F.T
        if runs_on:
            expected = torch.cat([traces, u], dim=1) @ W_D.T + from_state
            commands = torch.cat([expected[:, S:], u[:, -1:]], dim=1)
        from_traces = torch.cat([traces, commands], dim=1) @ W_D.T
        if runs_on:
            expected = from_traces + from_state
            senses = expected[:, :S]

        row = torch.cat([x, u[:, :-1]], dim=1)
        to_explain = row - from_traces
        squares = torch.sum((to_explain - from_state) ** 2)
        error = error + 0.5 * squares / streams
        if target == "energy":
            z = settled(mu, to_explain, weights.W_F, iterations, pi_z)
            unexplained = to_explain - torch.tanh(z) @ weights.W_F.T
            likelihood = torch.sum(unexplained**2)
            prior = pi_z * torch.sum((z - mu) ** 2)
            energy = energy + 0.5 * (prior + likelihood) / streams
        rows = torch.cat([senses, commands], dim=1)[:, None]
        c = decays * c + weights.gains[:, None] * rows
    return energy, error


def settled(mu: Tensor, to_explain: Tensor, W_F: Tensor, iterations: int, pi_z: float) -> Tensor:
    """Return the inferred state (B, H).

    Inference begins at the expected state ``mu`` (B, H), and explains ``to_explain`` (B, S + A): what the traces
    have not predicted of the row.
    """
    curvature = pi_z + float(torch.linalg.matrix_norm(W_F.detach(), 2)) ** 2
    z = mu
    for _ in range(iterations):
        f = torch.tanh(z)
        feedback = (to_explain - f @ W_F.T) @ W_F
        bend = float(STEEPEST) * feedback.detach().abs().amax(dim=1, keepdim=True)
        gradient = pi_z * (z - mu) - (1 - f * f) * feedback
        z = z - float(STRIDE) / (curvature + bend) * gradient
    return z


def cosine(a: Changes, b: Changes) -> float:
    """Return the cosine between two changes; 0 where one of them is 0."""
    length = float(np.linalg.norm(a.flat) * np.linalg.norm(b.flat))
    if length == 0:
        return 0.0
    return float(a.flat @ b.flat) / length


# ------------------------------------------------------------------ the study


def checkpoints(epochs: int) -> list[int]:
    """Return the epochs before which angles are measured, dense at first."""
    return sorted({0, *(round(epochs ** (k / 6)) for k in range(7)), epochs})


def one_seed(seed: int, config: Config) -> list[Record]:
    """Measure angles during learning, and the error that each way of learning reaches."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, rng)
    train = copybook(letters, config.writings, rng)
    tests = copybook(letters, 2, rng)
    reader = fit_reader(train)
    taught = trajectories(reader, train)
    held_out = side_by_side(trajectories(reader, tests))
    every = max(1, len(taught) // PROBED)
    probe = side_by_side(taught[::every])

    weights = initial_weights(config.hidden, reader.size, 2, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in taught])
    same_start = copy.deepcopy(weights)
    same_order = np.random.default_rng(seed)
    learners = {
        "local": learn_locally(weights, taught, config.epochs, rng),
        "backpropagation": backpropagate(same_start, taught, config.epochs, same_order),
    }
    measured = checkpoints(config.epochs)
    records = []
    for learned_by, learner in learners.items():
        for epoch, current in enumerate(learner):
            if epoch not in measured:
                continue
            if learned_by == "local":
                records += angles(current, probe, epoch)
            mse = mean_square(current, held_out)
            records.append({"epoch": epoch, "learned_by": learned_by, "mse": mse})
    return [{"seed": seed, **record} for record in records]


def learn_locally(
    weights: Weights, taught: Sequence[Trajectory], epochs: int, rng: np.random.Generator
) -> Iterator[Weights]:
    """Train by the local rules; yield the weights before each epoch and after the last."""
    schedule = Schedule(
        epochs=epochs,
        batch_size=STREAMS,
        learning_rate=RATES["local"],
        iterations=ITERATIONS,
        prior_precision=PRIOR_PRECISION,
        sensory_precision=1.0,
        free_running_probability=0.0,
    )
    practice = Practice(TracesLearner(weights, schedule, rng), STREAMS, rng)
    moments = one_after_another(taught, STREAMS, rng)
    rows = sum(len(t.senses) for t in taught)
    steps = math.ceil(rows / STREAMS)
    yield weights
    for epoch in range(epochs):
        rate = cosine_decay(schedule.learning_rate, epoch / epochs)
        practice.run(islice(moments, steps), rate, free=0.0)
        yield weights


def backpropagate(
    weights: Weights, taught: Sequence[Trajectory], epochs: int, rng: np.random.Generator
) -> Iterator[Weights]:
    """Train by Adam on the exact gradient of the prediction error; yield the weights as ``learn_locally`` does."""
    # These tensors share memory with the weights.
    tensors = {name: torch.from_numpy(getattr(weights, name)) for name in COMPARED}
    adam = torch.optim.Adam(tensors.values())
    yield weights
    for epoch in range(epochs):
        adam.param_groups[0]["lr"] = cosine_decay(RATES["backpropagation"], epoch / epochs)
        for batch in batches(taught, rng):
            downhill = exact(weights, batch, ITERATIONS, "error").arrays
            for name, tensor in tensors.items():
                tensor.grad = torch.from_numpy(-downhill[name].astype(np.float32))
            adam.step()
        yield weights


def mean_square(weights: Weights, held_out: Batch) -> float:
    """Return the mean squared error of a predicted number [variance of the stream]."""
    numbers = held_out.senses[:, 0].size + held_out.commands[:, 0, :-1].size
    return 2 * local(weights, held_out, ITERATIONS).error / numbers


def angles(weights: Weights, probe: Batch, epoch: int) -> list[Record]:
    """Return the angles [°] between the local change and each gradient."""
    records = []
    for target in TARGETS:
        change = local(weights, probe, ITERATIONS, alone=target == "alone")
        gradient = exact(weights, probe, ITERATIONS, target)
        similarity = min(1.0, cosine(change, gradient))
        degrees = math.degrees(math.acos(similarity))
        records.append({"epoch": epoch, "target": target, "degrees": degrees})
    return records


def run(config: Config) -> Findings:
    """Run every seed."""
    work = partial(one_seed, config=config)
    records = kit.records_of("learning both ways", work, config.repetitions, config)
    frame = pd.DataFrame(records).replace({"target": TARGETS})
    angle = (
        "Angle [°] between the local change and the exact one, before so many epochs; "
        "mean ± SD over seeds"
    )
    error = "Mean squared error of the next row [variance], before so many epochs"
    tables = [
        kit.grid(angle, frame, "degrees", "target", "epoch", digits=0),
        kit.grid(error, frame, "mse", "learned_by", "epoch", digits=3),
    ]
    return Findings(records, tables, angles_figure(frame))


def angles_figure(records: pd.DataFrame) -> Figure:
    """Draw the angle to each gradient, and the error of each way of learning, over the epochs."""
    with figure(height=3.3, width=8) as fig:
        left, right = fig.subplots(1, 2)
        curves(left, records, "degrees", "epoch", "target")
        curves(right, records, "mse", "epoch", "learned_by")
        left.axhline(90, color="#999999", linewidth=1)
        left.set(ylabel="angle to the local change [°]", ylim=(0, 95))
        right.set(ylabel="error of the next row [variance]", yscale="log")
        for ax in (left, right):
            ax.set(xlabel="epochs", xscale="symlog")
            ax.legend(fontsize=7)
    return fig
