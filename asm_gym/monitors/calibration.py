"""Calibration: the threshold that keeps a rate of false alarms, what it promises, and whether it can be trusted."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.detection import Blocks, EvidenceDetection, conformal_episodes
from asm_gym.detection.base import Array
from asm_gym.detection.benign_events import BenignEvents
from asm_gym.detection.conformal import (
    EPISODE,
    HOUR,
    check_hours,
    check_per_hour,
    episode_threshold,
    hourly_threshold,
)
from asm_gym.detection.evidence import FEWEST_EPISODES
from asm_gym.detection.incidents import incidents_in, power_of
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.monitors.training_data import shortened
from asm_gym.spec import StreamSpec

if TYPE_CHECKING:
    from asm_gym.monitors.calibrated_monitor import CalibratedMonitor

LOG = logging.getLogger("asm_gym.monitors")

# One in 3 episodes sets ceilings; one in 10 where else too few are left for the threshold.
ONE_IN = (3, 10)
# Episodes that ceilings are learned from at once: all rows of many hours would fill the memory.
EPISODES_AT_ONCE = 400
MOST_BLIND = 0.6  # largest share of the channels that a monitor may be blind to


class AlarmRate(NamedTuple):
    """A rate of false alarms, by the ``"episode"`` or by the ``"hour"``."""

    rate: float
    per: str

    @classmethod
    def of(cls, false_alarm_rate: float | None, false_alarms_per_hour: float | None) -> Self:
        """Return the one of two that is given.

        Raises ValueError unless exactly one is, and is a rate.
        """
        rule = (
            "give either false_alarm_rate (such as 0.01, of episodes) "
            "or false_alarms_per_hour (such as 1.0)"
        )
        if false_alarm_rate is None:
            if false_alarms_per_hour is None:
                raise ValueError(f"{rule}, got neither")
            return cls(check_per_hour(false_alarms_per_hour), HOUR)
        if false_alarms_per_hour is not None:
            raise ValueError(f"{rule}, got both")
        conformal_episodes(false_alarm_rate)
        return cls(false_alarm_rate, EPISODE)

    @property
    def named(self) -> dict[str, float]:
        """The argument of ``calibrate``."""
        if self.per == HOUR:
            return {"false_alarms_per_hour": self.rate}
        return {"false_alarm_rate": self.rate}

    def possible(self, episodes: Sequence[Episode]) -> bool:
        """Return whether so many nominal episodes are enough to promise this rate."""
        if self.per == EPISODE:
            return len(episodes) >= conformal_episodes(self.rate)
        return self.expected(episodes) >= 1.0

    def expected(self, episodes: Sequence[Episode]) -> float:
        """Return how many alarms the rate allows in these nominal episodes and a fresh one."""
        if self.per == EPISODE:
            return self.rate * (len(episodes) + 1)
        return self.rate * sum(len(e) * e.spec.dt for e in episodes) / 3600

    def check_hours(self, hours: float) -> None:
        """Raise ValueError where the hours are too few for a rate by the hour."""
        if self.per == HOUR:
            check_hours(self.rate, hours)

    def threshold(self, maxima: Array, blocks: Blocks | None) -> float:
        """Return the threshold from the maxima of nominal episodes, or from their blocks by the hour."""
        if self.per == EPISODE:
            return episode_threshold(maxima, self.rate)
        assert blocks is not None
        return hourly_threshold(blocks, self.rate)

    def threshold_of(self, values: Sequence[Array], blocks: Blocks, each: Sequence[str]) -> float:
        """Return the threshold from the values (T,) of nominal episodes, the greatest of its groups.

        Args:
            values: of each episode.
            blocks: of these values, which hold the groups too.
            each: group of every episode; empty for one group.
        """
        maxima = np.array([value.max() for value in values])
        thresholds = [self.threshold(maxima, blocks)]
        names = list(dict.fromkeys(each))
        of_groups = [blocks]
        if blocks.group.size:
            of_groups = blocks.groups
        for name, own_blocks in zip(names, of_groups, strict=False):
            own = maxima[np.array(each) == name]
            try:
                thresholds.append(self.threshold(own, own_blocks))
            except ValueError as error:
                raise ValueError(f"{name} by itself: {error}") from None
        return max(thresholds)


def blocks_of_incidents(
    blocks: Blocks, surprises: Sequence[Surprise], monitor: CalibratedMonitor, each: Sequence[str]
) -> Blocks:
    """Return the blocks of nominal episodes, with all incidents in them.

    Args:
        blocks: of the episodes.
        surprises: of the episodes.
        monitor: that was surprised.
        each: group of every episode; empty for one group.
    """
    power = power_of(monitor)
    names = list(dict.fromkeys(each))

    def count(threshold: float, group: int) -> int:
        """Count the incidents in a group of episodes at a threshold."""
        found = 0
        for n, surprise in enumerate(surprises):
            if names and each[n] != names[group]:
                continue
            found += incidents_in(
                surprise.value,
                threshold,
                monitor.spec.dt,
                shares_of=surprise.attribution.__getitem__,
                power=power,
            )
        return found

    return blocks.with_incidents(count)


def blind_to(
    detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float
) -> list[str]:
    """Return the labels of the senses whose errors alone could never pass the threshold, however large and lasting.

    ``errors`` (X,) are the columns of the errors in the stream, -1 for none. The detection's ``reach_of`` says how far
    each error can go; without one, nothing is known.
    """
    if not hasattr(detection, "reach_of"):
        return []
    of_a_column = np.flatnonzero(errors >= 0)
    columns = errors[of_a_column]
    reach = np.zeros(spec.size)
    np.maximum.at(reach, columns, detection.reach_of(of_a_column))
    return [spec.labels[i] for i in np.unique(columns) if not reach[i] > threshold]


def require_sight(
    detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float
) -> None:
    """Log the channels in which no fault could pass the threshold. Raises ValueError where they are most."""
    blind = blind_to(detection, errors, spec, threshold)
    if not blind:
        return
    message = (
        f"the threshold came to {threshold:.3g}, which no fault of {shortened(blind)} could pass, "
        "however strong: an episode to calibrate on is unlike those learned from, "
        "or a channel hardly moved in them: learn from more"
    )
    columns = np.unique(errors[errors >= 0])
    if len(blind) > MOST_BLIND * len(columns):
        raise ValueError(message)
    LOG.warning(message)


def ceiling_episodes(
    episodes: Sequence[Episode], rate: AlarmRate, each: Sequence[str] = ()
) -> set[int]:
    """Return the indices of the nominal episodes that set ceilings; the others set the threshold.

    They are one in so many of each group. There are none where they would be fewer than
    ``FEWEST_EPISODES``, or the others too few for the rate.
    """
    groups: defaultdict[str, list[int]] = defaultdict(list)
    for n, name in enumerate(each or [""] * len(episodes)):
        groups[name].append(n)
    for one_in in ONE_IN:
        chosen: set[int] = set()
        for group in groups.values():
            chosen.update(group[::one_in])
        others = [[episodes[n] for n in group if n not in chosen] for group in groups.values()]
        if len(chosen) >= FEWEST_EPISODES and all(map(rate.possible, others)):
            return chosen
    if len(episodes) >= ONE_IN[0] * FEWEST_EPISODES:
        LOG.warning(
            "the rate that is asked for takes all %d episodes, so that none say how far each sense "
            "goes at its worst, and fewer faults are found: record more, or ask for a higher rate",
            len(episodes),
        )
    return set()


def with_ceilings(monitor: CalibratedMonitor, episodes: Sequence[Episode]) -> EvidenceDetection:
    """Return a monitor's detection with ceilings by how far each sense goes at its worst in healthy episodes.

    Episodes that were learned from, babbling say, are not like hours of operation, and are predicted too well.
    """
    detection = monitor.detection
    assert isinstance(detection, EvidenceDetection)
    maxima = []
    with threadpool_limits(1):
        for first in range(0, len(episodes), EPISODES_AT_ONCE):
            some = episodes[first : first + EPISODES_AT_ONCE]
            maxima += _largest_strengths(monitor, detection, some)
    return detection.with_ceilings(np.array(maxima), is_first=monitor.ceilings_from_ is None)


def _largest_strengths(
    monitor: CalibratedMonitor, detection: EvidenceDetection, episodes: Sequence[Episode]
) -> list[NDArray[np.float64]]:
    """Return the largest v (G, X) in each episode.

    Surprise is v to a power of a half or less, so that v is divided by the square of what divides surprise.
    """
    excuses = getattr(monitor, "excuses_", None)
    maxima = []
    for episode, output in zip(episodes, model_outputs(monitor.model, episodes), strict=True):
        strengths, _ = detection.fitted_detector.strengths(output)
        if isinstance(excuses, BenignEvents):
            strengths /= excuses.divisors(episode.stream)[:, None, None] ** 2
        maxima.append(strengths.max(axis=0))
    return maxima
