"""The recurrent baseline: a GRU trained by backpropagation through time to predict the next row.

    h_t = GRU(h_{t-1}, [v_{t-1}, Δ_{t-1}, u_t])        Δ̂_t, log σ²_t = linear(h_t)        Gaussian log likelihood

Source: Cho et al. 2014 (EMNLP); Malhotra et al. 2015 (ESANN) for the Mahalanobis distance of a recurrent network's
prediction errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.torch_model import TorchModel, adam, descend, padded
from asm_gym.scaling import ScaledRows, StreamScaler

HIDDEN = 256
UPDATES, EPOCHS, BATCH = 1500, 60, 16
CLOSEST = 20.0
"""Largest error, in standard deviations, whose full weight training feels; contacts would drown all else."""


class _Memory(NamedTuple):
    hidden: NDArray[np.float32]  # (B, H)
    last: NDArray[np.float32]  # (B, S) what was sensed last
    before: NDArray[np.float64]  # (B, D) the row seen last
    steps: NDArray[np.int64]  # (B,)


class _Module(nn.Module):
    def __init__(self, senses: int, commands: int, changes: int) -> None:
        super().__init__()
        self.cell = nn.GRU(senses + commands, HIDDEN, batch_first=True)
        self.out = nn.Linear(HIDDEN, 2 * changes)

    def forward(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        states, _ = self.cell(inputs, hidden)
        mean, log_variance = self.out(states).chunk(2, dim=-1)
        return mean, log_variance.clamp(-12.0, 8.0), states


class GRU(TorchModel):
    """A gated recurrent network; its context is its hidden state."""

    kind = "gru"

    def module(self, senses: StreamScaler) -> nn.Module:
        return _Module(senses.size, len(self.spec.motor) + 1, len(self.spec.sensory))

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        inputs = [np.hstack([np.vstack([r.senses[:1], r.senses[:-1]]), r.commands]) for r in readings]
        each = -(-len(readings) // BATCH)
        epochs = max(1, min(EPOCHS, UPDATES // each))
        optimiser, schedule = adam(module, epochs * each)
        for epoch in range(epochs):
            tell(epoch, epochs)
            order = rng.permutation(len(readings))
            for start in range(0, len(order), BATCH):
                chosen = order[start : start + BATCH]
                x, real = padded([inputs[i] for i in chosen])
                target, _ = padded([readings[i].changes for i in chosen])
                mean, log_variance, _ = module(x)
                error = nn.functional.huber_loss(
                    (target - mean) * torch.exp(-0.5 * log_variance),
                    torch.zeros_like(mean),
                    reduction="none",
                    delta=CLOSEST,
                )
                loss = (error + 0.5 * log_variance).mean(dim=-1)
                descend((loss * real).sum() / real.sum(), optimiser, schedule)

    def start(self, batch: int, skills: Sequence[str] = ()) -> _Memory:
        hidden, last = np.zeros((batch, HIDDEN), np.float32), np.zeros((batch, self.senses_.size), np.float32)
        return _Memory(hidden, last, np.zeros((batch, self.spec.size)), np.zeros(batch, np.int64))

    def predict(self, state: _Memory, rows: NDArray[np.float64]) -> tuple[_Memory, ModelOutput]:
        before = np.where(state.steps[:, None] > 0, state.before, rows)
        r = self.senses_.read(rows, before, before)
        last = np.where(state.steps[:, None] > 0, state.last, r.senses)
        inputs = torch.from_numpy(np.hstack([last, r.commands]))[:, None]
        mean, log_variance, hidden = (
            y.numpy()[:, 0] for y in self.module_(inputs, torch.from_numpy(np.ascontiguousarray(state.hidden))[None])
        )
        error = r.whole * (r.changes - mean) * np.exp(-0.5 * log_variance)
        return _Memory(hidden, r.senses, rows, state.steps + 1), ModelOutput(error, hidden)
