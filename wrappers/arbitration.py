"""Who acts in one environment, the policy or a reflex: from the step after an alarm on, until surprise is quiet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold


@dataclass(frozen=True)
class Patience:
    """When control is handed back.

    Args:
        release_after: control steps of quiet after which it is.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act at a stretch; None for as many as it takes.
    """

    release_after: int = 10
    release_below: float = 0.8
    max_override: int | None = None

    def __post_init__(self) -> None:
        if self.release_after < 1:
            raise ValueError(f"release_after must be at least 1, got {self.release_after}")
        if not 0.0 < self.release_below <= 1.0:
            raise ValueError(f"release_below must be in (0, 1], got {self.release_below}")
        if self.max_override is not None and self.max_override < 1:
            raise ValueError(f"max_override must be at least 1, got {self.max_override}")


class Verdict(NamedTuple):
    """What a step has come to.

    Attributes:
        alarm: surprise is over the threshold.
        intervened: the reflex acted in this step.
        gave_up: it has acted for as long as it may, and surprise is not quiet yet.
        acted_on: the alarm is acted on, so that its evidence is not to be counted again.
    """

    alarm: bool
    intervened: bool
    gave_up: bool
    acted_on: bool


NOTHING = Verdict(False, False, False, False)
"""Of a step in which there was nothing to judge."""


class Arbiter:
    """Decides who acts in one environment.

    Args:
        reflex: acts from the step after an alarm on; None where nothing does.
        threshold: what surprise must exceed for an alarm.
        patience: when control is handed back.
    """

    def __init__(self, reflex: Policy | None, threshold: float, patience: Patience) -> None:
        self._reflex, self._threshold, self._patience = reflex, threshold, patience
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.overriding = False
        """The reflex acts in the next step."""
        self._quiet = self._acted = 0
        self._state: Any = None
        self._fresh = False
        if isinstance(self._reflex, Hold):
            self._reflex.reset()

    def executed(self, action: Any, observation: Any) -> NDArray[np.float32]:
        """What is done: the policy's ``action`` (A,), or the reflex's after ``observation``."""
        if not self.overriding:
            return np.asarray(action, dtype=np.float32)
        assert self._reflex is not None
        start = np.array([self._fresh])
        self._fresh = False
        chosen, self._state = self._reflex.predict(
            observation, state=self._state, episode_start=start, deterministic=True
        )
        return np.asarray(chosen, dtype=np.float32)

    def judge(self, surprise: float, row: NDArray[np.floating[Any]], executed: NDArray[np.float32]) -> Verdict:
        """Decides who acts next, after ``executed`` (A,) was done and ``row`` (D,) was sensed."""
        alarm, intervened = surprise > self._threshold, self.overriding
        if self._reflex is None:
            return Verdict(alarm, False, False, False)
        if isinstance(self._reflex, Hold):
            self._reflex.feel(row, executed, intervened)
        quiet = surprise <= self._threshold * (self._patience.release_below if intervened else 1.0)
        self._quiet = self._quiet + 1 if quiet else 0
        self._acted = self._acted + 1 if intervened else 0
        if alarm and not intervened:
            self.overriding = self._fresh = True
            # Our own reflexes start from what was last done; a user's policy starts as in a new episode.
            begin = getattr(self._reflex, "begin", None)
            self._state = begin(executed) if begin else None
        elif intervened and self._quiet >= self._patience.release_after:
            self.overriding = False
        gave_up = intervened and self.overriding and self._acted == self._patience.max_override
        return Verdict(alarm, intervened, gave_up, alarm)
