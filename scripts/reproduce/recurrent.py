"""The recurrent rivals of recall: a GRU, an LSTM and a plain RNN, trained by backpropagation through time.

Truncated to one step, an error changes what that step alone did, as local as the memory's own rules are.

    h_t = cell(h_{t-1}, [x_{t-1}, a_{t-1}, 1])     â_t = A h_t     x̂_t = F h_t + G a_t + b       Σ ‖x - x̂‖² + ‖a - â‖²

They read what the memory reads, and are asked the same: the action before it is commanded, the senses before they are
read. Noise on what they read while learning makes them recover from their own errors when they run on.

Sources: Cho et al. 2014 (EMNLP); Hochreiter and Schmidhuber 1997 (Neural Computation 9(8)); Elman 1990 (Cognitive
Science 14(2)); Jaeger 2001 (GMD Report 148) for the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.memory.learning import Trajectory, batches
from asm_gym.monitors.baselines.torch_model import adam, descend
from asm_gym.validation import check_choice

CELLS: dict[str, Any] = {"gru": nn.GRU, "lstm": nn.LSTM, "rnn": nn.RNN}


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
        """x̂ (T, B, S) and â (T, B, A) online, and the last state.

        Args:
            rows: (T, B, S + A) senses and commands, each from the step before.
            commands: (T, B, A) of the step itself.
        """
        h, state = self.cell(rows, state)
        return self.sense(torch.cat([h, commands], dim=-1)), self.act(h), state

    def run_on(self, row: Tensor, state: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """x̂ (T, B, S) and â (T, B, A) offline, from the last row read (B, S + A)."""
        sensed, acted = [], []
        for _ in range(steps):
            h, state = self.cell(row[None], state)
            action = self.act(h[0])
            drive = torch.cat([h[0], action], dim=-1)
            row = torch.cat([self.sense(drive), action], dim=-1)
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
    truncated: bool = False,
) -> Recurrent:
    """A network that has learned from whole episodes.

    Args:
        updates: batches learned from.
        noise: standard deviation of what is added to the rows it reads.
        rate: of Adam, with a cosine decay.
        truncated: errors go back one step, and no further.
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
            noisy = rows + noise * torch.randn(rows.shape, generator=own)
            sensed, acted = step_by_step(network, noisy, a) if truncated else network(noisy, a)[:2]
            error = ((x - sensed) ** 2).sum(-1, keepdim=True) + ((a - acted) ** 2).sum(-1, keepdim=True)
            descend((error * real).sum() / real.sum(), optimiser, schedule)
            done += 1
    return network.eval().requires_grad_(False)


def step_by_step(network: Recurrent, rows: Tensor, commands: Tensor) -> tuple[Tensor, Tensor]:
    """x̂ (T, B, S) and â (T, B, A) of all rows, with no way back from a step to the one before.

    The states are run through first; each step is then one of its own, side by side with all others.
    """
    with torch.no_grad():
        h, _ = network.cell(rows)  # (T, B, H)
        before = torch.cat([torch.zeros_like(h[:1]), h[:-1]])
    sensed, acted, _ = network(rows.flatten(0, 1)[None], commands.flatten(0, 1)[None], before.flatten(0, 1)[None])
    return sensed.reshape(*rows.shape[:2], -1), acted.reshape(*rows.shape[:2], -1)


def shifted(senses: Tensor, commands: Tensor) -> Tensor:
    """Rows (T, B, S + A), each the one before; nothing before the first."""
    rows = torch.cat([senses, commands], dim=-1)
    return torch.cat([torch.zeros_like(rows[:1]), rows[:-1]])


def expected(
    network: Recurrent, senses: NDArray[np.float32], commands: NDArray[np.float32], cue: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x̂ (T, B, S) and â (T, B, A) of rows of which the first ``cue`` are read; arguments as in ``recall.follow``."""
    x, a = torch.from_numpy(senses), torch.from_numpy(commands[:, :, :-1])
    sensed, acted, state = network(shifted(x, a)[:cue], a[:cue])
    if cue < len(x):
        on = network.run_on(torch.cat([x[cue - 1], a[cue - 1]], dim=-1), state, len(x) - cue)
        sensed, acted = torch.cat([sensed, on[0]]), torch.cat([acted, on[1]])
    return sensed.numpy(), acted.numpy()


def glimpsed(
    network: Recurrent, senses: NDArray[np.float32], commands: NDArray[np.float32], seen: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """x̂ (T, B, S) where only the rows that are ``seen`` (T,) are read, and what was expected stands for the others."""
    x, a = torch.from_numpy(senses), torch.from_numpy(commands[:, :, :-1])
    row, state, made = torch.zeros(x.shape[1], x.shape[2] + a.shape[2]), None, []
    for t in range(len(x)):
        h, state = network.cell(row[None], state)
        made.append(network.sense(torch.cat([h[0], a[t]], dim=-1)))
        row = torch.cat([x[t] if seen[t] else made[-1], a[t]], dim=-1)
    return torch.stack(made).numpy()
