"""Adaptive threshold: the promised share of nominal episodes in alarm is kept while the policy changes.

    log q_{k+1} = log q_k + η (err_k - α)        err_k = 1 if episode k had a false alarm, else 0
    threshold   min(q_k, c)                      what exceeds c is an alarm, and never counts as a false one

α is the promised rate. In any K episodes that count, at most α K + log(c/q_1)/η + 1 have an alarm. Confirmed alarms do
not move q, so that it learns drift and not faults.

Sources: Angelopoulos et al. 2023 (NeurIPS, arXiv 2307.16895), its P control, on log q as surprise spans decades; Gibbs
and Candès 2021 (NeurIPS, arXiv 2106.00170), which moves the level instead of the threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from asm_gym.detection.alarm_rule import rows_over
from asm_gym.validation import check_number


@dataclass(frozen=True)
class AdaptiveThreshold:
    """Let the threshold follow a policy that changes.

    Args:
        rate: α in (0, 1), share of nominal episodes that may raise an alarm.
        step: η > 0; a false alarm raises the threshold by a factor of about exp(η).
        ceiling: > 1, largest multiple of the calibrated threshold.
    """

    rate: float = 0.01
    step: float = 0.3
    ceiling: float = 4.0

    def __post_init__(self) -> None:
        check_number("rate", self.rate, above=0.0, below=1.0)
        check_number("step", self.step, above=0.0)
        check_number("ceiling", self.ceiling, above=1.0)

    def start(self, threshold: float) -> RunningThreshold:
        """Return the running threshold that begins at a calibrated one."""
        check_number("threshold", threshold, above=0.0)
        return RunningThreshold(
            settings=self, ceiling=self.ceiling * threshold, log=math.log(threshold)
        )


@dataclass
class RunningThreshold:
    """A threshold that moves at the end of every episode."""

    settings: AdaptiveThreshold
    ceiling: float  # c
    log: float  # of q
    episodes: int = 0  # that counted
    alarms: int = 0  # of these

    @property
    def value(self) -> float:
        """The present threshold."""
        return min(math.exp(self.log), self.ceiling)

    @property
    def level(self) -> float:
        """Share of the counted episodes so far that had a false alarm; NaN before the first."""
        if not self.episodes:
            return math.nan
        return self.alarms / self.episodes

    def follow(
        self, largest: float, judged_by: float | None = None, confirmed: bool = False
    ) -> None:
        """Move the threshold after an episode.

        Args:
            largest: surprise of the episode.
            judged_by: threshold that was in use; by default the present one.
            confirmed: an alarm in it was true, so that the episode does not count.
        """
        if judged_by is None:
            judged_by = self.value
        alarm = bool(rows_over(largest, judged_by))
        if alarm and (confirmed or rows_over(largest, self.ceiling)):
            return
        self.episodes += 1
        self.alarms += alarm
        self.log += self.settings.step * (alarm - self.settings.rate)
