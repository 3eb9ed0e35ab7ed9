"""Who acts in one environment, the policy or a reflex: what the table of transitions makes of each row.

An override that is asked for happens: what fails, be it the policy's action, the stream, the monitor or the reflex, is
an alarm, and ends in the reflex or in staying, never in the policy. While the arm presses harder than healthy motion
does, nothing leads to the policy, whatever the cause is taken for.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Graded, Hold, Recall, Reflex
from asm_gym.validation import as_float32, shown
from asm_gym.wrappers.transitions import GOING_ON, ReleaseRule, Situation, State, Transition, following

_log = logging.getLogger("asm_gym.safety")

STRANGE_AFTER = 200
"""Rows under the policy after which it is said that most of them alarm."""


class Command(NamedTuple):
    """What is to be done in a step.

    Attributes:
        action: (A,) finite, in the action space.
        failure: what failed when it was chosen; empty where nothing did.
        refused: the policy's action was no action, which is an alarm; another is done instead.
    """

    action: NDArray[np.float32]
    failure: str = ""
    refused: bool = False


class Sensed(NamedTuple):
    """One row, as the arbiter is told of it.

    Attributes:
        surprise: infinite where something has failed.
        row: (D,) of the stream.
        executed: (A,) what was done before it.
        alarm: None where surprise alone says.
        presses: a contact limit was passed within the step.
        impulse: how much the arm has pressed in this episode, beyond healthy motion [N s].
        response: what a ``Graded`` reflex is to do about an alarm; empty for what it did last.
        touched: whether the contact that was responded to is still there; None where nobody knows.
        why: the cause, for the log.
        expected: (A,) what the memory expects to be commanded next, for reflexes that go on with it.
        ends_step: reflexes feel such rows alone, one a control step.
        knocked: the alarm is a knock: surprise is over the threshold but for what excuses it.
    """

    surprise: float
    row: NDArray[np.floating[Any]]
    executed: NDArray[np.float32]
    alarm: bool | None = None
    presses: bool = False
    impulse: float = 0.0
    response: str = ""
    touched: bool | None = None
    why: str = ""
    expected: NDArray[np.float32] | None = None
    ends_step: bool = True
    knocked: bool = False


class Decision(NamedTuple):
    """What a row has come to.

    Attributes:
        alarm: surprise is over the threshold, or something failed, is missing or presses.
        intervened: something else than the policy was acting.
        gave_up: the episode is to end.
        acted_on: the surprise has had its consequence, so that its evidence is not to be counted again.
        failure: what failed in the reflex when it was told of the row; empty where nothing did.
        transition: the name in ``TRANSITIONS``, or the response under which the policy goes on; empty where nothing
            changes.
        state: who acts next.
    """

    alarm: bool
    intervened: bool
    gave_up: bool
    acted_on: bool
    failure: str = ""
    transition: str = ""
    state: State = State.POLICY


NOTHING = Decision(False, False, False, False)
"""Of a step in which there was nothing to decide."""


@dataclass
class _Counts:
    """What is counted in an episode, in rows."""

    wait: float  # rows of override before a trial
    quiet: int = 0  # low surprise, in a row
    acted: int = 0  # under the reflex, those before a hand-back that came too early included
    held: int = 0  # under the reflex, since it took over
    free: int = 0  # nothing touched, in a row
    returned: int = 0  # hand-backs in a row that came too early
    since: int = 0  # under the policy, since control was handed back
    on_trial: bool = False  # and it was on trial
    strikes: int = 0
    went_on: int = 0  # in alarm under the policy


class Arbiter:
    """Decides who acts in one environment.

    Args:
        reflex: acts after an alarm; None where nothing does.
        threshold: what surprise must exceed for an alarm.
        rule: when control is handed back, counted in what ``decide`` is called for.
        fallback: acts where nobody else can; None where nobody ever acts but the policy.
        space: of the actions; None where ``command`` is never asked.
    """

    def __init__(
        self,
        reflex: Policy | None,
        threshold: float,
        rule: ReleaseRule,
        fallback: Hold | None,
        space: gym.spaces.Box | None,
    ) -> None:
        self._reflex, self._rule, self._fallback = reflex, rule, fallback
        self._feeling = reflex if isinstance(reflex, Reflex) else None
        self._space = gym.spaces.Box(-1.0, 1.0, (0,)) if space is None else space
        self.threshold = threshold
        """May be set between episodes."""
        self._judged = self._alarmed = 0  # rows under the policy, whatever the episode
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.state = State.POLICY
        """Who acts next."""
        self.confirmed = False
        """What alarmed in this episode went on while the reflex acted, and so was no habit of the policy."""
        self._counts = _Counts(wait=self._rule.try_after or math.inf)
        self._response = ""  # to the last alarm
        self._memory: Any = None  # the reflex's own state
        self._fresh = self._refused = False
        self._warned: set[str] = set()
        self._last = np.zeros(self._space.shape, np.float32)  # (A,) executed last
        self._before = self._last  # (A,) executed last before the override
        if self._feeling is not None:
            self._feeling.reset()

    @property
    def overriding(self) -> bool:
        """Whether the reflex acts next."""
        return self.state is State.REFLEX

    @property
    def strikes(self) -> int:
        """How often the policy has pressed too hard in this episode."""
        return self._counts.strikes

    @property
    def may_go_on(self) -> bool:
        """Whether the policy may go on in alarm, for all the time that it did."""
        return self._counts.went_on < self._rule.go_on

    def warn(self, failure: str, instead: str) -> None:
        """Says what failed, and what happens instead: once an episode for each that can fail."""
        who = failure.partition(":")[0]
        if who not in self._warned:
            self._warned.add(who)
            gym.logger.warn(f"{failure}; {instead}")

    # ------------------------------------------------------------------ what is done

    def command(self, action: NDArray[np.float32], observation: Any) -> Command:
        """What is to be done: the policy's ``action`` (A,), or the reflex's after ``observation``."""
        command = self._command(action, observation)
        self._last = command.action.copy()
        return command

    def _command(self, action: NDArray[np.float32], observation: Any) -> Command:
        if self.overriding:
            return self._reaction(observation)
        if np.isfinite(action).all():
            # What np.clip does, in a third of the time.
            return Command(np.minimum(np.maximum(action, self._space.low), self._space.high))
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
                self._memory = None if self._feeling is None else self._feeling.begin(self._before)
            chosen, self._memory = self._reflex.predict(
                observation, state=self._memory, episode_start=start, deterministic=True
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

    # ------------------------------------------------------------------ what comes of it

    def decide(self, sensed: Sensed) -> Decision:
        """Decides who acts next."""
        over = not sensed.surprise <= self.threshold
        alarm = (over if sensed.alarm is None else sensed.alarm) or sensed.presses
        intervened = self.overriding or self._refused
        if not intervened and math.isfinite(sensed.surprise):
            self._estranged(alarm)
        begun, self._refused = self._refused, False
        if self._reflex is None:
            return Decision(alarm, intervened, False, False)
        failure = self._tell(sensed.row, sensed.executed, intervened) if sensed.ends_step else ""
        if sensed.expected is not None and isinstance(self._reflex, Recall):
            self._reflex.expects(sensed.expected)
        situation = self._count(sensed, alarm, intervened)
        transition = following(self.state, situation)
        name = self._follow(transition, sensed) or ("override" if begun else "")
        if name:
            because = f" ({sensed.why})" if sensed.why else ""
            _log.info("%s: surprise %.3g, threshold %.3g%s", name, sensed.surprise, self.threshold, because)
        gave_up = self.state is State.ENDED
        acted_on = over or sensed.knocked or sensed.presses or name == "trial"
        return Decision(alarm, intervened, gave_up, acted_on, failure, name, self.state)

    def let_pass(self, rows: list[NDArray[np.float32]], executed: NDArray[np.float32], ends_step: bool) -> str:
        """What ``decide`` comes to after quiet rows under the policy; what failed in the reflex."""
        for _ in rows:
            self._estranged(False)
        if self._reflex is None:
            return ""
        c = self._counts
        c.quiet, c.free, c.since = c.quiet + len(rows), 0, c.since + len(rows)
        return self._tell(rows[-1], executed, False) if ends_step else ""

    @property
    def most_impulse(self) -> float:
        """How much an arm may press in an episode [N s]."""
        return math.inf if self._reflex is None else self._rule.impulse or math.inf

    def _count(self, sensed: Sensed, alarm: bool, intervened: bool) -> Situation:
        """Counts the row, and says what it has come to."""
        c, rule = self._counts, self._rule
        low = sensed.surprise <= self.threshold * (rule.release_below if intervened else 1.0)
        c.quiet = c.quiet + 1 if low and not alarm else 0
        c.free = c.free + 1 if sensed.touched is False and intervened else 0
        goes_on = sensed.response in GOING_ON and not sensed.presses
        if intervened:
            # Where nobody knows what is sensed, no trial comes nearer.
            c.acted, c.held = c.acted + 1, c.held + 1 if math.isfinite(sensed.surprise) else 0
            # What the arm feels when it changes over to the reflex confirms nothing yet.
            self.confirmed = self.confirmed or (alarm and c.held > rule.release_after)
        else:
            c.since += 1
            c.went_on += alarm and goes_on
            c.strikes += sensed.presses
        if self.overriding and alarm and sensed.response not in ("", *GOING_ON):
            self._choose(sensed.response)
        stopping = self._response == "stop"  # a fault that is quiet while nothing is asked of the robot has not gone
        return Situation(
            alarm=alarm,
            presses=sensed.presses,
            spent=c.strikes >= (rule.strikes or math.inf) or sensed.impulse > (rule.impulse or math.inf),
            goes_on=goes_on and (sensed.response == "complete" or not self.overriding),
            stops=stopping and c.held >= (rule.try_after or rule.release_after),
            overdue=c.acted >= (rule.max_override or math.inf),
            quiet=not stopping and c.quiet >= rule.release_after and not sensed.touched,
            free=not (stopping or sensed.presses) and c.free >= rule.free_after << min(c.returned, 16),
            waited=not (stopping or sensed.presses) and c.held >= c.wait and sensed.touched is None,
            settled=c.since > rule.release_after,
        )

    def _follow(self, transition: Transition | None, sensed: Sensed) -> str:
        """Changes the state; what is to be said of it."""
        if transition is None:
            return ""
        if transition.to is State.REFLEX:
            self._choose(sensed.response)
            self._take_over(sensed.executed)
        elif transition.to is not None:
            self.state = transition.to
            if transition.to is State.TRIAL:
                c = self._counts
                c.since, c.on_trial, c.quiet = 0, transition.name == "trial", 0
        return sensed.response if transition.name == "*" else transition.name

    def _take_over(self, executed: NDArray[np.float32]) -> None:
        c = self._counts
        if self.state is State.TRIAL and c.since <= self._rule.release_after:
            c.wait *= 2 if c.on_trial else 1
            c.returned += 1
        else:
            c.acted, c.wait, c.returned = 0, self._rule.try_after or math.inf, 0
        c.held = c.free = c.quiet = 0
        self._before = np.array(executed, np.float32)
        self.state, self._fresh = State.REFLEX, True

    def _choose(self, response: str) -> None:
        self._response = response
        if isinstance(self._reflex, Graded):
            self._reflex.choose(response)

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
