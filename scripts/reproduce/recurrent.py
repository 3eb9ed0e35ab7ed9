"""The rivals of the memory: a GRU or an LSTM, trained by backpropagation through time.

    h_t = GRU(h_{t-1}, [x_{t-1}, a_{t-1}])     â_t = A h_t     x̂_t = F h_t + G a_t + b       Σ ‖x - x̂‖² + ‖a - â‖²

It reads what the memory reads and predicts what it predicts. Noise on its inputs while learning makes it recover from
its own errors when it runs on.

Sources: Cho et al. 2014 (EMNLP); Jaeger 2001 (GMD Report 148) for the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from asm_gym.memory.learning import Trajectory
from asm_gym.monitors.baselines.networks import adam, descend

Array = NDArray[np.float32]
BATCH = 16  # episodes of a batch


class Batch(NamedTuple):
    """Episodes of one length, side by side."""

    senses: Array  # (T, B, S)
    commands: Array  # (T, B, A + 1), the last one a constant 1


def side_by_side(trajectories: Sequence[Trajectory]) -> Batch:
    """Stack episodes along a new second axis; those that end before the longest are NaN from then on."""
    rows = ([torch.from_numpy(getattr(t, name)) for t in trajectories] for name in Batch._fields)
    return Batch(*(pad_sequence(own, padding_value=np.nan).numpy() for own in rows))


def batches(trajectories: Sequence[Trajectory], rng: np.random.Generator) -> list[Batch]:
    """Return all episodes in batches of about one length, in random order."""
    order = rng.permutation(len(trajectories))
    order = order[np.argsort([len(trajectories[i].senses) for i in order], kind="stable")]
    groups = [order[i : i + BATCH] for i in range(0, len(order), BATCH)]
    return [
        side_by_side([trajectories[i] for i in groups[g]]) for g in rng.permutation(len(groups))
    ]


class Recurrent(nn.Module):
    """A GRU or an LSTM of ``hidden`` units, and its readouts of the numbers sensed and commanded."""

    def __init__(self, hidden: int, sensory: int, motor: int, cell: str = "GRU") -> None:
        super().__init__()
        self.cell = getattr(nn, cell)(sensory + motor, hidden)
        self.act = nn.Linear(hidden, motor)
        self.sense = nn.Linear(hidden + motor, sensory)

    def forward(self, rows: Tensor, commands: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Return x̂ (T, B, S), â (T, B, A) and the last state.

        Args:
            rows: (T, B, S + A) senses and commands, each from the row before.
            commands: (T, B, A) of the row itself.
        """
        h, state = self.cell(rows)
        return self.sense(torch.cat([h, commands], dim=-1)), self.act(h), state

    def run_on(self, row: Tensor, state: Any, steps: int) -> tuple[Tensor, Tensor]:
        """Return x̂ (T, B, S) and â (T, B, A) of ``steps`` rows from memory, after the last row read (B, S + A)."""
        sensed, acted = [], []
        for _ in range(steps):
            h, state = self.cell(row[None], state)
            acted.append(self.act(h[0]))
            sensed.append(self.sense(torch.cat([h[0], acted[-1]], dim=-1)))
            row = torch.cat([sensed[-1], acted[-1]], dim=-1)
        return torch.stack(sensed), torch.stack(acted)


def train(
    trajectories: Sequence[Trajectory],
    hidden: int,
    updates: int,
    rng: np.random.Generator,
    noise: float = 0.3,
    rate: float = 1e-2,
    cell: str = "GRU",
) -> Recurrent:
    """Return a network, a ``"GRU"`` or ``"LSTM"``, that has learned from so many batches of whole episodes.

    ``noise`` is the standard deviation of the noise on the rows it reads, ``rate`` that of Adam, with a cosine decay.
    """
    torch.set_num_threads(1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        own = torch.Generator().manual_seed(int(rng.integers(2**31)))
        sensory, motor = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1] - 1
        network = Recurrent(hidden, sensory, motor, cell)
    optimiser, schedule = adam(network, updates, rate)
    done = 0
    while done < updates:
        for batch in batches(trajectories, rng)[: updates - done]:
            real = torch.from_numpy(np.isfinite(batch.commands[:, :, 0]))
            x, a = (
                torch.from_numpy(batch.senses).nan_to_num(),
                torch.from_numpy(batch.commands[:, :, :-1]).nan_to_num(),
            )
            rows = shifted(x, a)
            sensed, acted, _ = network(rows + noise * torch.randn(rows.shape, generator=own), a)
            error = ((x - sensed) ** 2).sum(-1) + ((a - acted) ** 2).sum(-1)
            descend(error[real].mean(), optimiser, schedule)
            done += 1
    return network.eval().requires_grad_(False)


def shifted(senses: Tensor, commands: Tensor) -> Tensor:
    """Return rows (T, B, S + A), each that of the row before; zeros before the first."""
    rows = torch.cat([senses, commands], dim=-1)
    return torch.cat([torch.zeros_like(rows[:1]), rows[:-1]])


def expected(network: Recurrent, senses: Array, commands: Array, cue: int) -> tuple[Array, Array]:
    """Return x̂ (T, B, S) and â (T, B, A) of rows (T, B, S) and (T, B, A + 1), of which the first ``cue`` are read."""
    x, a = torch.from_numpy(senses), torch.from_numpy(commands[:, :, :-1])
    sensed, acted, state = network(shifted(x, a)[:cue], a[:cue])
    if cue < len(x):
        on = network.run_on(torch.cat([x[cue - 1], a[cue - 1]], dim=-1), state, len(x) - cue)
        sensed, acted = torch.cat([sensed, on[0]]), torch.cat([acted, on[1]])
    return sensed.numpy(), acted.numpy()
