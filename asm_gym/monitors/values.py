"""Values beside changes: a push that is held is explained by its own past for changes, and not by the other senses.

    s = max(s_changes / √f, s_values)       each is 1 at what it seldom exceeds in nominal episodes
    f = max(1, (1 + τ h)/(1 + τ h̃))         h: leverage of a row, h̃ its median in the episodes learned from
    h = zᵀ (ZᵀZ + λ N)⁻¹ z                  z: inputs that changes are predicted from, and 1;  τ: rows of a tenth of a s

A regression's error in a fresh row has the variance σ² (1 + h); rows that follow each other are alike, so that those of
a tenth of a second count as one. Errors of values are not whitened: a few minutes do not show their correlations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import EvidenceDetection
from asm_gym.detection.base import Arrays
from asm_gym.monitors.base import State, Surprise
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.stream_model import read_next
from asm_gym.monitors.value_association import MOST_INPUTS, STIFFNESS, ValueAssociation
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec

PREFIX = "values."  # prefix of the names of its arrays in a checkpoint
ALIKE_S = 0.1  # τ [s]


class Values(NamedTuple):
    """The monitor of values; empty where it is not asked for, and where no value can be predicted.

    Attributes:
        monitor: of values alone.
        leverage: (I + 1, I + 1) of which zᵀ leverage z is τ h / (1 + τ h̃); empty for very many inputs.
        usual: 1 / (1 + τ h̃).
    """

    monitor: CalibratedMonitor | None = None
    leverage: NDArray[np.float64] = np.zeros((0, 0))
    usual: float = 1.0

    @classmethod
    def learned(cls, episodes: Sequence[Episode], seed: int, urdf: str = "") -> Self:
        """Fit it to nominal episodes; ``urdf`` is the text of a body model, or empty."""
        monitor = _monitor(episodes[0].spec, seed, urdf).fit(episodes)
        assert isinstance(monitor.model, ValueAssociation)
        if not len(monitor.model.judged(monitor.learned_["R2_values"])):
            return cls()
        senses = _senses(monitor)
        if senses.inputs > MOST_INPUTS:
            return cls(monitor)
        z = np.concatenate([_with_one(senses.read_episode(e.stream).inputs) for e in episodes])
        alike = ALIKE_S / episodes[0].spec.dt / len(z)
        leverage = alike * np.linalg.inv(z.T @ z / len(z) + STIFFNESS * np.eye(z.shape[1]))
        usual = 1.0 / (1.0 + float(np.median(_squares(z, leverage))))
        return cls(monitor, usual * leverage, usual)

    @classmethod
    def found(cls, spec: StreamSpec, arrays: Arrays, seed: int, urdf: str = "") -> Self:
        """Restore it from arrays by their names without the prefix. Raises where they do not fit."""
        if not arrays:
            return cls()
        own = {n: a for n, a in arrays.items() if n not in ("leverage", "usual")}
        monitor, leverage = _monitor(spec, seed, urdf).with_learned(own), arrays["leverage"]
        size = _senses(monitor).inputs + 1
        if leverage.shape not in ((size, size), (0, 0)):
            raise ValueError(f"the leverage of values should be of shape {(size, size)}, found {leverage.shape}")
        return cls(monitor, leverage, float(arrays["usual"]))

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Arrays to keep in a checkpoint, by name."""
        if self.monitor is None:
            return {}
        kept = {**self.monitor.learned_, "leverage": self.leverage, "usual": np.array(self.usual)}
        return {PREFIX + name: array for name, array in kept.items()}

    def start(self, batch: int) -> State:
        """Return the state before the first row."""
        return () if self.monitor is None else self.monitor.initial_state(batch)

    def reset(self, state: State) -> State:
        """Return the state without the evidence so far."""
        return () if self.monitor is None else self.monitor.reset_evidence(state)

    def join(
        self, state: State, rows: NDArray[np.float64], changes: Surprise, divisor: NDArray[np.float64]
    ) -> tuple[State, Surprise]:
        """Return the new state, and the greater surprise in each row (B, D), attributed as that one is.

        ``changes`` is the surprise that changes make; knocks and stops excuse a surprise by ``divisor`` (B,).
        """
        assert self.monitor is not None
        root = self.spread(state, rows)
        new, values = self.monitor.observe(state, rows)
        excused, value = values.value / divisor, changes.value / root
        held = excused > value
        own, others = values.attribution / divisor[:, None], changes.attribution / root[:, None]
        raw = None if changes.raw is None else np.maximum(changes.raw / root, values.value)
        joined = np.where(held, excused, value), np.where(held[:, None], own, others)
        return new, changes._replace(value=joined[0], attribution=joined[1], raw=raw)

    def spread(self, state: State, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return √f (B,) of the next rows (B, D)."""
        if not len(self.leverage) or self.monitor is None:
            return np.ones(len(rows))
        _, read, known = read_next(_senses(self.monitor), state.model, rows)
        f = self.usual + _squares(_with_one(read.inputs), self.leverage)
        root: NDArray[np.float64] = np.sqrt(np.where(known[:, 0] > 0, np.maximum(1.0, f), 1.0))
        return root


def _monitor(spec: StreamSpec, seed: int, urdf: str) -> CalibratedMonitor:
    detection = EvidenceDetection(spec, shrinkage=1.0, habituates=False)
    return CalibratedMonitor(ValueAssociation(spec, urdf=urdf), detection, seed=seed)


def _senses(monitor: CalibratedMonitor) -> StreamScaler:
    assert isinstance(monitor.model, ValueAssociation)
    return monitor.model.senses_


def _with_one(inputs: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.hstack([inputs, np.ones((len(inputs), 1))])


def _squares(z: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return zᵀ M z of each row (N,)."""
    found: NDArray[np.float64] = ((z @ matrix) * z).sum(axis=1)
    return found
