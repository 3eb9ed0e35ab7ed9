"""Who acts in one environment, the policy or a reflex: from the moment of an alarm on, until surprise is quiet.

An override that is asked for happens: what fails, be it the policy's action, the stream, the monitor or the reflex, is
an alarm, and ends in the reflex or in staying, never in the policy.
"""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Graded, Hold, Recall, Reflex
from asm_gym.validation import as_float32, shown
from asm_gym.wrappers.patience import Patience

_log = logging.getLogger("asm_gym.safety")

GOING_ON = ("go on", "complete", "slow")
"""Responses to an alarm under which the policy acts."""


STRANGE_AFTER = 200
"""Rows under the policy after which it is said that most of them alarm."""


class Command(NamedTuple):
    """What is to be done in a step.

    Attributes:
        action: (A,) finite; in the action space, unless it is the policy's own.
        failure: what failed when it was chosen; empty where nothing did.
        refused: the policy's action was no action, which is an alarm; another is done instead.
    """

    action: NDArray[np.float32]
    failure: str = ""
    refused: bool = False


class Decision(NamedTuple):
    """What a row has come to.

    Attributes:
        alarm: surprise is over the threshold.
        intervened: something else than the policy was acting.
        gave_up: it has acted for as long as it may, and surprise is not quiet yet.
        acted_on: the surprise has had its consequence, so that its evidence is not to be counted again.
        failure: what failed in the reflex when it was told of the row; empty where nothing did.
        transition: ``"override"`` where the reflex takes over, ``"release"`` where the policy goes on next,
            ``"trial"`` where it does though surprise is not quiet, ``"give_up"``; ``"go on"``, ``"complete"`` or
            ``"slow"`` where it stays with the policy; empty where nothing changes.
    """

    alarm: bool
    intervened: bool
    gave_up: bool
    acted_on: bool
    failure: str = ""
    transition: str = ""


NOTHING = Decision(False, False, False, False)
"""Of a step in which there was nothing to decide."""


class Arbiter:
    """Decides who acts in one environment.

    Args:
        reflex: acts after an alarm; None where nothing does.
        threshold: what surprise must exceed for an alarm.
        patience: when control is handed back, counted in what ``decide`` is called for.
        fallback: acts where nobody else can; None where nobody ever acts but the policy.
        space: of the actions; None where ``command`` is never asked.
    """

    def __init__(
        self,
        reflex: Policy | None,
        threshold: float,
        patience: Patience,
        fallback: Hold | None,
        space: gym.spaces.Box | None,
    ) -> None:
        self._reflex, self._patience, self._fallback = reflex, patience, fallback
        self._feeling = reflex if isinstance(reflex, Reflex) else None
        self._space = gym.spaces.Box(-1.0, 1.0, (0,)) if space is None else space
        self.threshold = threshold
        """May be set between episodes."""
        self._judged = self._alarmed = 0  # rows under the policy, whatever the episode
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.overriding = False
        """The reflex acts next."""
        self.confirmed = False
        """What alarmed in this episode went on while the reflex acted, and so was no habit of the policy."""
        self._quiet = self._acted = self._held = 0
        self._wait: float = self._patience.try_after or math.inf
        self._handed_back: int | None = None  # so many rows ago, as long as it may turn out too early
        self._tried = False  # and it was on trial
        self._state: Any = None
        self._fresh = self._refused = False
        self._slowed = False  # the policy acts slowly
        self._response = ""  # to the last alarm
        self._free = 0  # rows for which nothing has pressed
        self._returned = 0  # so often in a row it went back too early
        self._warned: set[str] = set()
        self._last = np.zeros(self._space.shape, np.float32)  # (A,) executed last
        self._before = self._last  # (A,) executed last before the override
        if self._feeling is not None:
            self._feeling.reset()

    def warn(self, failure: str, instead: str) -> None:
        """Says what failed, and what happens instead: once an episode for each that can fail."""
        who = failure.partition(":")[0]
        if who not in self._warned:
            self._warned.add(who)
            gym.logger.warn(f"{failure}; {instead}")

    def command(self, action: NDArray[np.float32], observation: Any) -> Command:
        """What is to be done: the policy's ``action`` (A,), or the reflex's after ``observation``."""
        command = self._command(action, observation)
        self._last = command.action
        return command

    def _command(self, action: NDArray[np.float32], observation: Any) -> Command:
        if self.overriding:
            return self._reaction(observation)
        if np.isfinite(action).all():
            if self._slowed and isinstance(self._reflex, Graded):
                return Command(self._reflex.slowed(action))
            return Command(action)
        self._refused = True
        said = f"policy: the action must be finite, got {shown(action.tolist())}"
        self.warn(said, "another is done instead")
        if self._reflex is None:
            return Command(self._stay(self._last, observation), said, True)
        self._take_over(self._last)
        reaction = self._reaction(observation)
        return Command(reaction.action, "; ".join(filter(None, (said, reaction.failure))), True)

    def _reaction(self, observation: Any) -> Command:
        """What the reflex does; staying, where it fails."""
        assert self._reflex is not None
        try:
            start = np.array([self._fresh])
            if self._fresh:
                # Reflexes start from what was last done; any other policy starts as in a new episode.
                self._state = None if self._feeling is None else self._feeling.begin(self._before)
            chosen, self._state = self._reflex.predict(
                observation, state=self._state, episode_start=start, deterministic=True
            )
            self._fresh = False
            chosen = as_float32(chosen)
            if chosen.shape != self._space.shape or not np.isfinite(chosen).all():
                raise ValueError(f"a finite action of shape {self._space.shape} was needed, got {chosen}")
        except Exception as error:
            # Whatever a user's policy does, an alarm must not end in no action.
            said = f"reflex: {error!r}"
            self.warn(said, "the robot holds instead")
            return Command(self._stay(self._before, observation), said)
        return Command(np.clip(chosen, self._space.low, self._space.high))

    def _stay(self, executed: NDArray[np.float32], observation: Any) -> NDArray[np.float32]:
        assert self._fallback is not None
        return self._fallback.predict(observation, self._fallback.begin(executed))[0]

    def decide(
        self,
        surprise: float,
        row: NDArray[np.floating[Any]],
        executed: NDArray[np.float32],
        feel: bool = True,
        expected: NDArray[np.float32] | None = None,
        response: str = "",
        pressed: bool | None = None,
        why: str = "",
    ) -> Decision:
        """Decides who acts next, after ``executed`` (A,) was done and ``row`` (D,) was sensed.

        Args:
            surprise: infinite where something has failed.
            feel: lets the reflex feel the row: once a control step.
            expected: (A,) what the memory expects to be commanded next, for reflexes that go on with it.
            response: what a ``Graded`` reflex is to do about an alarm, in place of taking over as it did last.
            pressed: whether the contact that was responded to is still there, where that is known: control goes back
                once it is not, though surprise is not quiet, and not before, though it is.
            why: the cause, for the log.
        """
        alarm, intervened = not surprise <= self.threshold, self.overriding or self._refused
        if not intervened and math.isfinite(surprise):
            self._estranged(alarm)
        slowed = self._slowed
        begun, self._refused = self._refused, False
        if self._reflex is None:
            return Decision(alarm, intervened, False, False)
        failure = self._tell(row, executed, intervened) if feel else ""
        if expected is not None and isinstance(self._reflex, Recall):
            self._reflex.expects(expected)
        quiet = surprise <= self.threshold * (self._patience.release_below if intervened else 1.0)
        self._quiet = self._quiet + 1 if quiet else 0
        if intervened:
            # Where nobody knows what is sensed, no trial comes nearer.
            self._acted, self._held = self._acted + 1, self._held + 1 if math.isfinite(surprise) else 0
            # What the arm feels when it changes over to the reflex confirms nothing yet.
            self.confirmed = self.confirmed or (alarm and self._held > self._patience.release_after)
        elif self._handed_back is not None:
            self._handed_back += 1
            if self._handed_back > self._patience.release_after:
                self._handed_back = None
        self._free = self._free + 1 if pressed is False and intervened else 0
        transition = self._next(alarm, executed, response, pressed) or ("override" if begun else "")
        if transition:
            because = f" ({why})" if why else ""
            _log.info("%s: surprise %.3g, threshold %.3g%s", transition, surprise, self.threshold, because)
        acted_on = alarm or transition == "trial"
        return Decision(alarm, intervened or slowed, transition == "give_up", acted_on, failure, transition)

    def _estranged(self, alarm: bool) -> None:
        """Says once, and early, that most of what the policy does alarms."""
        self._judged, self._alarmed = self._judged + 1, self._alarmed + alarm
        if self._judged == STRANGE_AFTER and 2 * self._alarmed > self._judged:
            gym.logger.warn(
                f"{self._alarmed} of the first {self._judged} rows under this policy alarm: something is wrong all the "
                'time, or the memory does not know this policy, task or set-up. Look with on_alarm="monitor" which '
                'channels info["asm"]["attribution"] names; if all is well, record episodes of it, and '
                "monitor.fit(episodes, warm_start=True).calibrate(others, 0.05)"
            )

    def _tell(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], intervened: bool) -> str:
        """Lets the reflex feel the row, if it can; what failed at that."""
        if self._feeling is None:
            return ""
        try:
            self._feeling.feel(row, executed, intervened)
        except Exception as error:
            failure = f"reflex: {error!r}"
            self.warn(failure, "it has not felt this row")
            return failure
        return ""

    def _next(self, alarm: bool, executed: NDArray[np.float32], response: str, pressed: bool | None) -> str:
        """Who acts next, as a transition."""
        if not self.overriding:
            return self._begin(alarm, executed, response)
        if alarm and response == "complete":
            self.overriding, self._handed_back, self._tried = False, 0, False
            return response
        if alarm and response not in ("", *GOING_ON):
            self._choose(response)
        stops = self._response == "stop"  # a fault that is quiet while nothing is asked of the robot has not gone
        gone = self._free >= self._patience.free_after << self._returned
        if not stops and (gone or (self._quiet >= self._patience.release_after and not pressed)):
            self.overriding, self._handed_back, self._tried = False, 0, False
            self._slowed, self._quiet = gone, 0
            return "release"
        stopped = stops and self._held >= (self._patience.try_after or self._patience.release_after)
        if stopped or self._acted >= (self._patience.max_override or math.inf):
            return "give_up"
        if self._held >= self._wait and pressed is None:
            self.overriding, self._handed_back, self._tried = False, 0, True
            return "trial"
        return ""

    def _begin(self, alarm: bool, executed: NDArray[np.float32], response: str) -> str:
        """What becomes of the policy that acts."""
        if alarm and response in GOING_ON:
            self._slowed = response == "slow"
            return response
        if alarm:
            self._slowed = False
            self._choose(response)
            self._take_over(executed)
            return "override"
        if self._slowed and self._quiet >= self._patience.release_after:
            self._slowed = False
            return "release"
        return ""

    def _choose(self, response: str) -> None:
        self._response = response
        if isinstance(self._reflex, Graded):
            self._reflex.choose(response)

    def _take_over(self, executed: NDArray[np.float32]) -> None:
        if self._handed_back is None:
            self._acted, self._wait, self._returned = 0, self._patience.try_after or math.inf, 0
        else:
            self._wait *= 2 if self._tried else 1
            self._returned += 1
        self._held, self._before = 0, executed
        self.overriding = self._fresh = True
