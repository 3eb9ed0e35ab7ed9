"""FAIL-Detect's two best scores: random network distillation, and the noise that a flow takes a row for.

    RND      ‖f(x) - g(x)‖²              g random and fixed, f trained to follow it on nominal rows
    logpZO   ‖z(x)‖²                     z where the flow dx/ds = v(x, s), s from 0 to 1, carries x; N(0, I) if nominal

There each is averaged over the last five rows, and calibrated by a band in time. Here it has one threshold on that
mean (``moving_mean``). Source: Xu et al. 2025 (RSS), “Can we
detect failures without failure data? Uncertainty-aware runtime failure detection for imitation learning policies”;
Burda et al. 2019 (ICLR) for distillation, Lipman et al. 2023 (ICLR) for the flow. There an embedding of images and the
action is scored; here the sensorimotor row: values, changes and the action.

The networks here are smaller: three layers of 512, 0.6 million weights, where the authors train a one-dimensional U-Net
of 256, 512 and 1024 channels, 59 million. On a core that is an hour for each pass over 48,000 rows, and a row takes
longer to score than it lasts at 20 Hz: a size for a graphics card. ``width`` and ``updates`` go part of the way.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.memory.state import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.torch_model import TorchModel, adam, descend, steps_of
from asm_gym.monitors.stream_model import no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

BATCH = 256
EMBEDDING = 64
"""Numbers that RND's networks give."""
STAGES = 10
"""Steps of the flow."""
FARTHEST = 30.0
"""Where standardised numbers are cut off: networks of this kind diverge far from what they have seen."""


class _Rowwise(TorchModel):
    """A network on single rows: values, changes and the command.

    Args:
        spec: the stream it is to expect.
        width: of each hidden layer.
        updates: of the weights.
    """

    @typed
    def __init__(self, spec: StreamSpec, width: int = 256, updates: int = 8000) -> None:
        super().__init__(spec)
        self.width = check_number("width", width, low=1, whole=True)
        self.updates = check_number("updates", updates, low=1, whole=True)

    def start(self, batch: int) -> RowHistory:
        return RowHistory.empty(batch, 1, self.spec.size)

    @abstractmethod
    def errors(self, x: Tensor) -> Tensor:
        """(B, X) of rows (B, N)."""

    def advance(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, reading, _ = read_next(self.senses_, state, rows)
        error = self.errors(torch.as_tensor(_features(reading))).cpu().numpy().astype(np.float64)
        return state, ModelOutput(error, no_context(rows))

    def size(self, senses: StreamScaler) -> int:
        """N, numbers in a row as it is scored."""
        return senses.size + len(self.spec.motor)


class _Distillation(nn.Module):
    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.target = _mlp(size, EMBEDDING, 1, width).requires_grad_(False)
        self.follower = _mlp(size, EMBEDDING, 2, width)

    def forward(self, x: Tensor) -> Tensor:
        difference: Tensor = self.follower(x) - self.target(x)
        return difference


class RND(_Rowwise):
    """Random network distillation."""

    kind = "rnd"

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """An embedding has no channels: its errors blame nobody."""
        return np.full(EMBEDDING, -1)

    def module(self, senses: StreamScaler) -> nn.Module:
        return _Distillation(self.size(senses), self.width)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        assert isinstance(module, _Distillation)
        optimiser, schedule = adam(module.follower, self.updates)
        rows = np.concatenate([_features(r) for r in readings])
        for n, x in enumerate(steps_of(rows, BATCH, self.updates, rng)):
            tell(n, self.updates)
            descend((module(x) ** 2).mean(), optimiser, schedule)

    def errors(self, x: Tensor) -> Tensor:
        difference: Tensor = self.module_(x)
        return difference


class LogpZO(_Rowwise):
    """A flow from rows to noise."""

    kind = "logpzo"

    @typed
    def __init__(self, spec: StreamSpec, width: int = 512, updates: int = 8000) -> None:
        super().__init__(spec, width, updates)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.motor])

    def module(self, senses: StreamScaler) -> nn.Module:
        return _mlp(self.size(senses) + 1, self.size(senses), 3, self.width)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        optimiser, schedule = adam(module, self.updates)
        rows = np.concatenate([_features(r) for r in readings])
        for n, x in enumerate(steps_of(rows, BATCH, self.updates, rng)):
            tell(n, self.updates)
            noise, s = torch.randn_like(x), torch.rand(len(x), 1)
            flow = module(torch.cat([(1.0 - s) * x + s * noise, s], dim=1))
            descend(((flow - (noise - x)) ** 2).mean(), optimiser, schedule)

    def errors(self, x: Tensor) -> Tensor:
        for stage in range(STAGES):
            s = torch.full((len(x), 1), stage / STAGES)
            x = x + self.module_(torch.cat([x, s], dim=1)) / STAGES
        return x


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """(B, N) values, changes of slow channels, and the action."""
    return np.clip(np.hstack([reading.senses, reading.commands[:, :-1]]), -FARTHEST, FARTHEST)


def _mlp(inputs: int, outputs: int, depth: int, width: int) -> nn.Module:
    layers: list[nn.Module] = []
    for n in range(depth):
        layers += [nn.Linear(inputs if n == 0 else width, width), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))
