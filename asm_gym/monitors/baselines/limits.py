"""What robots are guarded by today: fixed limits on forces and torques."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.monitor import CalibratedMonitor, Progress, columns
from asm_gym.stream import StreamSpec


class _Nothing(NamedTuple):
    """A limit remembers nothing; the array only says how many streams there are."""

    streams: NDArray[np.bool_]  # (B,)


class ForceLimit(CalibratedMonitor):
    """A limit on the wrist's force, as force-guarded motions have it.

    The largest force of the step less the hand's own weight, which is the mean over nominal episodes:
    s = Σ_i (F_i - F̄_i)² [N²]. The limit itself is calibrated, which is kinder to it than a number from a data sheet.
    Source: the guarded move of Will and Grossman 1975, with the calibration of ``asm_gym.detection``.
    """

    kind = "force_limit"

    def __init__(self, spec: StreamSpec, seed: int = 0) -> None:
        super().__init__(spec, seed)
        self._force = columns(spec, "wrist_force_peak")

    def learn(self, streams: Sequence[NDArray[np.float32]], progress: Progress) -> dict[str, NDArray[Any]]:
        return {"weight": np.concatenate(streams)[:, self._force].mean(axis=0, dtype=np.float64)}

    def start(self, batch: int) -> _Nothing:
        return _Nothing(np.zeros(batch, np.bool_))

    def shares(self, state: _Nothing, rows: NDArray[np.float64]) -> tuple[_Nothing, NDArray[np.float64]]:
        attribution = np.zeros(rows.shape)
        attribution[:, self._force] = (rows[:, self._force] - self.learned_["weight"]) ** 2
        return state, attribution


class ExternalTorqueLimit(CalibratedMonitor):
    """A limit on each joint's external torque, as a momentum observer gives it.

    s = max_i |τ_ext,i - τ̄_i| / σ_i, each joint in units of its nominal spread; the channel itself comes from the
    dynamics that were frozen when the model was loaded.
    Source: Haddadin, De Luca and Albu-Schäffer 2017, Eq. 15 (observer) and 31 (a threshold for each joint).
    """

    kind = "external_torque_limit"

    def __init__(self, spec: StreamSpec, seed: int = 0) -> None:
        super().__init__(spec, seed)
        self._torque = columns(spec, "external_torque_peak")

    def learn(self, streams: Sequence[NDArray[np.float32]], progress: Progress) -> dict[str, NDArray[Any]]:
        torque = np.concatenate(streams)[:, self._torque].astype(np.float64)
        return {"mean": torque.mean(axis=0), "spread": np.maximum(torque.std(axis=0), 1e-6)}

    def start(self, batch: int) -> _Nothing:
        return _Nothing(np.zeros(batch, np.bool_))

    def shares(self, state: _Nothing, rows: NDArray[np.float64]) -> tuple[_Nothing, NDArray[np.float64]]:
        score = np.abs(rows[:, self._torque] - self.learned_["mean"]) / self.learned_["spread"]  # (B, joints)
        worst = score.argmax(axis=1)
        attribution = np.zeros(rows.shape)
        batch = np.arange(len(rows))
        attribution[batch, self._torque[worst]] = score[batch, worst]
        return state, attribution
