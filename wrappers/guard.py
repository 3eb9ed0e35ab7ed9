"""What guards one environment, by itself or among many: from a row and its surprise to who acts next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.detection.events import FAULT, KNOCK
from asm_gym.monitors import Monitor, Surprise
from asm_gym.validation import check_flag, shown
from asm_gym.wrappers.arbiter import NOTHING, Arbiter, Sensed
from asm_gym.wrappers.factory import (
    OnAlarm,
    check_expectation,
    limits_of,
    make_fallback,
    make_reflex,
    make_rule,
    names_causes,
)
from asm_gym.wrappers.hand import HandAgainstJoints
from asm_gym.wrappers.observer import joined
from asm_gym.wrappers.responses import NO_RESPONSE, Responder, responses_from
from asm_gym.wrappers.severity import AGAIN, LEANS_S, Severity, SeverityEstimator
from asm_gym.wrappers.step_report import CONTACT, CONTRADICTION, FAILURE, MISSING, SURPRISE, RowReport
from asm_gym.wrappers.substeps import Beneath, SubstepGuard
from asm_gym.wrappers.transitions import State


@dataclass(frozen=True)
class GuardOptions:
    """What the safety wrappers take beside environment and monitor; see ``NeuralASMSafety``.

    Raises:
        ValueError: responses for another reflex than ``"graded"``, or such as would let a pressing arm go on.
    """

    on_alarm: OnAlarm | None = None
    release_after: int = 10
    release_below: float = 0.8
    max_override: int | None = None
    try_after: int | None = None
    truncate: bool = False
    responses: Mapping[str, str] | None = None
    contact_limits: ContactLimits | str | None = "memory"

    def __post_init__(self) -> None:
        check_flag("truncate", self.truncate)
        responses_from(self.responses)

    def reaction(self, monitor: Monitor) -> OnAlarm:
        """``on_alarm``, or what the monitor makes of None."""
        usual = "graded" if names_causes(monitor) else "hold"
        chosen: OnAlarm = usual if self.on_alarm is None else self.on_alarm
        if self.responses is not None and not (isinstance(chosen, str) and chosen == "graded"):
            raise ValueError(f"responses are those of on_alarm='graded', got on_alarm={shown(chosen)}")
        return chosen


class Guard:
    """Guards one environment.

    Args:
        env: what it acts in; one of many, as far as it can be asked.
        monitor: fitted and calibrated.
        options: of the wrapper.
        threshold: what surprise must exceed for an alarm.
        box: of the actions; None where no reflex can act.
        rows_per_step: of the stream.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        monitor: Monitor,
        options: GuardOptions,
        threshold: float,
        box: gym.spaces.Box | None,
        rows_per_step: int = 1,
    ) -> None:
        chosen = options.reaction(monitor)
        reflex = make_reflex(chosen, env)
        self.reflex = reflex
        self.recalls = check_expectation(reflex, monitor)
        """The monitor is to be asked what it expects to be commanded."""
        named = chosen if isinstance(chosen, str) else ""
        self.ends_on_alarm = named == "terminate"
        graded, acts = named == "graded", named != "monitor" and box is not None
        self.responder = Responder(env, monitor, responses_from(options.responses), repairs=graded)
        rule = make_rule(
            reflex, env, options.release_after, options.release_below, options.max_override, options.try_after
        )
        fallback = None if box is None else make_fallback(env)
        self.substeps = SubstepGuard(env, limits_of(options.contact_limits, monitor), acts, monitor)
        self.arbiter = Arbiter(reflex, threshold, rule.in_rows(rows_per_step), fallback, box)
        self.severity = SeverityEstimator(monitor.spec)
        self.largest: float | None = None
        """Surprise in this episode, while the policy acted."""

    def begin(self) -> None:
        """A new episode has begun in the environment."""
        self.arbiter.reset()
        self.responder.reset()
        self.substeps.begin()
        self.severity.reset()
        self.largest = None
        self._passed = 0  # rows, of which not all has been told

    # ------------------------------------------------------------------ rows in which nothing happens

    @property
    def can_be_quiet(self) -> bool:
        """Whether ``QuietRows`` can judge rows in its place."""
        return len(self.responder.hands) <= 1 and not self.recalls

    @property
    def calm(self) -> bool:
        """Whether they may judge the next row."""
        return self.arbiter.state is State.POLICY and self.responder.calm and self.substeps.calm

    @property
    def hand(self) -> HandAgainstJoints | None:
        """The one that is compared with its joints."""
        return self.responder.hands[0] if self.responder.hands else None

    @property
    def columns(self) -> tuple[NDArray[np.intp], ...]:
        """Those of ``SeverityEstimator`` in a row, and those of ``SubstepGuard`` in what was felt."""
        return *self.severity.columns, *self.substeps.columns

    @property
    def patience(self) -> tuple[float, float]:
        """For how long the arm may lean on something [s], and how much it may press in an episode [N s]."""
        return LEANS_S / (1 + AGAIN * self.arbiter.strikes), self.arbiter.most_impulse

    def let_pass(
        self, rows: list[NDArray[np.float32]], executed: NDArray[np.float32], largest: float, ends_step: bool
    ) -> str:
        """Quiet rows (D,), which are left alone from now on; what failed in the reflex.

        Args:
            executed: (A,).
            largest: of their surprise.
            ends_step: the last of them ends a control step.
        """
        self._passed += len(rows)
        self.responder.let_pass(rows)
        self.largest = max(self.largest or 0.0, largest)
        if ends_step:
            self.substeps.acted()
        return self.arbiter.let_pass(rows, executed, ends_step)

    def passed(self, mean: NDArray[np.float64], impulse: float, leant: float) -> None:
        """What the rows that were let pass have come to."""
        if self._passed:
            self.severity.pressed = impulse, leant
            self.responder.passed(self._passed, mean)
            self._passed = 0

    # ------------------------------------------------------------------ all others

    def read(self, row: NDArray[np.float32], failure: str) -> tuple[NDArray[np.float32], str]:
        """(D,) the next row as the monitor is to see it, and what failed so far."""
        row, doubt = self.responder.read(row), self.responder.doubt
        return row, joined(failure, doubt) if doubt else failure

    def heard(self, surprise: Surprise, failed: bool) -> Surprise:
        """What counts of the surprise at that row, one in a batch."""
        if not self.responder.judged:
            surprise = surprise.without(self.responder.unjudged)
        if self.responder.settling and not failed:
            surprise = surprise.silenced(np.ones(1, np.bool_))
        return surprise

    def judge(
        self,
        surprise: Surprise,
        row: NDArray[np.float32],
        executed: NDArray[np.float32],
        failure: str,
        beneath: Beneath | None,
        expected: NDArray[np.float32] | None = None,
        latency: float = 0.0,
    ) -> RowReport:
        """Who acts next, and what is to be said of the row.

        Args:
            surprise: as ``heard``, one in a batch.
            row: (D,) as ``read``.
            executed: (A,).
            failure: what failed; empty where nothing did.
            beneath: what came of the control step that the row ends; None where it ends none.
            expected: (A,) what the monitor expects to be commanded next.
            latency: of the monitor [s].
        """
        arbiter, value = self.arbiter, float(surprise.value[0])
        if failure:
            arbiter.warn(failure, "which counts as an alarm")
        held = arbiter.overriding
        severity = self.severity.of(row, beneath, held, self.patience[0])
        over, lost, contradicts = not value <= arbiter.threshold, self.responder.lost, self.responder.contradicts
        event = surprise.event(arbiter.threshold)
        knocked = event == KNOCK
        alarm = over or knocked or bool(lost) or contradicts or severity.presses
        if alarm and lost and not (over or knocked or contradicts or severity.presses or failure or severity.fast):
            response = self.responder.missed()
        elif knocked and not (contradicts or severity.presses or failure):
            response = self.responder.knocked()
        else:
            response = self.responder.respond(
                alarm, bool(failure), surprise.attribution[0], severity, arbiter.may_go_on
            )
        sensed = Sensed(
            surprise=value,
            row=row,
            executed=executed,
            alarm=alarm,
            presses=severity.presses,
            knocked=knocked,
            impulse=severity.impulse,
            response=response.name,
            touched=response.touched,
            why=response.why,
            expected=expected,
            ends_step=beneath is not None,
        )
        decision = arbiter.decide(sensed)
        if not decision.intervened:
            self.largest = max(self.largest or 0.0, value)
            if severity.presses:
                self.substeps.pressed()
            elif beneath is not None:
                self.substeps.acted()
        told: tuple[tuple[Any, str], ...] = (severity.presses, CONTACT), (failure, FAILURE), (over or knocked, SURPRISE)
        told += (contradicts, CONTRADICTION), (lost, MISSING)
        reason = next((name for holds, name in told if holds), "")
        if alarm:
            event = FAULT if over or lost or contradicts else KNOCK
        if decision.failure:
            failure = joined(failure, decision.failure)
        return RowReport(surprise, decision, latency, failure, response, severity, reason, event)

    @property
    def forgets(self) -> bool:
        """Whether the evidence so far is of rows that were not what they should have been."""
        return self.responder.settling


def nothing(surprise: Surprise) -> RowReport:
    """Of a row in which there was nothing to decide."""
    return RowReport(surprise, NOTHING, 0.0, "", NO_RESPONSE, Severity(), "")
