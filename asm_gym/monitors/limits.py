"""What robots are guarded by today: fixed limits on forces and torques."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.base import State
from asm_gym.monitors.calibrated import CalibratedMonitor, columns
from asm_gym.stream import StreamSpec


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

    def learn(self, streams: Sequence[NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        return {"weight": np.concatenate(streams)[:, self._force].mean(axis=0)}

    def initial_state(self, batch: int = 1) -> State:
        return None

    def shares(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        attribution = np.zeros(rows.shape)
        attribution[:, self._force] = (rows[:, self._force] - self.learned_["weight"]) ** 2
        return None, attribution


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

    def learn(self, streams: Sequence[NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        torque = np.concatenate(streams)[:, self._torque]
        return {"mean": torque.mean(axis=0), "spread": np.maximum(torque.std(axis=0), 1e-6)}

    def initial_state(self, batch: int = 1) -> State:
        return None

    def shares(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        score = np.abs(rows[:, self._torque] - self.learned_["mean"]) / self.learned_["spread"]  # (B, joints)
        worst = score.argmax(axis=1)
        attribution = np.zeros(rows.shape)
        batch = np.arange(len(rows))
        attribution[batch, self._torque[worst]] = score[batch, worst]
        return None, attribution
