"""Values beside changes: a push that is held is explained by its own past to who judges changes, and not by the rest.

    s = max(s_changes / √f, s_values)       each is 1 at what it seldom exceeds in nominal episodes
    f = max(1, (1 + τ h)/(1 + τ h̃))         h: the leverage of a row, h̃ its median in what was learned
    h = zᵀ (ZᵀZ + λ N)⁻¹ z                  z: what changes are expected from, and 1;  τ: rows of a tenth of a second

A regression's error in a fresh row has the variance σ² (1 + h). Rows that follow each other tell the same, so that as
many as a tenth of a second holds count as one. Long logs make h small, and f 1; of a few minutes it says how little is
known of places that they do not show. Errors of values are not whitened: how those of a few minutes belong together is
not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import EvidenceDetection
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.monitors.base import State, Surprise
from asm_gym.monitors.baselines.association_values import MOST_FAR, STIFFNESS, ValueAssociation
from asm_gym.monitors.baselines.base import associated
from asm_gym.monitors.monitor import CalibratedMonitor, MonitorState
from asm_gym.monitors.skill import taken_up
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec

PREFIX = "values."
"""What the names of its arrays begin with in a checkpoint."""

ALIKE_S = 0.1
"""τ [s]."""


class Values(NamedTuple):
    """What judges values; empty where nobody asked for it, and where nothing tells any.

    Attributes:
        monitor: of values alone.
        far: (I + 1, I + 1) of which zᵀ far z is τ h / (1 + τ h̃); empty in files from before.
        usual: 1 / (1 + τ h̃).
    """

    monitor: CalibratedMonitor | None = None
    far: NDArray[np.float64] = np.zeros((0, 0))
    usual: float = 1.0

    @classmethod
    def learned(cls, episodes: Sequence[Episode], seed: int, urdf: str = "") -> Self:
        """Fitted to nominal episodes; ``urdf`` is the text of a body model, or empty."""
        monitor = _monitor(episodes[0].spec, seed, urdf).fit(episodes)
        if not len(monitor.learned_["judged_values"]):
            return cls()
        senses = _senses(monitor)
        if senses.inputs > MOST_FAR:
            return cls(monitor)
        z = np.concatenate([_with_one(senses.read_episode(e.stream).inputs) for e in episodes])
        alike = ALIKE_S / episodes[0].spec.dt / len(z)
        leverage = alike * np.linalg.inv(z.T @ z / len(z) + STIFFNESS * np.eye(z.shape[1]))
        usual = 1.0 / (1.0 + float(np.median(_squares(z, leverage))))
        return cls(monitor, usual * leverage, usual)

    @classmethod
    def found(cls, spec: StreamSpec, arrays: Arrays, seed: int, urdf: str = "") -> Self:
        """As arrays by their names without the prefix say. Raises ValueError or KeyError where they do not fit."""
        if not arrays:
            return cls()
        own = {n: a for n, a in arrays.items() if n not in ("leverage", "usual")}
        monitor = taken_up(_monitor(spec, seed, urdf), own)
        if "leverage" not in arrays:
            return cls(monitor)
        size, far = _senses(monitor).inputs + 1, arrays["leverage"]
        if far.shape not in ((size, size), (0, 0)):
            raise ValueError(f"the leverage of values should be of shape {(size, size)}, found {far.shape}")
        return cls(monitor, far, float(arrays["usual"]))

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All that a checkpoint needs of it, by name."""
        if self.monitor is None:
            return {}
        kept = {**self.monitor.learned_, "leverage": self.far, "usual": np.array(self.usual)}
        return {PREFIX + name: array for name, array in kept.items()}

    def start(self, batch: int) -> State:
        """The state before the first row."""
        return () if self.monitor is None else self.monitor.initial_state(batch)

    def reset(self, state: State) -> State:
        """The state with the evidence so far forgotten."""
        return () if self.monitor is None else self.monitor.reset_evidence(state)

    def step(
        self, before: State, rows: NDArray[np.float64], now: MonitorState, changes: Surprise
    ) -> tuple[MonitorState, Surprise]:
        """The greater surprise in each row (B, D), attributed as that one is; the state holds its own too."""
        if self.monitor is None:
            return now, changes
        root = self._farther(before, rows)
        new, values = self.monitor.observe(before, rows)
        value, shares = changes.value / root, changes.attribution / root[:, None]
        held = values.value > value
        shares = np.where(held[:, None], values.attribution, shares)
        return now._replace(values=new), changes._replace(value=np.where(held, values.value, value), attribution=shares)

    def _farther(self, before: State, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """√f (B,)."""
        if not len(self.far) or self.monitor is None:
            return np.ones(len(rows))
        _, read, known = associated(_senses(self.monitor), before.model, rows)
        f = self.usual + _squares(_with_one(read.inputs), self.far)
        root: NDArray[np.float64] = np.sqrt(np.where(known[:, 0] > 0, np.maximum(1.0, f), 1.0))
        return root


def _monitor(spec: StreamSpec, seed: int, urdf: str) -> CalibratedMonitor:
    """Not yet fitted."""
    detection = EvidenceDetection(spec, shrinkage=1.0, habituates=False)
    return CalibratedMonitor(ValueAssociation(spec, changes=False, urdf=urdf), detection, seed=seed)


def _senses(monitor: CalibratedMonitor) -> StreamScaler:
    assert isinstance(monitor.model, ValueAssociation)
    return monitor.model.senses_


def _with_one(inputs: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.hstack([inputs, np.ones((len(inputs), 1))])


def _squares(z: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """zᵀ M z of each row (N,)."""
    found: NDArray[np.float64] = ((z @ matrix) * z).sum(axis=1)
    return found
