"""Values beside changes: a push that is held is explained by its own past for changes, and not by the other senses.

    s = max(s_changes / √f, b s_values^p)   log b + p log s: as log s_changes in centre and spread of nominal maxima
    f = max(1, (1 + τ h)/(1 + τ h̃))         h: leverage of a row, h̃ its median in the episodes learned from
    h = zᵀ (ZᵀZ + λ N)⁻¹ z                  z: inputs that changes are predicted from, and 1;  τ: rows of a tenth of a s

``calibrate`` finds b and p, so that both are as likely to pass the one threshold: each has a threshold of its own so,
and the promised rate is shared. A regression's error in a fresh row has the variance σ² (1 + h); rows that follow each
other are alike, so that those of a tenth of a second count as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import Blocks
from asm_gym.detection.base import Arrays
from asm_gym.detection.evidence import TINY
from asm_gym.detection.scores import Largest
from asm_gym.monitors.base import State, Surprise
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.stream_model import read_next
from asm_gym.monitors.value_association import (
    ALIKE_S,
    MOST_INPUTS,
    ValueAssociation,
    inverse,
    squares,
)
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec

SCALARS = "usual", "balance", "power"
# maxima that p rests on before any, and spread of their logarithms
PRIOR_COUNT, PRIOR_SPREADS = (
    4,
    (0.3, 0.15),
)
MOST_POWER = 3.0
PREFIX = "values."  # prefix of the names of its arrays in a checkpoint


class Values(NamedTuple):
    """The monitor of values, and how it counts beside that of changes."""

    monitor: CalibratedMonitor  # of values alone
    # zᵀ leverage z is τ h / (1 + τ h̃); empty for very many inputs
    leverage: NDArray[np.float64] = np.zeros((0, 0))
    usual: float = 1.0  # 1 / (1 + τ h̃)
    balance: float = 1.0  # b, before ``calibrate``
    power: float = 2.0  # p, before ``calibrate``: changes are judged by squares

    @classmethod
    def learned(cls, episodes: Sequence[Episode], seed: int, urdf: str = "") -> Self | None:
        """Fit it to nominal episodes; None where no value can be predicted. ``urdf`` is the text of a body model."""
        monitor = _monitor(episodes[0].spec, seed, urdf).fit(episodes)
        assert isinstance(monitor.model, ValueAssociation)
        if not len(monitor.model.judged(monitor.learned_["R2_values"])):
            return None
        senses = _senses(monitor)
        if senses.inputs > MOST_INPUTS:
            return cls(monitor)
        z = np.concatenate([_with_one(senses.read_episode(e.stream).inputs) for e in episodes])
        alike = ALIKE_S / episodes[0].spec.dt / len(z)
        leverage = alike * inverse(z.T @ z / len(z))
        usual = 1.0 / (1.0 + float(np.median(squares(z, leverage))))
        return cls(monitor, usual * leverage, usual)

    @classmethod
    def found(cls, spec: StreamSpec, arrays: Arrays, seed: int, urdf: str = "") -> Self:
        """Restore it from arrays by their names without the prefix. Raises where they do not fit."""
        own = {n: a for n, a in arrays.items() if n not in ("leverage", *SCALARS)}
        monitor, leverage = _monitor(spec, seed, urdf).with_learned(own), arrays["leverage"]
        size = _senses(monitor).inputs + 1
        if leverage.shape not in ((size, size), (0, 0)):
            raise ValueError(
                f"the leverage of values should be of shape {(size, size)}, found {leverage.shape}"
            )
        return cls(monitor, leverage, *(float(arrays[name]) for name in SCALARS))

    def balanced(self, changes: Sequence[Surprise], episodes: Sequence[Episode]) -> Self:
        """Return it with b and p from nominal episodes, of whose changes ``join`` made this with b of 0."""
        both = changes, self.monitor.score_episodes(episodes)
        dt = self.monitor.spec.dt
        logs = [
            np.log(np.maximum(Blocks.of([s.value for s in scores], dt).maxima, TINY))
            for scores in both
        ]
        variance = [
            (len(of) * np.var(of) + PRIOR_COUNT * prior**2) / (len(of) + PRIOR_COUNT)
            for of, prior in zip(logs, PRIOR_SPREADS, strict=True)
        ]
        power = min(float(np.sqrt(variance[0] / variance[1])), MOST_POWER)
        balance = float(np.exp(np.median(logs[0]) - power * np.median(logs[1])))
        return self._replace(balance=balance, power=power)

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Arrays to keep in a checkpoint, by name."""
        scalars = {name: np.array(getattr(self, name)) for name in SCALARS}
        kept = {**self.monitor.learned_, "leverage": self.leverage, **scalars}
        return {PREFIX + name: array for name, array in kept.items()}

    def join(
        self,
        state: State,
        rows: NDArray[np.float64],
        changes: Surprise,
        divisor: NDArray[np.float64],
    ) -> tuple[State, Surprise]:
        """Return the new state, and the greater surprise in each row (B, D), attributed as that one is.

        ``changes`` is the surprise that changes make; knocks and stops excuse a surprise by ``divisor`` (B,).
        """
        root = self.spread(state, rows)
        new, values = self.monitor.observe(state, rows)
        weighted = self.balance * values.value**self.power
        excused, value = weighted / divisor, changes.value / root
        held = excused > value
        known = np.isfinite(excused) & (values.value > 0)
        share = np.divide(excused, values.value, out=np.ones_like(excused), where=known)
        own, others = share[:, None] * values.attribution, changes.attribution / root[:, None]
        raw = None if changes.raw is None else np.maximum(changes.raw / root, weighted)
        joined = np.where(held, excused, value), np.where(held[:, None], own, others)
        return new, changes._replace(value=joined[0], attribution=joined[1], raw=raw)

    def spread(self, state: State, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return √f (B,) of the next rows (B, D)."""
        if not len(self.leverage):
            return np.ones(len(rows))
        _, read, known = read_next(_senses(self.monitor), state.model.history, rows)
        f = self.usual + squares(_with_one(read.inputs), self.leverage)
        return np.sqrt(np.where(known[:, 0] > 0, np.maximum(1.0, f), 1.0))


def _monitor(spec: StreamSpec, seed: int, urdf: str) -> CalibratedMonitor:
    return CalibratedMonitor(ValueAssociation(spec, urdf=urdf), Largest(spec), seed=seed)


def _senses(monitor: CalibratedMonitor) -> StreamScaler:
    assert isinstance(monitor.model, ValueAssociation)
    return monitor.model.senses_


def _with_one(inputs: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.hstack([inputs, np.ones((len(inputs), 1))])
