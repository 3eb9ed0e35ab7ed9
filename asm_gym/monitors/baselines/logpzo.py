"""FAIL-Detect's best score: the noise that a flow takes a row for.

    logpZO   ‖z(x)‖²        z where the flow dx/ds = v(x, s), s from 0 to 1, carries x; N(0, I) if nominal

There it is averaged over the last five rows, and calibrated by a band in time; here it has one threshold on that mean
(``moving_mean``). There an embedding of images and the action is scored; here the sensorimotor row. The network here is
smaller: three layers of 512, where the authors train a one-dimensional U-Net of 59 million weights, which takes longer
for a row on a core than the row lasts at 20 Hz.

Source: Xu et al. 2025 (RSS), “Can we detect failures without failure data? Uncertainty-aware runtime failure detection
for imitation learning policies”; Lipman et al. 2023 (ICLR) for the flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.memory.learning import shuffled
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.torch_model import TorchModel, adam, descend
from asm_gym.monitors.stream_model import no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

BATCH = 256
STAGES = 10  # steps of the flow
FARTHEST = 30.0  # where standardised numbers are cut off: networks of this kind diverge far from what they have seen


class LogpZO(TorchModel):
    """A flow from rows to noise: values, changes and the command.

    Args:
        spec: the stream it is to expect.
        width: of each hidden layer.
        updates: of the weights.
    """

    kind = "logpzo"

    @typed
    def __init__(self, spec: StreamSpec, width: int = 512, updates: int = 8000) -> None:
        super().__init__(spec)
        self.width = check_number("width", width, low=1, whole=True)
        self.updates = check_number("updates", updates, low=1, whole=True)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.motor])

    def module(self, senses: StreamScaler) -> nn.Module:
        size = senses.size + len(self.spec.motor)
        widths = [size + 1, *[self.width] * 3]
        layers = [part for n, m in pairwise(widths) for part in (nn.Linear(n, m), nn.SiLU())]
        return nn.Sequential(*layers, nn.Linear(self.width, size))

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, progress: Progress
    ) -> None:
        optimiser, schedule = adam(module, self.updates)
        rows = np.concatenate([_features(r) for r in readings])
        for n, chosen in zip(range(self.updates), shuffled(len(rows), BATCH, rng), strict=False):
            progress(n, self.updates)
            x = torch.as_tensor(rows[chosen])
            noise, s = torch.randn_like(x), torch.rand(len(x), 1)
            flow = module(torch.cat([(1.0 - s) * x + s * noise, s], dim=1))
            descend(((flow - (noise - x)) ** 2).mean(), optimiser, schedule)

    def predict(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, reading, _ = read_next(self.senses_, state, rows)
        error = self._noise(torch.as_tensor(_features(reading))).numpy().astype(np.float64)
        return state, ModelOutput(error, no_context(rows))

    def _noise(self, x: Tensor) -> Tensor:
        """Return z (B, N) of rows (B, N)."""
        for stage in range(STAGES):
            s = torch.full((len(x), 1), stage / STAGES)
            x = x + self.module_(torch.cat([x, s], dim=1)) / STAGES
        return x


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """Return values, changes of slow channels, and the action (B, N)."""
    return np.clip(np.hstack([reading.senses, reading.commands[:, :-1]]), -FARTHEST, FARTHEST)
