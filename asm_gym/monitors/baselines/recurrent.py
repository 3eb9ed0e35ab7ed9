"""A recurrent baseline, trained by backpropagation through time: a GRU.

    h_t = GRU(h_{t-1}, [v_{t-1}, Δ_{t-1}, u_t])    Δ̂_t, log σ²_t = linear(h_t)    Gaussian log likelihood

Sources: Cho et al. 2014 (EMNLP); Malhotra et al. 2015 (ESANN) for the Mahalanobis distance of a recurrent network's
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
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.torch_model import TorchModel, padded, train_on_episodes
from asm_gym.monitors.stream_model import read_next
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

LARGEST_ERROR = 20.0
"""Largest error in training, in standard deviations, that has its full weight; contacts would drown all else."""


class _GRUState(NamedTuple):
    hidden: NDArray[np.float32]  # (B, H)
    last: NDArray[np.float32]  # (B, S) what was sensed last
    history: RowHistory


class _GRUModule(nn.Module):
    def __init__(self, senses: int, commands: int, changes: int, hidden: int) -> None:
        super().__init__()
        self.cell = nn.GRU(senses + commands, hidden, batch_first=True)
        self.out = nn.Linear(hidden, 2 * changes)

    def forward(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        states, _ = self.cell(inputs, hidden)
        mean, log_variance = self.out(states).chunk(2, dim=-1)
        return mean, log_variance.clamp(-12.0, 8.0), states


class GRU(TorchModel):
    """A gated recurrent network; its context is its hidden state.

    Args:
        spec: the stream it is to expect.
        hidden_size: H, hidden units.
    """

    kind = "gru"

    @typed
    def __init__(self, spec: StreamSpec, hidden_size: int = 128) -> None:
        super().__init__(spec)
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)

    def module(self, senses: StreamScaler) -> nn.Module:
        return _GRUModule(senses.size, len(self.spec.motor) + 1, len(self.spec.sensory), self.hidden_size)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, progress: Progress
    ) -> None:
        inputs = [np.hstack([np.vstack([r.senses[:1], r.senses[:-1]]), r.commands]) for r in readings]

        def loss(chosen: NDArray[np.intp], training: bool) -> Tensor:
            x, real = padded([inputs[i] for i in chosen])
            return _loss(module, x, padded([readings[i].changes for i in chosen])[0], real)

        train_on_episodes(module, loss, len(readings), rng, progress)

    def start(self, batch: int) -> _GRUState:
        hidden, rows = np.zeros((batch, self.hidden_size), np.float32), np.zeros((batch, self.spec.size))
        last = self.senses_.read(rows, rows, rows).senses
        return _GRUState(hidden, last, super().start(batch))

    def predict(self, state: _GRUState, rows: NDArray[np.float64]) -> tuple[_GRUState, ModelOutput]:
        history, r, _ = read_next(self.senses_, state.history, rows)
        last = np.where(state.history.steps[:, None] > 0, state.last, r.senses)
        inputs = torch.as_tensor(np.hstack([last, r.commands]))[:, None]
        found = self.module_(inputs, torch.as_tensor(np.ascontiguousarray(state.hidden))[None])
        mean, log_variance, hidden = (y.numpy()[:, 0] for y in found)
        error = r.whole * (r.changes - mean) * np.exp(-0.5 * log_variance)
        return _GRUState(hidden, r.senses, history), ModelOutput(error, hidden)


def _loss(module: nn.Module, inputs: Tensor, changes: Tensor, real: Tensor) -> Tensor:
    """Return the mean over the steps (B, T) that are ``real``."""
    mean, log_variance, _ = module(inputs)
    normalised = (changes - mean) * torch.exp(-0.5 * log_variance)
    error = nn.functional.huber_loss(normalised, torch.zeros_like(mean), reduction="none", delta=LARGEST_ERROR)
    loss: Tensor = (error + 0.5 * log_variance).mean(dim=-1)
    return (loss * real).sum() / real.sum()
