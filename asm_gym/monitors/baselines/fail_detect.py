"""FAIL-Detect's two best scores: random network distillation, and the noise that a flow takes a row for.

    RND      ‖f(x) - g(x)‖²              g random and fixed, f trained to follow it on nominal rows
    logpZO   ‖z(x)‖²                     z where the flow dx/ds = v(x, s), s from 0 to 1, carries x; N(0, I) if nominal

Each is averaged over the last five steps, as there. Source: Xu et al. 2025 (RSS), “Can we detect failures without
failure data? Uncertainty-aware runtime failure detection for imitation learning policies”; Burda et al. 2019 (ICLR) for
distillation, Lipman et al. 2023 (ICLR) for the flow. What is scored there is an embedding of images and the action;
here the sensorimotor row: values, changes and the action.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.monitors.base import State
from asm_gym.monitors.baselines.base import Rows, no_rows, read
from asm_gym.monitors.baselines.torch_model import TorchModel, adam, descend, steps_of
from asm_gym.monitors.monitor import Progress
from asm_gym.scaling import ScaledRows

WINDOW = 5
UPDATES, BATCH = 8000, 256
WIDTH = 256
EMBEDDING = 64
"""Numbers that RND's networks give."""
STAGES = 10
"""Steps of the flow."""
FARTHEST = 30.0
"""Where standardised numbers are cut off: networks of this kind diverge far from what they have seen."""


class _Memory(NamedTuple):
    seen: Rows
    past: NDArray[np.float64]  # (B, WINDOW, X) the squares of the last errors, the newest first; NaN before the first


class _Scored(TorchModel):
    """A network on single rows, whose squared errors are averaged over a few steps."""

    def start_model(self, batch: int) -> _Memory:
        return _Memory(no_rows(batch, self.spec.size), np.full((batch, WINDOW, self.scored), np.nan))

    @property
    def scored(self) -> int:
        """X, errors of a row."""
        return len(self.judged)

    @abstractmethod
    def errors(self, x: Tensor) -> Tensor:
        """(B, X) of rows (B, N)."""

    def predict(self, state: _Memory, rows: NDArray[np.float64]) -> tuple[_Memory, NDArray[Any], NDArray[Any]]:
        reading = read(self.senses_, state.seen, rows)
        error = self.errors(torch.from_numpy(_features(reading))).numpy().astype(np.float64)
        past = np.concatenate([error[:, None] ** 2, state.past[:, :-1]], axis=1)
        return _Memory(state.seen.then(rows), past), error, np.zeros((len(rows), 0))

    def published(self, model: State, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        mean: NDArray[np.float64] = np.nanmean(model.past, axis=1)
        return mean

    @property
    def size(self) -> int:
        """N, numbers in a row as it is scored."""
        return self.senses_.size + len(self.spec.motor)


class _Distillation(nn.Module):
    def __init__(self, size: int) -> None:
        super().__init__()
        self.target = _mlp(size, EMBEDDING, 1).requires_grad_(False)
        self.follower = _mlp(size, EMBEDDING, 2)

    def forward(self, x: Tensor) -> Tensor:
        difference: Tensor = self.follower(x) - self.target(x)
        return difference


class RND(_Scored):
    """Random network distillation; the arguments are those of ``PredictiveMonitor``."""

    kind = "rnd"

    @property
    def scored(self) -> int:
        return EMBEDDING

    def attribute(self, parts: NDArray[np.float64]) -> NDArray[np.float64]:
        """An embedding has no channels: its errors are shared out evenly, and blame nobody."""
        shares = np.zeros((len(parts), self.spec.size))
        shares[:, self.spec.sensory] = parts.sum(axis=1, keepdims=True) / len(self.spec.sensory)
        return shares

    def module(self) -> nn.Module:
        return _Distillation(self.size)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        assert isinstance(module, _Distillation)
        optimiser, schedule = adam(module.follower, UPDATES)
        rows = np.concatenate([_features(r) for r in readings])
        for n, x in enumerate(steps_of(rows, BATCH, UPDATES, rng)):
            tell(n, UPDATES)
            descend((module(x) ** 2).mean(), optimiser, schedule)

    def errors(self, x: Tensor) -> Tensor:
        assert self.module_ is not None
        difference: Tensor = self.module_(x)
        return difference


class LogpZO(_Scored):
    """A flow from rows to noise; the arguments are those of ``PredictiveMonitor``."""

    kind = "logpzo"

    @property
    def judged(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.motor])

    def module(self) -> nn.Module:
        return _mlp(self.size + 1, self.size, 3)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        optimiser, schedule = adam(module, UPDATES)
        rows = np.concatenate([_features(r) for r in readings])
        for n, x in enumerate(steps_of(rows, BATCH, UPDATES, rng)):
            tell(n, UPDATES)
            noise, s = torch.randn_like(x), torch.rand(len(x), 1)
            flow = module(torch.cat([(1.0 - s) * x + s * noise, s], dim=1))
            descend(((flow - (noise - x)) ** 2).mean(), optimiser, schedule)

    def errors(self, x: Tensor) -> Tensor:
        assert self.module_ is not None
        for stage in range(STAGES):
            s = torch.full((len(x), 1), stage / STAGES)
            x = x + self.module_(torch.cat([x, s], dim=1)) / STAGES
        return x


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """(B, N) values, changes of slow channels, and the action."""
    return np.clip(np.hstack([reading.senses, reading.commands[:, :-1]]), -FARTHEST, FARTHEST)


def _mlp(inputs: int, outputs: int, depth: int) -> nn.Module:
    layers: list[nn.Module] = []
    for n in range(depth):
        layers += [nn.Linear(inputs if n == 0 else WIDTH, WIDTH), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(WIDTH, outputs))
