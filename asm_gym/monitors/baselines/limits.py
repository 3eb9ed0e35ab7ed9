"""What robots are guarded by today: fixed limits on forces, torques, and each channel."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.spec import StreamSpec


class _Nothing(NamedTuple):
    """A limit remembers nothing; the array only says how many streams there are."""

    streams: NDArray[np.bool_]  # (B,)


class _Limit(StreamModel):
    """A constant prediction for some channels.

    Args:
        spec: of a stream that has them.

    Raises:
        ValueError: it has none of them.
    """

    shortest = 1
    held_out = 0  # so few numbers are not learned by heart
    channel: str
    """End of their names; empty for all senses."""

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        named = [i for name, s in spec.slices.items() if name.endswith(self.channel) for i in range(spec.size)[s]]
        self._columns = np.array(named, np.intp) if self.channel else spec.sensory
        if not len(self._columns):
            raise ValueError(f"this stream has no {self.channel}; it has: {', '.join(spec.slices)}")

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._columns

    def start(self, batch: int) -> _Nothing:
        return _Nothing(np.zeros(batch, np.bool_))

    def predict(self, state: _Nothing, rows: NDArray[np.float64]) -> tuple[_Nothing, ModelOutput]:
        error = self.error(rows[:, self._columns])
        return state, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))

    def rows(self, episodes: Sequence[Episode]) -> NDArray[np.float64]:
        """Return what these channels measured (N, X)."""
        return np.concatenate([e.stream for e in episodes])[:, self._columns].astype(np.float64)

    @abstractmethod
    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error (B, X) of what was measured (B, X)."""


class ForceLimit(_Limit):
    """A limit on the wrist's force, as force-guarded motions have it.

    The largest force of the step less the hand's own weight, which is the mean over nominal episodes:
    s = Σ_i (F_i - F̄_i)² [N²]. The limit itself is calibrated, which is kinder to it than a number from a data sheet.
    Source: the guarded move of Will and Grossman 1975, with the calibration of ``asm_gym.detection``.
    """

    kind = "force_limit"
    channel = "wrist_force_peak"

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        return self.restore({"weight": self.rows(episodes).mean(axis=0)})

    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        return measured - self.learned_["weight"]


class ExternalTorqueLimit(_Limit):
    """A limit on each joint's external torque, as a momentum observer gives it.

    s = max_i |τ_ext,i - τ̄_i| / σ_i, each joint in units of its nominal spread; the channel itself comes from the
    dynamics that were frozen when the model was loaded.
    Source: Haddadin, De Luca and Albu-Schäffer 2017, Eq. 15 (observer) and 31 (a threshold for each joint).
    """

    kind = "external_torque_limit"
    channel = "external_torque_peak"

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        torque = self.rows(episodes)
        return self.restore({"mean": torque.mean(axis=0), "spread": np.maximum(torque.std(axis=0), 1e-6)})

    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        return (measured - self.learned_["mean"]) / self.learned_["spread"]


class ChannelLimit(_Limit):
    """A limit on each channel: its distance from the middle of its nominal range, in halves of that range."""

    kind = "channel_limit"
    channel = ""

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        rows = self.rows(episodes)
        low, high = rows.min(axis=0), rows.max(axis=0)
        return self.restore({"middle": (low + high) / 2, "half": np.maximum((high - low) / 2, 1e-9)})

    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        return (measured - self.learned_["middle"]) / self.learned_["half"]
