"""FAIL-Detect's two best scores: random network distillation, and the noise that a flow takes a row for.

    RND      ‖f(x) - g(x)‖²              g random and fixed, f trained to follow it on nominal rows
    logpZO   ‖z(x)‖²                     z where the flow dx/ds = v(x, s), s from 0 to 1, carries x; N(0, I) if nominal

There each is averaged over the last five rows, and calibrated by a band in time; here it has one threshold on that
mean (``moving_mean``). There an embedding of images and the action is scored; here the sensorimotor row. The networks
here are smaller: three layers of 512, where the authors train a one-dimensional U-Net of 59 million weights, which
takes longer for a row on a core than the row lasts at 20 Hz.

Source: Xu et al. 2025 (RSS), “Can we detect failures without failure data? Uncertainty-aware runtime failure detection
for imitation learning policies”; Burda et al. 2019 (ICLR) for distillation, Lipman et al. 2023 (ICLR) for the flow.
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
from asm_gym.monitors.baselines.torch_model import TorchModel, train_on_rows
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


class _RowModel(TorchModel):
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

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, progress: Progress
    ) -> None:
        rows = np.concatenate([_features(r) for r in readings])
        train_on_rows(self.trained(module), lambda x: self.loss(module, x), rows, BATCH, self.updates, rng, progress)

    def predict(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, reading, _ = read_next(self.senses_, state, rows)
        error = self.errors(torch.as_tensor(_features(reading))).numpy().astype(np.float64)
        return state, ModelOutput(error, no_context(rows))

    def row_size(self, senses: StreamScaler) -> int:
        """Return N, the numbers of a row as it is scored."""
        return senses.size + len(self.spec.motor)

    def trained(self, module: nn.Module) -> nn.Module:
        """Return the part of the network that is trained."""
        return module

    @abstractmethod
    def loss(self, module: nn.Module, x: Tensor) -> Tensor:
        """Return the loss of rows (B, N)."""

    @abstractmethod
    def errors(self, x: Tensor) -> Tensor:
        """Return the errors (B, X) of rows (B, N)."""


class RND(_RowModel):
    """Random network distillation."""

    kind = "rnd"

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """An embedding has no channels: its errors blame nobody."""
        return np.full(EMBEDDING, -1)

    def module(self, senses: StreamScaler) -> nn.Module:
        size = self.row_size(senses)
        target = _mlp(size, EMBEDDING, 1, self.width).requires_grad_(False)
        return nn.ModuleDict({"target": target, "follower": _mlp(size, EMBEDDING, 2, self.width)})

    def trained(self, module: nn.Module) -> nn.Module:
        return module.get_submodule("follower")

    def loss(self, module: nn.Module, x: Tensor) -> Tensor:
        return (_difference(module, x) ** 2).mean()

    def errors(self, x: Tensor) -> Tensor:
        return _difference(self.module_, x)


class LogpZO(_RowModel):
    """A flow from rows to noise."""

    kind = "logpzo"

    @typed
    def __init__(self, spec: StreamSpec, width: int = 512, updates: int = 8000) -> None:
        super().__init__(spec, width, updates)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.motor])

    def module(self, senses: StreamScaler) -> nn.Module:
        return _mlp(self.row_size(senses) + 1, self.row_size(senses), 3, self.width)

    def loss(self, module: nn.Module, x: Tensor) -> Tensor:
        noise, s = torch.randn_like(x), torch.rand(len(x), 1)
        flow = module(torch.cat([(1.0 - s) * x + s * noise, s], dim=1))
        return ((flow - (noise - x)) ** 2).mean()

    def errors(self, x: Tensor) -> Tensor:
        for stage in range(STAGES):
            s = torch.full((len(x), 1), stage / STAGES)
            x = x + self.module_(torch.cat([x, s], dim=1)) / STAGES
        return x


def _difference(module: nn.Module, x: Tensor) -> Tensor:
    difference: Tensor = module.get_submodule("follower")(x) - module.get_submodule("target")(x)
    return difference


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """Return values, changes of slow channels, and the action (B, N)."""
    return np.clip(np.hstack([reading.senses, reading.commands[:, :-1]]), -FARTHEST, FARTHEST)


def _mlp(inputs: int, outputs: int, depth: int, width: int) -> nn.Module:
    layers: list[nn.Module] = []
    for n in range(depth):
        layers += [nn.Linear(inputs if n == 0 else width, width), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))
