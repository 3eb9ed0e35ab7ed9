"""The rivals of the memory: a GRU or an LSTM, trained by backpropagation through time.

    h_t = GRU(h_{t-1}, [x_{t-1}, a_{t-1}])     â_t = A h_t     x̂_t = F h_t + G a_t + b       Σ ‖x - x̂‖² + ‖a - â‖²

It reads what the memory reads and predicts what it predicts. Noise on its inputs while learning makes it recover from
its own errors when it runs on.

Sources: Cho et al. 2014 (EMNLP); Jaeger 2001 (GMD Report 148) for the noise.
"""

# In shapes: T rows, B episodes, S numbers sensed, A numbers commanded.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from asm_gym.memory.learning import Trajectory
from asm_gym.monitors.baselines.torch_baselines import adam, descend
from asm_gym.scaling import ScaledRows

Array = NDArray[np.float32]
BATCH = 16  # episodes of a batch


class Batch(NamedTuple):
    """Episodes of one length, side by side."""

    senses: Array  # (T, B, S)
    commands: Array  # (T, B, A + 1), the last one a constant 1


def side_by_side(trajectories: Sequence[Trajectory | ScaledRows]) -> Batch:
    """Stack episodes along a new second axis; the shorter ones are NaN after their end."""
    senses = [torch.from_numpy(t.senses) for t in trajectories]
    commands = [torch.from_numpy(t.commands) for t in trajectories]
    padded_senses = pad_sequence(senses, padding_value=np.nan)
    padded_commands = pad_sequence(commands, padding_value=np.nan)
    return Batch(padded_senses.numpy(), padded_commands.numpy())


def batches(trajectories: Sequence[Trajectory], rng: np.random.Generator) -> list[Batch]:
    """Return all episodes in batches of about one length, in random order."""
    shuffled = [trajectories[i] for i in rng.permutation(len(trajectories))]
    shuffled.sort(key=lambda trajectory: len(trajectory.senses))
    starts = range(0, len(shuffled), BATCH)
    groups = [shuffled[start : start + BATCH] for start in starts]
    return [side_by_side(groups[i]) for i in rng.permutation(len(groups))]


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
        sensed = self.sense(torch.cat([h, commands], dim=-1))
        return sensed, self.act(h), state

    def run_on(self, row: Tensor, state: Any, steps: int) -> tuple[Tensor, Tensor]:
        """Predict rows from memory.

        Args:
            row: (B, S + A) last row that was read.
            state: of the cell before that row.
            steps: T, number of rows to predict.

        Returns:
            x̂ (T, B, S) and â (T, B, A).
        """
        senses = []
        commands = []
        for _ in range(steps):
            h, state = self.cell(row[None], state)
            command = self.act(h[0])
            sensed = self.sense(torch.cat([h[0], command], dim=-1))
            row = torch.cat([sensed, command], dim=-1)
            senses.append(sensed)
            commands.append(command)
        return torch.stack(senses), torch.stack(commands)


@dataclass(frozen=True)
class Training:
    """Settings of ``train``."""

    # kind of cell: "GRU" or "LSTM"
    cell: str = "GRU"
    # hidden units
    hidden: int = 64
    # batches of whole episodes
    updates: int = 1200
    # learning rate of Adam, which decays by a cosine
    rate: float = 1e-2
    # standard deviation of the noise on the rows that the network reads
    noise: float = 0.3


def train(
    trajectories: Sequence[Trajectory],
    settings: Training,
    rng: np.random.Generator,
    network: Recurrent | None = None,
) -> Recurrent:
    """Return a network that has learned from whole episodes; by default a new one."""
    torch.set_num_threads(1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        noise_generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        sensory = trajectories[0].senses.shape[1]
        motor = trajectories[0].commands.shape[1] - 1
        if network is None:
            network = Recurrent(settings.hidden, sensory, motor, settings.cell)
    network.train().requires_grad_(True)
    optimiser, schedule = adam(network, settings.updates, settings.rate)

    done = 0
    while done < settings.updates:
        for batch in batches(trajectories, rng)[: settings.updates - done]:
            padded_senses, padded_commands = tensors_of(batch)
            is_row = padded_commands[:, :, 0].isfinite()  # (T, B), false after an episode
            senses = padded_senses.nan_to_num()
            commands = padded_commands.nan_to_num()
            rows = shifted(senses, commands)
            noise = torch.randn(rows.shape, generator=noise_generator)
            noisy_rows = rows + settings.noise * noise
            sensed, acted, _ = network(noisy_rows, commands)
            sensory_error = ((senses - sensed) ** 2).sum(-1)
            motor_error = ((commands - acted) ** 2).sum(-1)
            error = sensory_error + motor_error  # (T, B)
            descend(error[is_row].mean(), optimiser, schedule)
            done += 1
    return network.eval().requires_grad_(False)


def tensors_of(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return the senses (T, B, S) and the commands (T, B, A) without their constant 1."""
    senses = torch.from_numpy(batch.senses)
    commands = torch.from_numpy(batch.commands[:, :, :-1])
    return senses, commands


def shifted(senses: Tensor, commands: Tensor) -> Tensor:
    """Return rows (T, B, S + A), each that of the row before; zeros before the first."""
    rows = torch.cat([senses, commands], dim=-1)
    return torch.cat([torch.zeros_like(rows[:1]), rows[:-1]])


def expected(network: Recurrent, batch: Batch, cue: int) -> Batch:
    """Return the predictions x̂ (T, B, S) and â (T, B, A), where only the first ``cue`` rows are read."""
    senses, commands = tensors_of(batch)
    rows = shifted(senses, commands)
    sensed, acted, state = network(rows[:cue], commands[:cue])
    steps_alone = len(senses) - cue
    if steps_alone > 0:
        last = torch.cat([senses[cue - 1], commands[cue - 1]], dim=-1)
        senses_alone, commands_alone = network.run_on(last, state, steps_alone)
        sensed = torch.cat([sensed, senses_alone])
        acted = torch.cat([acted, commands_alone])
    return Batch(sensed.numpy(), acted.numpy())
