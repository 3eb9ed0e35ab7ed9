"""What keeps a threshold: what it was set by, what it promises, and what it would be for another promise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Blocks, Promise, hourly_promise
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.familiar_speed import FamiliarSpeed
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.promise import Asked
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed


class Calibrated:
    """A threshold, conformal on the maxima of nominal episodes.

    Attributes:
        threshold_: what surprise must exceed for an alarm; None before it is set.
        maxima_: (n,) largest surprise in each episode that it was set by; None before.
        blocks_: the same by the hour, as ``detection.hourly`` counts it; None before, and where it was not kept.
        promised_: ``"episode"`` or ``"hour"``, what the promise counts by.
    """

    spec: StreamSpec
    threshold_: float | None
    maxima_: NDArray[np.float64] | None
    blocks_: Blocks | None
    promised_: str

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm. Raises RuntimeError before ``calibrate``."""
        if self.threshold_ is None:
            raise RuntimeError(f"this {self._name} has no threshold yet: call calibrate(nominal_episodes) first")
        return self.threshold_

    @typed
    def threshold_at(
        self, false_alarm_rate: float | None = None, *, false_alarms_per_hour: float | None = None
    ) -> float:
        """What the threshold would be at another rate, from the episodes that ``calibrate`` was given.

        Raises:
            ValueError: there were too few of them for this rate; the message says how many it takes. Or not one rate.
            RuntimeError: it is not calibrated, or was so by a version that did not keep what this takes.
        """
        asked = Asked.of(false_alarm_rate, false_alarms_per_hour)
        kept = self.blocks_ if asked.per == HOUR else self.maxima_
        if kept is None and self.threshold_ is not None:
            raise RuntimeError(
                f"this {self._name} keeps a threshold, but not the surprise of the nominal episodes that it was set by "
                f"(an older asm-gym did not save it by the {asked.per}): call calibrate(nominal_episodes) again"
            )
        if self.maxima_ is None:
            raise RuntimeError(f"this {self._name} has no threshold yet: call calibrate(nominal_episodes) first")
        return asked.threshold(self.maxima_, self.blocks_)

    @property
    def promise(self) -> Promise:
        """How often the threshold promises that nominal operation alarms, counted by what, and how surely.

        Raises:
            RuntimeError: it is not calibrated, or does not keep the nominal episodes' surprise.
        """
        if self.maxima_ is None:
            raise RuntimeError(f"this {self._name} knows no calibration: call calibrate(nominal_episodes) first")
        if self.promised_ == HOUR and self.blocks_ is not None:
            return hourly_promise(self.blocks_, self.threshold, len(self.maxima_))
        return Promise.of(self.maxima_, self.threshold)

    def _set_threshold(self, scores: Sequence[Surprise], asked: Asked, each: Sequence[str]) -> None:
        """By what was made of nominal episodes. Raises ValueError, and changes nothing, where they are too few."""
        values = [s.value for s in scores]
        threshold = asked.threshold_of(values, self.spec.dt, each)
        self._check_threshold(threshold)
        self.threshold_, self.promised_ = threshold, asked.per
        self.maxima_, self.blocks_ = np.array([v.max() for v in values]), Blocks.of(values, self.spec.dt, each)

    def _check_threshold(self, threshold: float) -> None:
        """Raises ValueError where it is none that will do."""

    def _uncalibrate(self) -> None:
        self.threshold_ = self.maxima_ = self.blocks_ = None
        self.promised_ = EPISODE
        self.healthy_: tuple[float, ...] = ()
        self.familiar_: FamiliarSpeed | None = None

    @property
    def _name(self) -> str:
        return type(self).__name__
