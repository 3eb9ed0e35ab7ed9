"""Calibration: the threshold that keeps a rate of false alarms, what it promises, and whether it can be trusted."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.detection import Blocks, Detection, EvidenceDetection, conformal_episodes, conformal_threshold
from asm_gym.detection.base import Array
from asm_gym.detection.conformal import (
    EPISODE,
    HOUR,
    Promise,
    check_hours,
    check_per_hour,
    hourly_promise,
    hourly_threshold,
)
from asm_gym.detection.contact_limits import healthy_forces
from asm_gym.detection.events import Excuses
from asm_gym.detection.evidence import FEWEST_EPISODES
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.stream_model import StreamModel, model_outputs
from asm_gym.monitors.training_data import Hashes, check_fresh, check_nominal, hashes_of
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

LOG = logging.getLogger("asm_gym.monitors")

AT_ONCE = 400  # episodes that ceilings are learned from at once: arrays of all rows of many hours would fill the memory
MOST_BLIND = 0.6  # largest share of the channels that a monitor may be blind to
MOST_NAMED = 6  # channels that a message names


class AlarmRate(NamedTuple):
    """A rate of false alarms, by the ``"episode"`` or by the ``"hour"``."""

    rate: float
    per: str

    @classmethod
    def of(cls, false_alarm_rate: float | None, false_alarms_per_hour: float | None) -> Self:
        """Return the one of two that is given. Raises ValueError unless exactly one is, and is a rate."""
        if (false_alarm_rate is None) == (false_alarms_per_hour is None):
            raise ValueError(
                "which promise: give false_alarm_rate (such as 0.01, by the episode) or false_alarms_per_hour (such as "
                f"1.0), got {'neither' if false_alarm_rate is None else 'both'}"
            )
        if false_alarms_per_hour is not None:
            return cls(check_per_hour(false_alarms_per_hour), HOUR)
        assert false_alarm_rate is not None
        conformal_episodes(false_alarm_rate)
        return cls(false_alarm_rate, EPISODE)

    @property
    def named(self) -> dict[str, float]:
        """The argument of ``calibrate``."""
        return {"false_alarms_per_hour" if self.per == HOUR else "false_alarm_rate": self.rate}

    def check_hours(self, hours: float) -> None:
        """Raise ValueError where the hours are too few for a rate by the hour."""
        if self.per == HOUR:
            check_hours(self.rate, hours)

    def threshold(self, maxima: Array, blocks: Blocks | None) -> float:
        """Return the threshold from the maxima of nominal episodes, or from their blocks by the hour."""
        if self.per == EPISODE:
            return conformal_threshold(maxima, self.rate)
        assert blocks is not None
        return hourly_threshold(blocks, self.rate)

    def threshold_of(self, values: Sequence[Array], dt: float, each: Sequence[str] = ()) -> float:
        """Return the threshold from the values (T,) of nominal episodes; with ``each``, the greatest of its groups."""
        threshold = self.threshold(np.array([v.max() for v in values]), Blocks.of(values, dt, each))
        for name in dict.fromkeys(each):
            own = [v for v, of in zip(values, each, strict=True) if of == name]
            try:
                threshold = max(threshold, self.threshold_of(own, dt))
            except ValueError as error:
                raise ValueError(f"{name} by itself: {error}") from None
        return threshold


class Calibrated:
    """A threshold, conformal on the maxima of nominal episodes; what it rests on is None before ``calibrate``.

    Attributes:
        threshold_: surprise above which a row is an alarm.
        maxima_: (n,) largest surprise in each calibration episode.
        blocks_: the same by the hour, as ``detection.conformal`` counts it.
        promised_: ``"episode"`` or ``"hour"``, the unit that the promise counts by.
        healthy_: (N,) largest force of each of ``felt_channels`` in these episodes [N m], [N], a lower bound of contact
            limits; empty where the stream has no such channels.
    """

    spec: StreamSpec
    model: StreamModel
    detection: Detection
    detections: dict[str, Detection]
    learned_from_: Hashes | None
    ceilings_from_: Hashes | None
    threshold_: float | None
    maxima_: NDArray[np.float64] | None
    blocks_: Blocks | None
    promised_: str
    healthy_: tuple[float, ...]

    @typed
    def calibrate(
        self,
        episodes: Sequence[Episode],
        false_alarm_rate: float | None = None,
        *,
        false_alarms_per_hour: float | None = None,
        each: Sequence[str] = (),
    ) -> Self:
        """Set the threshold from nominal episodes that ``fit`` has not seen, for one of two promises.

        ``threshold_at`` then knows the threshold of every other rate too.

        Args:
            episodes: 99 at least for a rate of 0.01 and 19 for 0.05; or 10 hours for 0.1 alarms an hour.
            false_alarm_rate: largest P(any alarm in a nominal episode); ``promise`` says how surely.
            false_alarms_per_hour: largest mean number of alarms in an hour of nominal episodes. One that persists, or
                comes back within a minute of the same episode, is one alarm.
            each: task or policy of each episode, where the promise is to hold in each of them.

        Raises:
            ValueError: too few episodes or hours for this rate (the message says which they can promise), or bad ones;
                by the hour also an episode given twice, or that ``fit`` has learned from. Or not exactly one rate.
        """
        self._require_fitted()
        asked = AlarmRate.of(false_alarm_rate, false_alarms_per_hour)
        check_nominal(episodes, self.spec, self.model.shortest)
        if each and len(each) != len(episodes):
            raise ValueError(f"each must name one group an episode, got {len(each)} for {len(episodes)} episodes")
        asked.check_hours(sum(map(len, episodes)) * self.spec.dt / 3600)
        try:
            check_fresh(episodes, self.learned_from_, self.ceilings_from_)
        except ValueError as error:
            if asked.per == HOUR:
                raise
            LOG.warning("%s; the promise by the episode does not hold for these", error)
        new = self._balanced(episodes)
        values = [s.value for s in new.score_episodes(episodes)]
        threshold = asked.threshold_of(values, self.spec.dt, each)
        require_sight(self.detection, self.model.error_columns, self.spec, threshold)
        vars(self).update(vars(new))
        self.threshold_, self.promised_ = threshold, asked.per
        self.maxima_, self.blocks_ = np.array([v.max() for v in values]), Blocks.of(values, self.spec.dt, each)
        self.healthy_ = healthy_forces([episode.stream for episode in episodes], self.spec)
        return self

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm. Raises RuntimeError before ``calibrate``."""
        if self.threshold_ is None:
            raise RuntimeError(f"this {self._name} has no threshold yet: call calibrate(nominal_episodes) first")
        return self.threshold_

    @typed
    def threshold_at(
        self, false_alarm_rate: float | None = None, *, false_alarms_per_hour: float | None = None
    ) -> float:
        """Return the threshold of another rate, from the episodes of ``calibrate``; raises as that does."""
        asked = AlarmRate.of(false_alarm_rate, false_alarms_per_hour)
        kept = self.blocks_ if asked.per == HOUR else self.maxima_
        if kept is None or self.maxima_ is None:
            raise RuntimeError(f"this {self._name} knows no calibration: call calibrate(nominal_episodes) first")
        return asked.threshold(self.maxima_, self.blocks_)

    @property
    def promise(self) -> Promise:
        """How often the threshold promises an alarm in nominal operation. Raises RuntimeError before ``calibrate``."""
        if self.maxima_ is None:
            raise RuntimeError(f"this {self._name} knows no calibration: call calibrate(nominal_episodes) first")
        if self.promised_ == HOUR and self.blocks_ is not None:
            return hourly_promise(self.blocks_, self.threshold, len(self.maxima_))
        return Promise.of(self.maxima_, self.threshold)

    def _balanced(self, episodes: Sequence[Episode]) -> Self:
        """Return it, or a copy, with its parts weighted by what nominal episodes make of each."""
        return self

    @abstractmethod
    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """Return the surprise of each step of each episode."""

    @abstractmethod
    def _require_fitted(self) -> None: ...

    def _uncalibrate(self) -> None:
        self.threshold_ = self.maxima_ = self.blocks_ = None
        self.promised_, self.healthy_ = EPISODE, ()

    @property
    def _name(self) -> str:
        return type(self).__name__


def blind_to(detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float) -> list[str]:
    """Return the labels of the senses whose errors alone could never pass the threshold, however large and lasting.

    ``errors`` (X,) are the columns of the errors in the stream, -1 for none. The detection's ``reach_of`` says how far
    each error can go; without one, nothing is known.
    """
    if not hasattr(detection, "reach_of"):
        return []
    reach, own = np.zeros(spec.size), np.flatnonzero(errors >= 0)
    np.maximum.at(reach, errors[own], detection.reach_of(own))
    return [spec.labels[i] for i in np.unique(errors[own]) if not reach[i] > threshold]


def require_sight(detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float) -> None:
    """Log the channels in which no fault could pass the threshold. Raises ValueError where they are most."""
    blind = blind_to(detection, errors, spec, threshold)
    if not blind:
        return
    named = ", ".join(blind[:MOST_NAMED])
    named += f" and {len(blind) - MOST_NAMED} more" if len(blind) > MOST_NAMED else ""
    message = (
        f"the threshold came to {threshold:.3g}, which no fault of {named} could pass, however strong: an episode "
        "to calibrate on is unlike those learned from, or a channel hardly moved in them: learn from more"
    )
    if len(blind) > MOST_BLIND * len(np.unique(errors[errors >= 0])):
        raise ValueError(message)
    LOG.warning(message)


@typed
def learn_ceilings(monitor: Calibrated, episodes: Sequence[Episode]) -> Calibrated:
    """Learn from healthy hours how far each sense goes at its worst, and return the monitor.

    The episodes it was fitted to, babbling say, are not like hours of operation. It has no threshold then: calibrate it
    on other hours of the same policies and tasks.

    Args:
        monitor: fitted, under the detection of evidence; it is changed.
        episodes: healthy ones that ``fit`` has not seen, 100 at least, and one hit or so in each 50 at most.

    Raises:
        ValueError: too few, or bad ones; one given twice, or that ``fit`` has learned from.
        TypeError: its detection is not that of evidence.
    """
    monitor._require_fitted()
    if not isinstance(monitor.detection, EvidenceDetection):
        raise TypeError(f"the detection {monitor.detection.name} has no ceilings: learn those of evidence")
    check_nominal(episodes, monitor.spec, monitor.model.shortest)
    if len(episodes) < FEWEST_EPISODES:
        raise ValueError(f"ceilings take {FEWEST_EPISODES} healthy episodes or more, got {len(episodes)}")
    check_fresh(episodes, monitor.learned_from_)
    with threadpool_limits(1):
        maxima = _worst_of(monitor, monitor.detection, episodes)
    learned = monitor.detection.with_ceilings(maxima, anew=monitor.ceilings_from_ is None)
    monitor.detection = learned
    monitor.detections = {**monitor.detections, learned.name: learned}
    monitor.ceilings_from_ = hashes_of(episodes)
    monitor._uncalibrate()
    return monitor


def _worst_of(monitor: Calibrated, detection: EvidenceDetection, episodes: Sequence[Episode]) -> NDArray[np.float64]:
    """Return the largest v (N, G, X) in each of N episodes.

    Surprise is v to a power of a half or less, so that v is divided by the square of what divides surprise.
    """
    detector, excuses = detection.detector_, getattr(monitor, "excuses_", None)
    assert detector is not None
    found = []
    for first in range(0, len(episodes), AT_ONCE):
        some = episodes[first : first + AT_ONCE]
        for episode, output in zip(some, model_outputs(monitor.model, some), strict=True):
            strengths, _ = detector.strengths(output)
            if isinstance(excuses, Excuses):
                strengths /= excuses.divisors(episode.stream)[:, None, None] ** 2
            found.append(strengths.max(axis=0))
    return np.array(found)
