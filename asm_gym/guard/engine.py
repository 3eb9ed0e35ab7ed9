"""The guard of n robots: from the actions proposed to them to what they do, and from their rows to who acts next.

    act      proposed actions (n, A)  ► the policy's, or a reflex's ► executed actions (n, A)
    judge    rows (n, D), what was felt  ► repair ► observe ► severity ► diagnose ► arbitrate ► report

Each stage is entered once a row, in arrays; a robot is looked at by itself only where there is an alarm, a repair or an
override.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import EVENTS, FAULT, KNOCK
from asm_gym.guard.arbiter import POLICY, REFLEX, Arbiter, Judged
from asm_gym.guard.diagnosis import Alarm, Diagnostician
from asm_gym.guard.episode_limits import EpisodeLimits, limits_of
from asm_gym.guard.motion import Command, Motions
from asm_gym.guard.observer import STALE, Fitted, Observation, Observer, diagnosis_of, joined
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.preview import Preview, preview_chunk
from asm_gym.guard.reflexes import GRADED, REFLEXES, Reflexes
from asm_gym.guard.report import CONTACT, CONTRADICTION, FAILURE, MISSING, SURPRISE, Outcome, RowReport
from asm_gym.guard.responses import Response, responses_from
from asm_gym.guard.robots import NOTHING, Robots
from asm_gym.guard.rows import Believed, Rows
from asm_gym.guard.severity import SeverityEstimator, nothing_felt
from asm_gym.monitors import ExpectsActions, Monitor
from asm_gym.policies.base import Policy

FAULTY, KNOCKED = EVENTS.index(FAULT), EVENTS.index(KNOCK)

Mask = NDArray[np.bool_]


class Engine:
    """Guards n robots that one monitor watches.

    Args:
        robots: what is known of them.
        monitor: fitted and calibrated for their stream.
        options: what the guard is told.
        policies: the user's own, one for each robot, where ``options`` name no reflex.
        rows_per_step: rows of the stream in a control step.

    Raises:
        ValueError: a reflex that these robots cannot do, or contact limits of another arm; ``"recall"`` with a monitor
            that expects no action.
    """

    def __init__(
        self,
        robots: Robots,
        monitor: Monitor,
        options: GuardOptions,
        policies: Sequence[Policy] = (),
        rows_per_step: int = 1,
    ) -> None:
        n, spec, diagnosis = robots.count, monitor.spec, diagnosis_of(monitor)
        chosen = options.reaction(diagnosis is not None)
        name = chosen if isinstance(chosen, str) else ""
        graded, acts = name == GRADED, bool(policies) or name in (*REFLEXES, GRADED)
        recalls = name == "recall"
        if recalls and not (isinstance(monitor, ExpectsActions) and spec.motor.size):
            raise ValueError(f"recall needs a memory that predicts actions, and {type(monitor).__name__} does not")
        self.fitted = Fitted.of(monitor, spec)
        self.options, self.ends_on_alarm = options, name == "terminate"
        self._count, self._spec, self._name, self._graded, self._robots = n, spec, name, graded, robots
        reflexes = Reflexes(robots, spec, name) if acts and not policies else None
        rule = options.rule(graded, robots.dt, rows_per_step) if acts else None
        self._arbiter = Arbiter(n, rule, self.fitted.threshold, options.adaptive_threshold)
        self._motions = Motions(robots, reflexes, policies, self._arbiter.take_over, self._warn)
        self._severity = SeverityEstimator(n, spec, robots.felt_channels, self._arbiter)
        self._diagnostician = Diagnostician(spec, diagnosis, responses_from(options.responses), graded)
        completion = diagnosis.completion if diagnosis is not None and graded else None
        self._rows = Rows(robots, spec, completion, self._diagnostician.rows)
        self._observer = Observer(monitor, n, self._rows, recalls)
        limits = limits_of(options.contact_limits, monitor, robots.task)
        self._limits = EpisodeLimits(robots, limits, acts=name != "monitor" and robots.rest.size > 0)
        self.running = self._arbiter.running
        """The threshold that follows a policy; None where it does not."""
        self.threshold = self._arbiter.threshold
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        self.confirmed = self._arbiter.confirmed
        """(n,) an alarm in this episode was no false one."""
        self._nothing_felt = nothing_felt(n, robots.felt_size)
        self._everyone, self._nobody = np.ones(n, bool), self._motions.nobody
        self.overriding = self._nobody
        """(n,) whose reflex acts next."""
        self._command = Command(np.zeros((n, robots.rest.size), np.float32), self._nobody, self._nobody, NOTHING)
        self._refused = self._nobody  # whose policy's action was none, in the step that runs
        self._unsaid: Mapping[int, str] = NOTHING  # what failed when the command was chosen, by robot
        self._warned: set[tuple[int, str]] = set()

    @property
    def latency(self) -> float:
        """How long the monitor took for the last rows [s]."""
        return self._observer.latency

    @property
    def limits(self) -> tuple[Any, ...]:
        """Of each robot its contact limits now; the same objects as long as nothing has changed."""
        return self._limits.now

    def begin(self, which: Mask | None = None) -> RowReport:
        """Begin new episodes of the robots of ``which`` (n,), all by default; return what there is to say of that."""
        which = self._everyone if which is None else which
        for part in (self._arbiter, self._motions, self._observer, self._rows, self._severity, self._limits):
            part.begin(which)
        for i in np.flatnonzero(which).tolist():
            self._diagnostician.begin(i)
        self.overriding = self._arbiter.state == REFLEX
        self._warned = {(i, who) for i, who in self._warned if not which[i]}
        return self.nothing()

    def sense(self, rows: NDArray[np.float32]) -> None:
        """Tell where the robots are, by rows (n, D) that are not judged."""
        self._motions.places.sense(rows)

    def nothing(self) -> RowReport:
        """Return that there is nothing to say of any robot."""
        return RowReport.nothing(self._count, self._spec.size, self.threshold)

    def preview(
        self, robot: int, chunk: NDArray[np.float32], row: NDArray[np.float32], last: NDArray[np.float32]
    ) -> Preview:
        """Return what becomes of a robot's chunk of actions (k, A), after a row (D,) and the action (A,) done last."""
        robots, limits = self._robots, self.limits[robot]
        within = np.where(np.isfinite(chunk), np.clip(chunk, robots.low, robots.high), chunk)
        slows = limits is not None and np.isfinite(limits.hand_speed) and robots.limits_contact
        found = preview_chunk(within, row, last, self.fitted.monitor, robots.dt, limits if slows else None)
        return found._replace(kept=chunk if self._name == "monitor" else chunk[: found.at])

    def act(self, actions: NDArray[np.float32], seen: Callable[[int], Any], idle: Mask | None = None) -> Command:
        """Return what is to be done.

        Args:
            actions: (n, A) that the policies want.
            seen: the observation of a robot.
            idle: (n,) nothing is done, for an episode begins.
        """
        names = self._arbiter.response if self._graded else [self._name] * self._count
        idle = self._nobody if idle is None else idle
        self._command, self._refused = self._motions.choose(actions, self.overriding, idle, names, seen)
        self._unsaid = self._command.failures
        if self._refused is not self._nobody:
            self.overriding = self._arbiter.state == REFLEX
        return self._command

    def judge(
        self,
        rows: NDArray[np.float32],
        executed: NDArray[np.float32],
        felt: NDArray[np.float64] | None = None,
        failures: Mapping[int, str] | None = None,
        ends_step: bool = True,
        active: Mask | None = None,
    ) -> RowReport:
        """Judge the next rows, and decide who acts next.

        Args:
            rows: (n, D) as they were sensed.
            executed: (n, A).
            felt: in the step that the rows end; None where nothing feels within steps, or in mid-step.
            failures: what failed when the rows were sensed, by robot.
            ends_step: the rows end a control step.
            active: (n,) whose rows count; all by default.
        """
        active = self._everyone if active is None else active
        held, refused, self._refused = self.overriding, self._refused, self._nobody
        refused = refused if refused is self._nobody else refused & active
        failed = self._failures(failures or NOTHING, refused, active)
        unsaid, self._unsaid = self._unsaid, NOTHING
        believed = self._rows.next(rows, active)
        observed = self._observer.observe(believed.rows, _joined_in_each(failed, believed.failures), active)
        for i, said in observed.failures.items():
            self._warn(i, said, "which counts as an alarm")
        intervened = held if refused is self._nobody else held | refused
        decides = self._known_to_decide(believed, observed.failures, refused)
        severity, over, event, some = self._severity.weigh(
            believed.rows, self._nothing_felt if felt is None else felt, held, observed.surprise, active, decides
        )
        if ends_step:
            self._motions.feel(believed.rows, executed, intervened, active)
        if observed.expected is not None:
            self._motions.expect(observed.expected)
        report = RowReport(
            observed.surprise,
            self.threshold.copy(),
            np.zeros(self._count, bool),
            intervened,
            event,
            self._arbiter.state.copy(),
            severity,
            NOTHING,
            _joined_in_each({i: said for i, said in unsaid.items() if not refused[i]}, observed.failures),
            NOTHING,
            believed.lost,
        )
        if some or self._rows.repairs:
            found = believed, observed, over, executed, refused
            outcomes = {i: self._decide(i, report, *found) for i in np.flatnonzero(decides).tolist()}
            self.overriding = self._arbiter.state == REFLEX
            report = self._completed(report, outcomes, self._forget(outcomes, active))
            self._rows.drop_repairs()
        if some or not self._limits.steady:
            policy = active & ~intervened
            pressed = policy & severity.presses
            self._limits.follow(policy if ends_step else pressed, pressed)
        return report if all(active.tolist()) else report.of(active)

    @property
    def repaired(self) -> Mapping[int, tuple[NDArray[np.float32], Mask]]:
        """The last row (D,) as it should be, and which of its numbers were completed (D,), by robot."""
        if not self._rows.repairs:
            return NOTHING
        found = {i: (self._rows.last(i, 1)[0], repair.missing) for i, repair in self._rows.repairs.items()}
        return {i: (row, missing) for i, (row, missing) in found.items() if missing.any()}

    def amend(self, rows: NDArray[np.float32]) -> None:
        """Tell the monitor that the last rows (n, D) were these: something else was commanded than it seemed."""
        self._observer.amend(rows)

    def _failures(self, failures: Mapping[int, str], refused: Mask, active: Mask) -> Mapping[int, str]:
        """Return all that is known to have failed before the rows are looked at, by robot."""
        found = {i: said for i, said in failures.items() if active[i]} if failures else {}
        for i in np.flatnonzero(refused).tolist() if refused is not self._nobody else ():
            found[i] = joined(self._command.failures.get(i, ""), found.get(i, ""))
        if self.fitted.stale:
            return _joined_in_each(found, dict.fromkeys(np.flatnonzero(active).tolist(), STALE))
        return found

    def _known_to_decide(self, believed: Believed, failures: Mapping[int, str], refused: Mask) -> Mask:
        """Return (n,) where there is something to decide, whatever surprise and severity are."""
        decides, repairs, incidents = refused.copy(), self._rows.repairs, self._diagnostician.incidents
        if believed.lost or believed.contradictions or failures or repairs or incidents:
            decides[[*believed.lost, *believed.contradictions, *failures, *repairs, *incidents]] = True
        return decides

    def _decide(
        self, i: int, row: RowReport, believed: Believed, observed: Observation, beyond: Mask, executed: Any, no: Mask
    ) -> Outcome:
        """Return what is done about the row of robot ``i``.

        Surprise is over its threshold where ``beyond`` (n,) says so; ``no`` (n,) action was the policy's.
        """
        value, (force, impulse, speed) = float(row.surprise.value[i]), row.severity.numbers[i].tolist()
        over, knocked, presses = bool(beyond[i]), bool(row.event[i] == KNOCKED), bool(row.severity.presses[i])
        failed, lost, contradiction = i in observed.failures, i in believed.lost, believed.contradictions.get(i)
        causes = {
            CONTACT: presses,
            FAILURE: failed,
            SURPRISE: over or knocked,
            CONTRADICTION: contradiction is not None,
            MISSING: lost,
        }
        reason = next((name for name, holds in causes.items() if holds), "")
        alarm = over or knocked or presses or lost or contradiction is not None
        rows, diagnostician = self._rows.last(i), self._diagnostician
        if not alarm:
            response = diagnostician.watch(i, rows, bool(self._arbiter.state[i] == POLICY))
        else:
            repair = self._rows.repairs.get(i)
            completed = None if self._rows.read is None else () if repair is None else repair.names
            feels = bool(np.isfinite(row.severity.felt[i, 0]) or np.isfinite(force))
            shares, known, may_go_on = row.surprise.attribution[i], self._rows.known(i), self._arbiter.may_go_on(i)
            found = over, knocked, lost, contradiction, failed, presses, feels, force, speed, may_go_on
            response = self._response(i, Alarm(rows, shares, known, *found, completed))
        intervened = bool(row.intervened[i])
        if not intervened and np.isfinite(value) and (warning := self._arbiter.judge_policy(i, alarm)):
            warnings.warn(warning, stacklevel=4)
        judged = Judged(value, over, knocked, alarm, presses, impulse, intervened, bool(no[i]), response)
        decision = self._arbiter.decide(i, judged)
        if decision.takes_over:
            self._motions.start(i, executed[i])
        event = 0 if not alarm else FAULTY if over or lost or contradiction else KNOCKED
        return Outcome(alarm, reason, event, response, decision)

    def _response(self, robot: int, alarm: Alarm) -> Response:
        """Return what is to be done about an alarm, once the sensors at fault are completed."""
        response, columns = self._diagnostician.respond(robot, alarm)
        if columns.size or (response.name == "complete" and not alarm.only_lost):
            if self._rows.suspect(robot, columns):
                self._diagnostician.begin(robot)
            elif response.name == "complete":
                return self._diagnostician.uncompleted(response)
        return response

    def _forget(self, outcomes: Mapping[int, Outcome], active: Mask) -> Mapping[int, str]:
        """Let evidence begin anew where it was acted on, or is of rows not yet repaired; return what failed."""
        acted_on = np.zeros(self._count, bool)
        for i, outcome in outcomes.items():
            acted_on[i] = outcome.decision.acted_on
        for i, repair in self._rows.repairs.items():
            acted_on[i] |= repair.settling > 0
        acted_on &= active
        if not acted_on.any() or not (said := self._observer.forget(acted_on)):
            return NOTHING
        return dict.fromkeys(np.flatnonzero(acted_on).tolist(), said)

    def _completed(self, report: RowReport, outcomes: Mapping[int, Outcome], failures: Mapping[int, str]) -> RowReport:
        """Return a report with what was decided, completed, and failed meanwhile."""
        for i, outcome in outcomes.items():
            if outcome.alarm:
                report.alarm[i], report.event[i] = True, outcome.event
        repairs = {i: repair.names for i, repair in self._rows.repairs.items()}
        failed, state = _joined_in_each(report.failure, failures), self._arbiter.state.copy()
        return report._replace(state=state, outcomes=outcomes, failure=failed, repairs=repairs)

    def _warn(self, robot: int, failure: str, instead: str) -> None:
        """Say what failed, and what happens instead: once an episode for each part that can fail."""
        who = robot, failure.partition(":")[0]
        if who not in self._warned:
            self._warned.add(who)
            warnings.warn(f"{failure}; {instead}", stacklevel=4)


def _joined_in_each(failures: Mapping[int, str], more: Mapping[int, str]) -> Mapping[int, str]:
    """Return what failed by robot, of two times or parts."""
    if not (failures and more):
        return failures or more
    return {i: joined(failures.get(i, ""), more.get(i, "")) for i in (*failures, *more)}
