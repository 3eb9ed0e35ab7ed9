"""The recurrent rivals of the memory: a GRU and an LSTM, trained by backpropagation through time.

    h_t = cell(h_{t-1}, [x_{t-1}, a_{t-1}, 1])     â_t = A h_t     x̂_t = F h_t + G a_t + b       Σ ‖x - x̂‖² + ‖a - â‖²

They read what the memory reads and predict what it predicts. Noise on their inputs while learning makes them recover
from their own errors when they run on.

Sources: Cho et al. 2014 (EMNLP); Hochreiter and Schmidhuber 1997 (Neural Computation 9(8)); Jaeger 2001 (GMD Report
148) for the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.memory.learning import Trajectory
from asm_gym.monitors.baselines.torch_model import adam, descend
from asm_gym.validation import check_choice

Array = NDArray[np.float32]

CELLS: dict[str, Any] = {"gru": nn.GRU, "lstm": nn.LSTM}


class Batch(NamedTuple):
    """Episodes side by side, the longest first; at row t the first ``active[t]`` are still running."""

    senses: Array  # (T, B, S)
    commands: Array  # (T, B, A + 1)
    active: NDArray[np.intp]  # (T,)


def side_by_side(trajectories: Sequence[Trajectory]) -> Batch:
    """Stack episodes of different lengths along a new second axis."""
    ordered = sorted(trajectories, key=lambda t: -len(t.senses))
    lengths = np.array([len(t.senses) for t in ordered])
    senses, commands = (
        np.zeros((lengths[0], len(ordered), array.shape[1]), np.float32)
        for array in (ordered[0].senses, ordered[0].commands)
    )
    for n, trajectory in enumerate(ordered):
        senses[: lengths[n], n] = trajectory.senses
        commands[: lengths[n], n] = trajectory.commands
    return Batch(senses, commands, active=(lengths > np.arange(lengths[0])[:, None]).sum(axis=1))


def batches(trajectories: Sequence[Trajectory], size: int, rng: np.random.Generator) -> list[Batch]:
    """Return all episodes in batches of similar length, in random order."""
    shuffled = rng.permutation(len(trajectories))
    by_length = shuffled[np.argsort([len(trajectories[i].senses) for i in shuffled], kind="stable")]
    groups = [by_length[i : i + size] for i in range(0, len(by_length), size)]
    return [side_by_side([trajectories[i] for i in groups[g]]) for g in rng.permutation(len(groups))]


class Recurrent(nn.Module):
    """A cell and its two readouts.

    Args:
        cell: one of ``CELLS``.
        hidden: units.
        sensory, motor: numbers sensed and commanded.
    """

    def __init__(self, cell: str, hidden: int, sensory: int, motor: int) -> None:
        super().__init__()
        check_choice("cell", cell, CELLS)
        self.cell = CELLS[cell](sensory + motor, hidden)
        self.act = nn.Linear(hidden, motor)
        self.sense = nn.Linear(hidden + motor, sensory)

    def forward(self, rows: Tensor, commands: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return x̂ (T, B, S) and â (T, B, A) online, and the last state.

        Args:
            rows: (T, B, S + A) senses and commands, each from the row before.
            commands: (T, B, A) of the row itself.
            state: of the cell before the first row.
        """
        h, state = self.cell(rows, state)
        return self.sense(torch.cat([h, commands], dim=-1)), self.act(h), state

    def run_on(self, row: Tensor, state: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Return x̂ (T, B, S) and â (T, B, A) offline, from the last row read (B, S + A)."""
        sensed, acted = [], []
        for _ in range(steps):
            h, state = self.cell(row[None], state)
            action = self.act(h[0])
            row = torch.cat([self.sense(torch.cat([h[0], action], dim=-1)), action], dim=-1)
            sensed.append(row[:, : row.shape[1] - action.shape[1]])
            acted.append(action)
        return torch.stack(sensed), torch.stack(acted)


def train(
    trajectories: Sequence[Trajectory],
    cell: str,
    hidden: int,
    updates: int,
    rng: np.random.Generator,
    noise: float = 0.3,
    rate: float = 1e-2,
    batch_size: int = 16,
) -> Recurrent:
    """Return a network that has learned from whole episodes.

    Args:
        trajectories: the episodes.
        cell, hidden: as in ``Recurrent``.
        updates: number of batches.
        rng: draws everything random.
        noise: standard deviation of the noise on the rows it reads.
        rate: of Adam, with a cosine decay.
        batch_size: episodes of a batch.
    """
    torch.set_num_threads(1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        own = torch.Generator().manual_seed(int(rng.integers(2**31)))
        sensory, motor = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1] - 1
        network = Recurrent(cell, hidden, sensory, motor)
    optimiser, schedule = adam(network, updates, rate)
    done = 0
    while done < updates:
        for batch in batches(trajectories, batch_size, rng)[: updates - done]:
            x, a = torch.from_numpy(batch.senses), torch.from_numpy(batch.commands[:, :, :-1])
            real = torch.from_numpy(batch.active[:, None] > np.arange(x.shape[1])).float()[:, :, None]
            rows = shifted(x, a)
            sensed, acted, _ = network(rows + noise * torch.randn(rows.shape, generator=own), a)
            error = ((x - sensed) ** 2).sum(-1, keepdim=True) + ((a - acted) ** 2).sum(-1, keepdim=True)
            descend((error * real).sum() / real.sum(), optimiser, schedule)
            done += 1
    return network.eval().requires_grad_(False)


def shifted(senses: Tensor, commands: Tensor) -> Tensor:
    """Return rows (T, B, S + A), each that of the row before; zeros before the first."""
    rows = torch.cat([senses, commands], dim=-1)
    return torch.cat([torch.zeros_like(rows[:1]), rows[:-1]])


def expected(network: Recurrent, senses: Array, commands: Array, cue: int) -> tuple[Array, Array]:
    """Return x̂ (T, B, S) and â (T, B, A) of rows of which the first ``cue`` are read.

    Args:
        network: trained.
        senses: (T, B, S) standardised.
        commands: (T, B, A + 1), the last one a constant 1.
        cue: rows to read.
    """
    x, a = torch.from_numpy(senses), torch.from_numpy(commands[:, :, :-1])
    sensed, acted, state = network(shifted(x, a)[:cue], a[:cue])
    if cue < len(x):
        on = network.run_on(torch.cat([x[cue - 1], a[cue - 1]], dim=-1), state, len(x) - cue)
        sensed, acted = torch.cat([sensed, on[0]]), torch.cat([acted, on[1]])
    return sensed.numpy(), acted.numpy()
