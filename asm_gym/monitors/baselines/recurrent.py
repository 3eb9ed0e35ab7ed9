"""Recurrent baselines, trained by backpropagation through time: a GRU, and a variational autoencoder.

    GRU        h_t = GRU(h_{t-1}, [v_{t-1}, Δ_{t-1}, u_t])    Δ̂_t, log σ²_t = linear(h_t)    Gaussian log likelihood
    LSTMVAE    z_t = encoder(v_t, Δ_t), v̂_t, Δ̂_t = decoder(z_t)    its prior moves on with the episode

The threshold of the LSTM-VAE's authors, which depends on the latent state, is left out.

Sources: Cho et al. 2014 (EMNLP); Malhotra et al. 2015 (ESANN) for the Mahalanobis distance of a recurrent network's
prediction errors; Park, Hoshi and Kemp 2018 (IEEE RA-L 3(3)), “A multimodal anomaly detector for robot-assisted feeding
using an LSTM-based variational autoencoder”.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.memory.state import RowHistory
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


CORRUPTION = 0.1
"""Standard deviation of the noise that the encoder's inputs are corrupted with."""


class _VAEState(NamedTuple):
    encoder: NDArray[np.float32]  # (B, 2, H) hidden state and cell
    decoder: NDArray[np.float32]  # (B, 2, H)
    history: RowHistory


class _VAEModule(nn.Module):
    def __init__(self, size: int, hidden: int, latent: int) -> None:
        super().__init__()
        self.encoder = nn.LSTM(size, hidden, batch_first=True)
        self.to_latent = nn.Linear(hidden, 2 * latent)
        self.decoder = nn.LSTM(latent, hidden, batch_first=True)
        self.out = nn.Linear(hidden, 2 * size)

    def encode(self, x: Tensor, state: Any = None) -> tuple[Tensor, Tensor, Any]:
        hidden, state = self.encoder(x, state)
        mean, log_variance = self.to_latent(hidden).chunk(2, dim=-1)
        return mean, log_variance.clamp(-8.0, 4.0), state

    def decode(self, z: Tensor, state: Any = None) -> tuple[Tensor, Tensor, Any]:
        hidden, state = self.decoder(z, state)
        mean, log_variance = self.out(hidden).chunk(2, dim=-1)
        return mean, log_variance.clamp(-8.0, 4.0), state


class LSTMVAE(TorchModel):
    """A recurrent variational autoencoder of values and changes; its context is its latent state.

    Args:
        spec: the stream it is to expect.
        hidden_size: H, units of the encoder, and of the decoder.
        latent_size: numbers of the latent state.
    """

    kind = "lstm_vae"

    @typed
    def __init__(self, spec: StreamSpec, hidden_size: int = 128, latent_size: int = 32) -> None:
        super().__init__(spec)
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)
        self.latent_size = check_number("latent_size", latent_size, low=1, whole=True)

    def module(self, senses: StreamScaler) -> nn.Module:
        return _VAEModule(senses.size, self.hidden_size, self.latent_size)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow])

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, progress: Progress
    ) -> None:
        assert isinstance(module, _VAEModule)
        # The centre of the prior moves through the latent space as the episode goes on.
        centre = torch.linspace(-1.0, 1.0, max(len(r.senses) for r in readings))[None, :, None]

        def loss(chosen: NDArray[np.intp], training: bool) -> Tensor:
            x, real = padded([readings[i].senses for i in chosen])
            noise = 1.0 if training else 0.0
            mean, log_variance, _ = module.encode(x + noise * CORRUPTION * torch.randn_like(x))
            z = mean + noise * torch.exp(0.5 * log_variance) * torch.randn_like(mean)
            rebuilt, spread, _ = module.decode(z)
            likelihood = 0.5 * (spread + (x - rebuilt) ** 2 * torch.exp(-spread)).sum(dim=-1)
            prior = (mean - centre[:, : x.shape[1]]) ** 2
            divergence = 0.5 * (log_variance.exp() + prior - 1.0 - log_variance).sum(dim=-1)
            return ((likelihood + divergence) * real).sum() / real.sum()

        train_on_episodes(module, loss, len(readings), rng, progress)

    def start(self, batch: int) -> _VAEState:
        nothing = np.zeros((batch, 2, self.hidden_size), np.float32)
        return _VAEState(nothing, nothing, super().start(batch))

    def predict(self, state: _VAEState, rows: NDArray[np.float64]) -> tuple[_VAEState, ModelOutput]:
        assert isinstance(self.module_, _VAEModule)
        history, r, _ = read_next(self.senses_, state.history, rows)
        z, _, encoder = self.module_.encode(torch.as_tensor(r.senses)[:, None], _cell(state.encoder))
        mean, log_variance, decoder = self.module_.decode(z, _cell(state.decoder))
        error = r.seen * (r.senses - mean.numpy()[:, 0]) * np.exp(-0.5 * log_variance.numpy()[:, 0])
        return _VAEState(_kept(encoder), _kept(decoder), history), ModelOutput(error, z.numpy()[:, 0])


def _cell(state: NDArray[np.float32]) -> tuple[Tensor, ...]:
    """Return hidden state and cell (1, B, H) of a state (B, 2, H)."""
    return tuple(torch.as_tensor(np.ascontiguousarray(state[:, n]))[None] for n in range(2))


def _kept(state: tuple[Tensor, Tensor]) -> NDArray[np.float32]:
    return np.stack([part.numpy()[0] for part in state], axis=1)
