"""What robots are guarded by today: fixed limits on forces and torques.

    ε = (x - centre) / scale        of the channels that are limited; the threshold on it is calibrated

force_limit            force of the wrist [N] less the hand's own weight, the mean over nominal episodes: the guarded
                       move of Will and Grossman 1975
external_torque_limit  external torque of each joint, from a momentum observer, over its nominal spread: Haddadin, De
                       Luca and Albu-Schäffer 2017, Eq. 15 (observer) and 31 (a threshold for each joint)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]


class _Limit(StreamModel):
    """A constant prediction for some channels.

    Args:
        spec: of a stream that has them.

    Raises:
        ValueError: it has none of them.
    """

    shortest = 1
    held_out = 0  # so few numbers are not learned by heart
    channel = ""
    """End of their names."""
    scaled = False

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        named = [i for name, s in spec.slices.items() if name.endswith(self.channel) for i in range(spec.size)[s]]
        self._columns = np.array(named, np.intp)
        if not len(self._columns):
            raise ValueError(f"this stream has no {self.channel}; it has: {', '.join(spec.slices)}")

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._columns

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        rows = np.concatenate([e.stream for e in episodes])[:, self._columns].astype(float)
        scale = np.maximum(rows.std(axis=0), 1e-6) if self.scaled else np.ones(rows.shape[1])
        return self.restore({"limit_centre": rows.mean(axis=0), "limit_scale": scale})

    def start(self, batch: int) -> RowHistory:
        return RowHistory.empty(batch, 1, self.spec.size)  # it only says how many streams there are

    def predict(self, state: RowHistory, rows: Floats) -> tuple[RowHistory, ModelOutput]:
        error = (rows[:, self._columns] - self.learned_["limit_centre"]) / self.learned_["limit_scale"]
        return state, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))


class ForceLimit(_Limit):
    """A limit on the largest force of the wrist in a step."""

    kind = "force_limit"
    channel = "wrist_force_peak"


class ExternalTorqueLimit(_Limit):
    """A limit on each joint's external torque, in spreads of its nominal values."""

    kind = "external_torque_limit"
    channel = "external_torque_peak"
    scaled = True
