"""NEXT: an LSTM learns which torque the motors need in free motion; what is measured beyond that comes from outside.

    τ̂_t = MLP(LSTM(q_≤t, q̇_≤t, u_≤t))        τ_ext,t = τ_t - τ̂_t, of each joint in its spread in free motion

It learns from ten minutes in which nothing is touched, as the simulator knows where it does; elsewhere from the first
ten minutes. Two layers of 128 units, and a head of 256.
Source: Oh et al. 2026 (FACTR 2, arXiv 2606.12406). Two departures: they read a window of 50 rows anew at each step,
here the state is carried on from the beginning; and for u they have how far each joint is from where it was commanded,
which a controller in the hand's space does not say: it is the action here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.limits import columns
from asm_gym.monitors.baselines.torch_model import TorchModel, converge, descend, padded, parted
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

EPOCHS, BATCH, LAYERS, HEAD, DROPOUT = 200, 16, 2, 256, 0.1
"""Passes at most, episodes at a time, and what the network is made of."""
MINUTES, TOUCHED = 10.0, 0.1
"""How much free motion is learned from, and the contact force above which it is none [N]."""


class _Memory(NamedTuple):
    hidden: NDArray[np.float32]  # (B, 2, LAYERS, H) of the LSTM, and its cells


class _Module(nn.Module):
    def __init__(self, inputs: int, torques: int, hidden: int) -> None:
        super().__init__()
        self.cell = nn.LSTM(inputs, hidden, LAYERS, batch_first=True, dropout=DROPOUT)
        self.out = nn.Sequential(nn.Linear(hidden, HEAD), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(HEAD, torques))
        self.register_buffer("usual", torch.ones(torques))

    def forward(self, inputs: Tensor, state: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor, Tensor]:
        states, (hidden, cell) = self.cell(inputs, state)
        return self.out(states), hidden, cell


class NEXT(TorchModel):
    """External torques by what free motion needs; its context is the state of its network.

    Args:
        spec: of a stream with joint positions, velocities and measured torques.
        hidden_size: H, units of each layer.
        learning_rate: of Adam, before the first plateau.

    Raises:
        ValueError: it has none of them.
    """

    kind = "next"

    @typed
    def __init__(self, spec: StreamSpec, hidden_size: int = 128, learning_rate: float = 1e-3) -> None:
        super().__init__(spec)
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)
        self.learning_rate = check_number("learning_rate", learning_rate, above=0.0)
        self._torques = columns(spec, "measured_torque")
        places = np.concatenate([columns(spec, "joint_position"), columns(spec, "joint_velocity")])
        self._sensed, self._judged = (np.searchsorted(spec.sensory, c) for c in (places, self._torques))
        self._free: list[NDArray[np.bool_]] = []

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._torques

    def module(self, senses: StreamScaler) -> nn.Module:
        return _Module(len(self._sensed) + len(self.spec.motor) + 1, len(self._judged), self.hidden_size)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        self._free = [free_rows(episode) for episode in episodes]
        super().fit(episodes, rng, progress)
        self._free = []
        return self

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        assert isinstance(module, _Module)
        order = [i for i in rng.permutation(len(readings)) if self._free[i].any()]
        minutes = np.cumsum([self._free[i].sum() for i in order]) * self.spec.dt / 60
        order = order[: 1 + int(np.searchsorted(minutes, MINUTES))]
        if not order:
            raise ValueError("nothing of these episodes is free motion: something is touched in every row")
        trained, fresh = parted(len(order), rng)

        def batch(chosen: NDArray[np.intp]) -> tuple[Tensor, Tensor, Tensor]:
            own = [order[i] for i in chosen]
            x, _ = padded([self._inputs(readings[i]) for i in own])
            torques, _ = padded([readings[i].senses[:, self._judged] for i in own])
            free, _ = padded([self._free[i][:, None].astype(np.float32) for i in own])
            return x, torques, free

        def loss(chosen: NDArray[np.intp]) -> Tensor:
            x, torques, free = batch(chosen)
            squared = ((module(x)[0] - torques) ** 2).mean(dim=-1, keepdim=True)
            mean: Tensor = (squared * free).sum() / free.sum()
            return mean

        def epoch(optimiser: torch.optim.Optimizer) -> None:
            module.train()
            mixed = rng.permutation(trained)
            for start in range(0, len(mixed), BATCH):
                descend(loss(mixed[start : start + BATCH]), optimiser)
            module.eval()

        converge(module, epoch, lambda: loss(fresh), EPOCHS, tell, self.learning_rate)
        with torch.no_grad():
            x, torques, free = batch(fresh)
            errors = (module.eval()(x)[0] - torques)[free[..., 0] > 0]
            module.usual.copy_(errors.square().mean(dim=0).sqrt().clamp(min=1e-3))  # type: ignore[operator]

    def start(self, batch: int, told: Sequence[Told] = ()) -> _Memory:
        return _Memory(np.zeros((batch, 2, LAYERS, self.hidden_size), np.float32))

    def advance(self, state: _Memory, rows: NDArray[np.float64]) -> tuple[_Memory, ModelOutput]:
        assert isinstance(self.module_, _Module)
        r = self.senses_.read(rows, rows, rows)
        before = torch.as_tensor(np.ascontiguousarray(state.hidden.transpose(1, 2, 0, 3)))
        torques, hidden, cell = self.module_(torch.as_tensor(self._inputs(r))[:, None], (before[0], before[1]))
        error = r.whole * (r.senses[:, self._judged] - torques.cpu().numpy()[:, 0]) / self.module_.usual.cpu().numpy()  # type: ignore[operator]
        now = torch.stack([hidden, cell]).cpu().numpy().transpose(2, 0, 1, 3)
        return _Memory(now), ModelOutput(error, np.ascontiguousarray(now[:, 0, -1]))

    def _inputs(self, reading: ScaledRows) -> NDArray[np.float32]:
        return np.hstack([reading.senses[:, self._sensed], reading.commands])


def free_rows(episode: Episode) -> NDArray[np.bool_]:
    """(T,) where nothing is touched; everywhere, where the episode does not know."""
    force = episode.contact_force
    if not len(force):
        return np.ones(len(episode), np.bool_)
    return np.repeat(force < TOUCHED, len(episode) // len(force))
