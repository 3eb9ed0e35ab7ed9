"""What robots are guarded by today: fixed limits on forces and torques."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.spec import StreamSpec


class _Nothing(NamedTuple):
    """A limit remembers nothing; the array only says how many streams there are."""

    streams: NDArray[np.bool_]  # (B,)


class _Limit(StreamModel):
    """A constant to be expected of some channels.

    Args:
        spec: of a stream that has them.

    Raises:
        ValueError: it has none of them.
    """

    shortest = 1
    held_out = 0  # so few numbers are not learned by heart
    channel: str
    """What their names end in."""

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        self._columns = columns(spec, self.channel)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._columns

    def start(self, batch: int, told: Sequence[Told] = ()) -> _Nothing:
        return _Nothing(np.zeros(batch, np.bool_))

    def predict(self, state: _Nothing, rows: NDArray[np.float64]) -> tuple[_Nothing, ModelOutput]:
        error = self.error(rows[:, self._columns])
        return state, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))

    @abstractmethod
    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """(B, X) of what was measured (B, X)."""


class ForceLimit(_Limit):
    """A limit on the wrist's force, as force-guarded motions have it.

    The largest force of the step less the hand's own weight, which is the mean over nominal episodes:
    s = Σ_i (F_i - F̄_i)² [N²]. The limit itself is calibrated, which is kinder to it than a number from a data sheet.
    Source: the guarded move of Will and Grossman 1975, with the calibration of ``asm_gym.detection``.
    """

    kind = "force_limit"
    channel = "wrist_force_peak"

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        force = np.concatenate([e.stream for e in episodes])[:, self._columns]
        return self.restore({"weight": force.mean(axis=0, dtype=np.float64)})

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
        torque = np.concatenate([e.stream for e in episodes])[:, self._columns].astype(np.float64)
        return self.restore({"mean": torque.mean(axis=0), "spread": np.maximum(torque.std(axis=0), 1e-6)})

    def error(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        return (measured - self.learned_["mean"]) / self.learned_["spread"]


def columns(spec: StreamSpec, suffix: str) -> NDArray[np.intp]:
    """Where the channels whose name ends in ``suffix`` stand in a row; one for each arm.

    Raises:
        ValueError: there is none.
    """
    found = [i for name, s in spec.slices.items() if name.endswith(suffix) for i in range(spec.size)[s]]
    if not found:
        raise ValueError(f"this stream has no {suffix}; it has: {', '.join(spec.slices)}")
    return np.array(found, dtype=np.intp)
