"""Values beside changes: a push that is held is explained by its own past for changes, and not by the other senses.

    s = max(s_changes / √f, b s_values^p)   p: p log s_values has the spread of log s_changes;  b: see below
    f = max(1, (1 + τ h)/(1 + τ h̃))         h: leverage of a row, h̃ its median in the episodes learned from
    h = zᵀ (ZᵀZ + λ N)⁻¹ z                  z: inputs that changes are predicted from, and 1;  τ: rows of a tenth of a s

``calibrate`` finds b and p from the maxima of nominal episodes: of the alarms in them that the promised rate allows,
values raise half and changes half. Each then has the threshold that it would have by itself for half of the rate.

Where less than two alarms are allowed, thresholds at the largest maxima, C_1 and V_1, would raise up to two. There b
makes the second largest maxima equal, C_2 = b V_2^p, and the threshold is the largest maximum of s times

    margin = min(C_1/C_2, (V_1/V_2)^p)      changes pass at C_1 (V_1/V_2)^p, values at V_1 (C_1/C_2)^(1/p)

By b of all n + 1 episodes, a fresh one that passes would be the first of all: one of n + 1 is, on average (full
conformal prediction, Vovk et al. 2005; p, which also depends on the episodes, is taken as given).

A regression's error in a fresh row has the variance σ² (1 + h); rows that follow each other are alike, so that those of
a tenth of a second count as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import ONE_THREAD
from asm_gym.data.episode import Episode
from asm_gym.detection import Blocks, ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.detection.conformal import FEWEST_IN_TAIL, ROUNDING
from asm_gym.detection.evidence import TINY
from asm_gym.detection.scores import Largest
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.monitor_protocol import State, Surprise
from asm_gym.monitors.stream_model import read_next, require_arrays, stretches
from asm_gym.monitors.torque.crossfitting import quadratic_form, regular_inverse
from asm_gym.monitors.torque.value_association import (
    ALIKE_S,
    MOST_LEVERAGE_INPUTS,
    ValueAssociation,
)
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]

PREFIX = "values."  # prefix of the names of its arrays in a checkpoint
SCALARS = ("usual", "balance", "power")

PRIOR_COUNT = 4  # maxima that p rests on before any
PRIOR_SPREAD_OF_CHANGES = 0.3  # of the logarithms of these
PRIOR_SPREAD_OF_VALUES = 0.15
MOST_POWER = 3.0


@dataclass(frozen=True, eq=False)
class ValueJudge:
    """A monitor of values, and how it counts beside the surprise of changes.

    Attributes:
        monitor: of values alone.
        leverage: (I + 1, I + 1) zᵀ leverage z is τ h / (1 + τ h̃); (0, 0) for very many inputs.
        usual: 1 / (1 + τ h̃).
        balance: b; 1 before ``calibrate``.
        power: p; before ``calibrate`` 2, as changes are judged by squares.
        margin: by which the largest surprise of the calibration set counts for more, >= 1; not kept in a checkpoint.
    """

    monitor: CalibratedMonitor
    leverage: Floats
    usual: float = 1.0
    balance: float = 1.0
    power: float = 2.0
    margin: float = 1.0

    @classmethod
    def learned(cls, episodes: Sequence[Episode], seed: int, urdf: str = "") -> Self | None:
        """Fit it to nominal episodes; None where no value can be predicted. ``urdf`` is the text of a body model."""
        spec = episodes[0].spec
        monitor = _monitor(spec, seed, urdf).fit(episodes)
        model = _model(monitor)
        if not len(model.judged(monitor.learned_["R2_values"])):
            return None
        if model.senses_.inputs > MOST_LEVERAGE_INPUTS:
            return cls(monitor, leverage=np.zeros((0, 0)))

        readings = [model.senses_.read_episode(episode.stream) for episode in episodes]
        z = np.concatenate([_with_one(reading.inputs) for reading in readings])
        rows = len(z)
        rows_as_one = ALIKE_S / spec.dt  # τ
        leverage = rows_as_one / rows * regular_inverse(z.T @ z / rows)
        median = float(np.median(quadratic_form(z, leverage)))
        usual = 1.0 / (1.0 + median)
        return cls(monitor, leverage=usual * leverage, usual=usual)

    @classmethod
    def restored(cls, spec: StreamSpec, arrays: Arrays, seed: int, urdf: str = "") -> Self | None:
        """Restore it from the arrays of a checkpoint; None where that has none of it.

        Raises:
            ValueError: something is missing, or does not fit.
        """
        own = {}
        for name, array in arrays.items():
            if name.startswith(PREFIX):
                own[name.removeprefix(PREFIX)] = array
        if not own:
            return None
        require_arrays(own, ("leverage", *SCALARS))
        leverage = own.pop("leverage")
        scalars = {name: float(own.pop(name)) for name in SCALARS}
        monitor = _monitor(spec, seed, urdf).restore_learned(own)
        size = _model(monitor).senses_.inputs + 1
        if leverage.shape not in ((size, size), (0, 0)):
            raise ValueError(
                f"the leverage of values should be of shape {(size, size)}, found {leverage.shape}"
            )
        return cls(monitor, leverage=leverage, **scalars)

    @property
    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Arrays to keep in a checkpoint, by name."""
        kept = {**self.monitor.learned_, "leverage": self.leverage}
        kept |= {name: np.array(getattr(self, name)) for name in SCALARS}
        return {PREFIX + name: array for name, array in kept.items()}

    def of_changes_alone(self) -> Self:
        """Return it with b of 0, so that values count for nothing."""
        return replace(self, balance=0.0)

    def balanced(
        self, changes: Sequence[Surprise], episodes: Sequence[Episode], expected: float
    ) -> Self:
        """Return it with b, p and the margin from nominal episodes.

        Args:
            changes: surprise of these episodes by changes alone.
            episodes: nominal.
            expected: alarms that the promised rate allows in them and a fresh one.
        """
        by_changes = self._log_maxima(changes)
        by_values = self._log_maxima(self.monitor.score_episodes(episodes))
        variance_of_changes = _variance(by_changes, PRIOR_SPREAD_OF_CHANGES)
        variance_of_values = _variance(by_values, PRIOR_SPREAD_OF_VALUES)
        ratio = np.sqrt(variance_of_changes / variance_of_values)
        power = min(float(ratio), MOST_POWER)
        largest_changes = np.sort(by_changes)[::-1]
        largest_values = power * np.sort(by_values)[::-1]
        half = int(expected / 2 + ROUNDING)
        count = len(by_changes)
        place = min(half or 2, count) - 1
        margin = 1.0
        if half == 0 and count < FEWEST_IN_TAIL:
            gap_of_changes = largest_changes[0] - largest_changes[place]
            gap_of_values = largest_values[0] - largest_values[place]
            margin = float(np.exp(min(gap_of_changes, gap_of_values)))
        log_balance = largest_changes[place] - largest_values[place]
        return replace(self, balance=float(np.exp(log_balance)), power=power, margin=margin)

    def raised(self, scores: Sequence[Surprise]) -> list[Surprise]:
        """Return the surprise of the calibration set, its largest row raised by the margin."""
        worst = int(np.argmax([score.value.max() for score in scores]))
        raised = list(scores)
        value = scores[worst].value.copy()
        value[value.argmax()] *= self.margin
        raised[worst] = scores[worst]._replace(value=value)
        return raised

    def _log_maxima(self, scores: Sequence[Surprise]) -> Floats:
        """Return the logarithms (n,) of the maxima of blocks."""
        blocks = Blocks.of([score.value for score in scores], self.monitor.spec.dt)
        return np.log(np.maximum(blocks.maxima, TINY))

    def start(self, batch: int) -> State:
        """Return the state before the first row of ``batch`` streams."""
        return self.monitor.initial_state(batch)

    def join(
        self, state: State, rows: Floats, changes: Surprise, divisor: Floats
    ) -> tuple[State, Surprise]:
        """Return the new state, and the greater surprise in each row, attributed as that one is.

        Args:
            state: before the rows.
            rows: (B, D).
            changes: the surprise that changes make.
            divisor: (B,) by which knocks and stops excuse a surprise.
        """
        spread = self.spread(state, rows)
        new, values = self.monitor.observe(state, rows)
        return new, self._joined(changes, values, spread, divisor)

    def join_episode(self, episode: Episode, changes: Surprise, divisor: Floats) -> Surprise:
        """Return what ``join`` returns for one row after another of an episode of T rows, ``divisor`` being (T,)."""
        (values,) = self.monitor.score_episodes([episode])
        spread = np.ones(len(episode))
        if len(self.leverage):
            for part in stretches(self._senses, episode.stream, 2 * self._senses.lag):
                spread[part.rows] = self._spread(part.reading, part.known)[part.lead :]
        return self._joined(changes, values, spread, divisor)

    def _joined(
        self, changes: Surprise, values: Surprise, spread: Floats, divisor: Floats
    ) -> Surprise:
        """Return the greater of the surprise of changes and of values, N rows each."""
        by_changes = changes.value / spread
        raw_by_values = self.balance * values.value**self.power
        by_values = raw_by_values / divisor
        values_count = by_values > by_changes

        has_share = np.isfinite(by_values) & (values.value > 0)
        factor = np.ones_like(by_values)
        np.divide(by_values, values.value, out=factor, where=has_share)
        joined = changes._replace(
            value=np.where(values_count, by_values, by_changes),
            attribution=np.where(
                values_count[:, None],
                factor[:, None] * values.attribution,
                changes.attribution / spread[:, None],
            ),
        )
        if changes.raw is not None:
            raw = np.maximum(changes.raw / spread, raw_by_values)
            joined = joined._replace(raw=raw)
        return joined

    def spread(self, state: State, rows: Floats) -> Floats:
        """Return √f (B,) of the next rows (B, D)."""
        _, reading, known = read_next(self._senses, state.model.history, rows)
        return self._spread(reading, known)

    def _spread(self, reading: ScaledRows, known: NDArray[np.float32]) -> Floats:
        """Return √f (N,) of rows; 1 of those that are not ``known`` (N, 1)."""
        if not len(self.leverage):
            return np.ones(len(known))
        leverage = quadratic_form(_with_one(reading.inputs), self.leverage)
        f = np.maximum(1.0, self.usual + leverage)
        return np.sqrt(np.where(known[:, 0] > 0, f, 1.0))

    @property
    def _senses(self) -> StreamScaler:
        return _model(self.monitor).senses_


def without_values(arrays: Arrays) -> Arrays:
    """Return the arrays of a checkpoint that are not of a judge of values."""
    return {name: array for name, array in arrays.items() if not name.startswith(PREFIX)}


class _ValueMonitor(CalibratedMonitor):
    """Scores whole episodes at once: no row depends on more than the last few."""

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        with ONE_THREAD:
            return [self._scored(episode.stream) for episode in episodes]

    def _scored(self, stream: NDArray[np.float32]) -> Surprise:
        """Return the surprise of an episode (T, D)."""
        model = _model(self)
        found = Surprise(np.zeros(len(stream)), np.zeros(stream.shape))
        for part in stretches(model.senses_, stream, 2 * model.lag + model.window):
            output = model.predict_stretch(part.reading, part.known)
            own = ModelOutput(output.errors[part.lead :], output.contexts[part.lead :])
            _, surprise = self.judge((), own, stream[part.rows])
            found.value[part.rows] = surprise.value
            found.attribution[part.rows] = surprise.attribution
        return found


def _monitor(spec: StreamSpec, seed: int, urdf: str) -> CalibratedMonitor:
    return _ValueMonitor(ValueAssociation(spec, urdf=urdf), Largest(spec), seed=seed)


def _model(monitor: CalibratedMonitor) -> ValueAssociation:
    assert isinstance(monitor.model, ValueAssociation)
    return monitor.model


def _variance(logs: Floats, prior_spread: float) -> float:
    """Return the variance of logarithms (n,), with the prior's."""
    count = len(logs)
    squares = count * np.var(logs) + PRIOR_COUNT * prior_spread**2
    return float(squares / (count + PRIOR_COUNT))


def _with_one(inputs: NDArray[np.float32]) -> Floats:
    return np.hstack([inputs, np.ones((len(inputs), 1))])
