"""The limits in use today, on force and torque.

    ε = (x - centre) / scale

Force of the wrist [N] is less the hand's own weight, the mean over nominal episodes; external torque of each joint is
from a momentum observer, over its nominal spread.

Sources: Will and Grossman 1975 for the guarded move; Haddadin, De Luca and Albu-Schäffer 2017, Eq. 15 and 31, for
torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.channel_columns import columns_where
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context, zero_unless_finite
from asm_gym.spec import StreamSpec

LEAST_CHANNEL_SPREAD = 1e-6  # of a channel [its unit]


class FixedLimit(StreamModel):
    """A constant prediction for some channels. Raises ValueError where the stream has none of them."""

    shortest = 1
    held_out = 0  # so few numbers are not learned by heart
    channel = ""  # end of their names
    scaled = False

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        self._columns = columns_where(spec, lambda channel: channel.name.endswith(self.channel))
        if not len(self._columns):
            raise ValueError(f"this stream has no {self.channel}; it has: {', '.join(spec.slices)}")

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._columns

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = np.concatenate([episode.stream for episode in episodes])
        rows = streams[:, self._columns].astype(float)
        scale = np.ones(rows.shape[1])
        if self.scaled:
            scale = np.maximum(rows.std(axis=0), LEAST_CHANNEL_SPREAD)
        return self.restore({"limit_centre": rows.mean(axis=0), "limit_scale": scale})

    def start(self, batch: int) -> RowHistory:
        return RowHistory.empty(batch, 1, self.spec.size)  # it only says how many streams there are

    def predict(
        self, state: RowHistory, rows: NDArray[np.float64]
    ) -> tuple[RowHistory, ModelOutput]:
        distance = rows[:, self._columns] - self.learned_["limit_centre"]
        error = distance / self.learned_["limit_scale"]
        return state, ModelOutput(zero_unless_finite(error), no_context(rows))


class ForceLimit(FixedLimit):
    """A limit on the largest force of the wrist in a step."""

    kind = "force_limit"
    channel = "wrist_force_peak"


class ExternalTorqueLimit(FixedLimit):
    """A limit on each joint's external torque, in spreads of its nominal values."""

    kind = "external_torque_limit"
    channel = "external_torque_peak"
    scaled = True
