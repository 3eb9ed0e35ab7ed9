"""Which promise a threshold is to keep: a rate of false alarms by the episode, or by the hour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from asm_gym.detection import Blocks, check_per_hour, conformal_episodes, conformal_threshold, hourly_threshold
from asm_gym.detection.base import Array
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.detection.hourly import check_hours


class Asked(NamedTuple):
    """A rate, and what it counts by: ``"episode"`` or ``"hour"``."""

    rate: float
    per: str

    @classmethod
    def of(cls, false_alarm_rate: float | None, false_alarms_per_hour: float | None) -> Self:
        """The one of two that is given. Raises ValueError where none or both are, or where it is no rate."""
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
        """As ``calibrate`` takes it."""
        return {"false_alarms_per_hour" if self.per == HOUR else "false_alarm_rate": self.rate}

    def check_hours(self, hours: float) -> None:
        """Raises ValueError where there are too few for a rate by the hour."""
        if self.per == HOUR:
            check_hours(self.rate, hours)

    def threshold(self, maxima: Array, blocks: Blocks | None) -> float:
        """The threshold that keeps it, from the maxima of nominal episodes, or from what they are by the hour."""
        if self.per == EPISODE:
            return conformal_threshold(maxima, self.rate)
        assert blocks is not None
        return hourly_threshold(blocks, self.rate)

    def threshold_of(self, values: Sequence[Array], dt: float, each: Sequence[str] = ()) -> float:
        """The same from the values (T,) of nominal episodes; with ``each``, the greatest that one of its groups needs.

        Raises:
            ValueError: there are too few episodes, or too few hours, in all of them or in a group.
        """
        threshold = self.threshold(np.array([v.max() for v in values]), Blocks.of(values, dt, each))
        for name in dict.fromkeys(each):
            own = [v for v, of in zip(values, each, strict=True) if of == name]
            try:
                threshold = max(threshold, self.threshold_of(own, dt))
            except ValueError as error:
                raise ValueError(f"{name} by itself: {error}") from None
        return threshold
