"""Who acts in one environment, the policy or a reflex: from the moment of an alarm on, until surprise is quiet."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, Recall

_log = logging.getLogger("asm_gym.safety")


@dataclass(frozen=True)
class Patience:
    """When control is handed back.

    Args:
        release_after: control steps of quiet after which it is.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act. Those before a hand-back after which the alarm is back
            within ``release_after`` steps count too: what comes back at once has not gone. None for as many as it
            takes.
        try_after: control steps after which control is handed back on trial though surprise is not quiet, for a robot
            that holds still where it never did may surprise itself; after each trial that fails, twice as many. None
            for no trials.
    """

    release_after: int = 10
    release_below: float = 0.8
    max_override: int | None = None
    try_after: int | None = None

    def __post_init__(self) -> None:
        if self.release_after < 1:
            raise ValueError(f"release_after must be at least 1, got {self.release_after}")
        if not 0.0 < self.release_below <= 1.0:
            raise ValueError(f"release_below must be in (0, 1], got {self.release_below}")
        for name in ("max_override", "try_after"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}")

    def in_rows(self, each: int) -> Self:
        """The same, counted in rows of a stream that has ``each`` of them in a control step."""
        longest = None if self.max_override is None else each * self.max_override
        wait = None if self.try_after is None else each * self.try_after
        return replace(self, release_after=each * self.release_after, max_override=longest, try_after=wait)


class Verdict(NamedTuple):
    """What a row has come to.

    Attributes:
        alarm: surprise is over the threshold.
        intervened: the reflex was acting.
        gave_up: it has acted for as long as it may, and surprise is not quiet yet.
        acted_on: the surprise has had its consequence, so that its evidence is not to be counted again.
        transition: ``"override"`` where the reflex takes over next, ``"release"`` where the policy does, ``"trial"``
            where it does though surprise is not quiet, ``"give_up"``; empty where nothing changes.
    """

    alarm: bool
    intervened: bool
    gave_up: bool
    acted_on: bool
    transition: str = ""


NOTHING = Verdict(False, False, False, False)
"""Of a step in which there was nothing to judge."""


class Arbiter:
    """Decides who acts in one environment.

    Args:
        reflex: acts after an alarm; None where nothing does.
        threshold: what surprise must exceed for an alarm.
        patience: when control is handed back, counted in what ``judge`` is called for.
        fallback: acts where the reflex fails to; None to let it fail.
    """

    def __init__(
        self, reflex: Policy | None, threshold: float, patience: Patience, fallback: Hold | None = None
    ) -> None:
        self._reflex, self._threshold, self._patience, self._fallback = reflex, threshold, patience, fallback
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.overriding = False
        """The reflex acts next."""
        self.failure = ""
        """Why the reflex could not act when it last should; empty where it could."""
        self._quiet = self._acted = self._held = 0
        self._wait: float = self._patience.try_after or math.inf
        self._handed_back: int | None = None  # so many rows ago, as long as it may turn out too early
        self._tried = False  # and it was on trial
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
        try:
            chosen, self._state = self._reflex.predict(
                observation, state=self._state, episode_start=start, deterministic=True
            )
            self.failure = ""
            chosen = np.asarray(chosen, dtype=np.float32)
            if chosen.shape != np.shape(action) or not np.isfinite(chosen).all():
                raise ValueError(f"an action of shape {np.shape(action)} was needed, got {chosen}")
        except Exception as error:
            # Whatever a user's policy does, an alarm must not end in no action.
            if self._fallback is None:
                raise
            if not self.failure:
                gym.logger.warn(f"the reflex failed, and the robot holds instead: {error!r}")
            self.failure = repr(error)
            chosen, _ = self._fallback.predict(observation, self._fallback.begin(self._before))
        return chosen

    def judge(
        self,
        surprise: float,
        row: NDArray[np.floating[Any]],
        executed: NDArray[np.float32],
        feel: bool = True,
        expected: NDArray[np.float32] | None = None,
    ) -> Verdict:
        """Decides who acts next, after ``executed`` (A,) was done and ``row`` (D,) was sensed.

        Args:
            feel: lets the reflex feel the row: once a control step.
            expected: (A,) what the memory expects to be commanded next, for reflexes that go on with it.
        """
        alarm, intervened = not surprise <= self._threshold, self.overriding
        if self._reflex is None:
            return Verdict(alarm, False, False, False)
        if feel and isinstance(self._reflex, Hold):
            self._reflex.feel(row, executed, intervened)
        if expected is not None and isinstance(self._reflex, Recall):
            self._reflex.expects(expected)
        quiet = surprise <= self._threshold * (self._patience.release_below if intervened else 1.0)
        self._quiet = self._quiet + 1 if quiet else 0
        if intervened:
            self._acted, self._held = self._acted + 1, self._held + 1
        elif self._handed_back is not None:
            self._handed_back += 1
            if self._handed_back > self._patience.release_after:
                self._handed_back = None
        transition = self._next(alarm, executed)
        if transition:
            _log.info("%s: surprise %.3g, threshold %.3g", transition, surprise, self._threshold)
        return Verdict(alarm, intervened, transition == "give_up", alarm or transition == "trial", transition)

    def _next(self, alarm: bool, executed: NDArray[np.float32]) -> str:
        """Who acts next, as a transition."""
        if not self.overriding:
            if alarm:
                self._take_over(executed)
            return "override" if alarm else ""
        if self._quiet >= self._patience.release_after:
            self.overriding, self._handed_back, self._tried = False, 0, False
            return "release"
        if self._acted >= (self._patience.max_override or math.inf):
            return "give_up"
        if self._held >= self._wait:
            self.overriding, self._handed_back, self._tried = False, 0, True
            return "trial"
        return ""

    def _take_over(self, executed: NDArray[np.float32]) -> None:
        if self._handed_back is None:
            self._acted, self._wait = 0, self._patience.try_after or math.inf
        elif self._tried:
            self._wait *= 2
        self._held, self._before = 0, executed
        self.overriding = self._fresh = True
        # Our own reflexes start from what was last done; a user's policy starts as in a new episode.
        begin = getattr(self._reflex, "begin", None)
        self._state = begin(executed) if begin else None
