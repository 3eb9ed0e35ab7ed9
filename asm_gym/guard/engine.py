"""The guard of n robots: from the actions proposed to them to what they do, and from their rows to who acts next.

    act      proposed actions (n, A)  ► the policy's, or a reflex's ► executed actions (n, A)
    judge    rows (n, D), what was felt  ► repair ► observe ► severity ► diagnose ► arbitrate ► report

Each stage is entered once a row, in arrays; a robot is looked at by itself only where there is an alarm, a repair or an
override.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import EVENTS, FAULT, KNOCK
from asm_gym.guard.arbiter import POLICY, REFLEX, Arbiter, Judged
from asm_gym.guard.checks import STALE, Fitted, diagnosis_of, familiar_to, limits_of
from asm_gym.guard.diagnosis import Alarm, Diagnostician
from asm_gym.guard.limits import EpisodeLimits
from asm_gym.guard.motion import Command, Motions
from asm_gym.guard.observer import Observation, Observer, joined
from asm_gym.guard.options import LEANS_S, TRUST_S, GuardOptions
from asm_gym.guard.reflexes import GRADED, REFLEXES, Reflexes
from asm_gym.guard.report import CONTACT, CONTRADICTION, FAILURE, MISSING, SURPRISE, Outcome, RowReport
from asm_gym.guard.responses import NO_RESPONSE, Response, responses_from
from asm_gym.guard.robots import NOTHING, Robots
from asm_gym.guard.rows import Believed, Rows
from asm_gym.guard.severity import FAST, Severity, SeverityEstimator, Weighed, nothing_felt
from asm_gym.monitors import ExpectsActions, LearnsOnTheJob, Monitor
from asm_gym.policies.base import Policy

FAULTY, KNOCKED = EVENTS.index(FAULT), EVENTS.index(KNOCK)

Mask = NDArray[np.bool_]


class _Row(NamedTuple):
    """The next row of each of n robots, as the stages before the decision have left it."""

    believed: Believed
    observed: Observation
    severity: Severity
    weighed: Weighed
    executed: NDArray[np.float32]  # (n, A)
    intervened: Mask  # (n,) something else than the policy acted
    refused: Mask  # (n,) the policy's action was none
    active: Mask  # (n,) the row counts


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
            that expects no action, or learning on the job with one that cannot.
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
            raise ValueError(f"recall needs a memory that expects actions, and {type(monitor).__name__} does not")
        if options.online_learning_rate > 0 and not isinstance(monitor, LearnsOnTheJob):
            raise ValueError(f"{type(monitor).__name__} cannot learn on the job: online_learning_rate must be 0")
        limits = limits_of(options.contact_limits, monitor)
        self.fitted = Fitted.of(monitor, spec)
        self.options, self.ends_on_alarm = options, name == "terminate"
        self._count, self._spec, self._name, self._graded = n, spec, name, graded
        reflexes = Reflexes(robots, spec, name) if acts and not policies else None
        rule = options.rule(graded, robots.dt, rows_per_step) if acts else None
        self._arbiter = Arbiter(n, rule, self.fitted.threshold)
        self._motions = Motions(robots, reflexes, policies, self._arbiter.take_over, self._warn)
        self._observer = Observer(monitor, n, recalls)
        self._severity = SeverityEstimator(n, spec, robots.felt_channels, LEANS_S, self._arbiter)
        table = responses_from(options.responses)
        self._diagnostician = Diagnostician(robots, spec, diagnosis, table, graded)
        completion = diagnosis.completion if diagnosis is not None and graded else None
        self._rows = Rows(robots, spec, completion, TRUST_S, self._diagnostician.rows)
        limited = name != "monitor" and robots.rest.size > 0
        self._limits = EpisodeLimits(robots, spec, limits, limited, familiar_to(monitor, limits))
        adaptive = options.adaptive_threshold
        self.running = None if adaptive is None else adaptive.start(self.fitted.threshold)
        """The threshold that follows a policy; None where it does not."""
        self.confirmed = np.zeros(n, bool)
        """(n,) an alarm in this episode was no false one."""
        self._nothing_felt = nothing_felt(n, robots.felt_size)
        self._everyone, self._nobody = np.ones(n, bool), self._motions.nobody
        self._held = self._nobody  # whose reflex acts next
        self._command = Command(np.zeros((n, robots.rest.size), np.float32), self._nobody, self._nobody, NOTHING)
        self._refused = self._nobody  # whose policy's action was none, in the step that runs
        self._warm = self._said_late = False
        self._warned: set[tuple[int, str]] = set()

    # ------------------------------------------------------------------ episodes

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        return self._arbiter.threshold

    @property
    def overriding(self) -> Mask:
        """(n,) whose reflex acts next."""
        return self._held

    @property
    def limits(self) -> tuple[Any, ...]:
        """Of each robot its contact limits now; the same objects as long as nothing has changed."""
        return self._limits.now

    def begin(self, which: Mask | None = None) -> RowReport:
        """Begin new episodes of the robots of ``which`` (n,), all by default; return what there is to say of that."""
        which = self._everyone if which is None else which
        for i in np.flatnonzero(which) if self.running is not None else ():
            self._follow_policy(int(i))
        self.confirmed[which] = False
        for part in (self._arbiter, self._motions, self._observer, self._rows, self._severity, self._limits):
            part.begin(which)
        for i in np.flatnonzero(which):
            self._diagnostician.begin(int(i))
        self._held = self._arbiter.state == REFLEX
        self._warned = {(i, who) for i, who in self._warned if not which[i]}
        return self.nothing()

    def nothing(self) -> RowReport:
        """Return that there is nothing to say of any robot."""
        return RowReport.nothing(self._count, self._spec.size, self.threshold)

    def _follow_policy(self, robot: int) -> None:
        """Move the threshold by the episode of a robot that has ended."""
        assert self.running is not None
        largest = float(self._arbiter.largest[robot])
        if largest > -np.inf:
            confirmed = bool(self.confirmed[robot] or self._arbiter.confirmed[robot])
            self.running.follow(largest, float(self.threshold[robot]), confirmed)
            self.threshold[robot] = self.running.value

    # ------------------------------------------------------------------ what is done

    def act(self, actions: NDArray[np.float32], seen: Callable[[int], Any], idle: Mask | None = None) -> Command:
        """Return what is to be done.

        Args:
            actions: (n, A) that the policies want.
            seen: the observation of a robot.
            idle: (n,) nothing is done, for an episode begins.
        """
        names = self._arbiter.response if self._graded else [self._name] * self._count
        idle = self._nobody if idle is None else idle
        self._command, self._refused = self._motions.choose(actions, self._held, idle, names, seen)
        if self._refused is not self._nobody:
            self._held = self._arbiter.state == REFLEX
        return self._command

    # ------------------------------------------------------------------ what comes of it

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
        held, refused, self._refused = self._held, self._refused, self._nobody
        refused = refused if refused is self._nobody else refused & active
        failed = self._failures(failures or NOTHING, refused, active)
        believed = self._rows.next(rows, active)
        for i, said in believed.failures.items():
            failed[i] = joined(failed.get(i, ""), said)
        observed = self._observed(believed, failed, held, active)
        intervened = held if refused is self._nobody else held | refused
        decides = self._known_to_decide(believed, observed.failures, refused)
        severity, weighed = self._severity.weigh(
            believed.rows, self._nothing_felt if felt is None else felt, held, observed.surprise, active, decides
        )
        row = _Row(believed, observed, severity, weighed, executed, intervened, refused, active)
        unfelt = self._motions.feel(believed.rows, executed, intervened, active) if ends_step else NOTHING
        if observed.expected is not None:
            self._motions.expect(observed.expected)
        outcomes = (
            {i: self._decide(i, row) for i in np.flatnonzero(weighed.decides).tolist()} if weighed.some else NOTHING
        )
        if outcomes:
            self._held = self._arbiter.state == REFLEX
        if outcomes or not self._limits.steady:
            policy = active & ~intervened
            pressed = policy & severity.presses
            self._limits.follow(believed.rows, policy if ends_step else pressed, pressed)
        unforgotten = self._forget(row, outcomes) if outcomes or self._rows.repairs else NOTHING
        report = self._report(row, outcomes, (unfelt, unforgotten))
        if self._rows.repairs:
            self._rows.drop_repairs()
        return report

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

    def _failures(self, failures: Mapping[int, str], refused: Mask, active: Mask) -> dict[int, str]:
        """Return all that is known to have failed before the rows are looked at, by robot."""
        found = {i: said for i, said in failures.items() if active[i]} if failures else {}
        for i in np.flatnonzero(refused).tolist() if refused is not self._nobody else ():
            found[i] = joined(self._command.failures.get(i, ""), found.get(i, ""))
        if self.fitted.stale:
            found |= {i: joined(found.get(i, ""), STALE) for i in map(int, np.flatnonzero(active))}
        return found

    def _observed(self, believed: Believed, failures: dict[int, str], held: Mask, active: Mask) -> Observation:
        """Return what counts of the surprise at the rows; none of it where they are not ``active`` (n,)."""
        observed = self._observer.observe(believed.rows, failures)
        late, rate, failed = self._late(observed.latency), self.options.online_learning_rate, observed.failures
        if active is self._everyone and not (late or rate or failed or self._rows.repairs):
            return observed
        surprise = self._rows.counted(observed.surprise, failed)
        if late:
            surprise = surprise._replace(value=np.full(self._count, np.inf))
        if rate > 0 and not failed and not held.any() and (said := self._observer.learn(believed.rows, surprise, rate)):
            failed = dict.fromkeys(range(self._count), said)
            surprise = surprise._replace(value=np.full(self._count, np.inf))
        if not active.all():
            surprise = surprise.silenced(~active)
        for i, said in failed.items():
            self._warn(i, said, "which counts as an alarm")
        return Observation(surprise, observed.expected, failed, observed.latency)

    def _known_to_decide(self, believed: Believed, failures: Mapping[int, str], refused: Mask) -> Mask:
        """Return (n,) where there is something to decide, whatever surprise and severity are."""
        decides, incidents = refused.copy(), self._diagnostician.incidents
        known = *believed.lost, *believed.contradictions, *failures, *self._rows.repairs, *incidents
        if known:
            decides[list(known)] = True
        return decides

    def _decide(self, robot: int, row: _Row) -> Outcome:
        """Return what is done about the row of one robot."""
        i, value = robot, float(row.observed.surprise.value[robot])
        over, knocked, presses = (
            bool(x[i]) for x in (row.weighed.over, row.weighed.event == KNOCKED, row.severity.presses)
        )
        failed, lost, contradicts = i in row.observed.failures, i in row.believed.lost, i in row.believed.contradictions
        alarm = over or knocked or lost or contradicts or presses
        response = self._response(i, row, alarm)
        intervened, impulse = bool(row.intervened[i]), float(row.severity.numbers[i, 1])
        if not intervened and np.isfinite(value) and (warning := self._arbiter.judge_policy(i, alarm)):
            warnings.warn(warning, stacklevel=4)
        judged = Judged(value, over, knocked, alarm, presses, impulse, intervened, bool(row.refused[i]), response)
        decision = self._arbiter.decide(i, judged)
        if decision.takes_over:
            self._motions.start(i, row.executed[i])
        told = (presses, CONTACT), (failed, FAILURE), (over or knocked, SURPRISE)
        reason = next((name for holds, name in (*told, (contradicts, CONTRADICTION), (lost, MISSING)) if holds), "")
        event = 0 if not alarm else FAULTY if over or lost or contradicts else KNOCKED
        return Outcome(alarm, reason, event, response, decision)

    def _response(self, robot: int, row: _Row, alarm: bool) -> Response:
        """Return what is to be done about the last row of one robot."""
        i, diagnostician, weighed, severity = robot, self._diagnostician, row.weighed, row.severity
        rows = self._rows.last(i)
        if not alarm:
            return diagnostician.watch(i, rows, bool(self._arbiter.state[i] == POLICY))
        failed, lost = i in row.observed.failures, i in row.believed.lost
        contradiction = row.believed.contradictions.get(i)
        certain = contradiction is not None or failed or bool(severity.presses[i])
        if lost and not (certain or weighed.over[i] or weighed.knocked(i) or severity.numbers[i, 2] > FAST):
            repair = self._rows.repairs.get(i)
            return (
                NO_RESPONSE if self._rows.read is None else diagnostician.missed(() if repair is None else repair.names)
            )
        if weighed.knocked(i) and not certain:
            return diagnostician.knocked(i, rows)
        force, _, speed = severity.numbers[i].tolist()
        feels = bool(np.isfinite(severity.felt[i, 0]) or np.isfinite(force))
        response, columns = diagnostician.respond(
            i,
            Alarm(
                rows,
                row.observed.surprise.attribution[i],
                self._rows.explained(i),
                contradiction,
                failed,
                bool(severity.presses[i]),
                feels,
                force,
                speed,
                self._arbiter.may_go_on(i),
                self._rows.read,
            ),
        )
        if columns.size or response.name == "complete":
            if self._rows.suspect(i, columns):
                diagnostician.begin(i)
            elif response.name == "complete":
                response = diagnostician.uncompleted(response)
        return response

    def _forget(self, row: _Row, outcomes: Mapping[int, Outcome]) -> Mapping[int, str]:
        """Let evidence begin anew where it was acted on, or is of rows not yet repaired; return what failed."""
        acted_on = np.zeros(self._count, bool)
        for i, outcome in outcomes.items():
            acted_on[i] = outcome.decision.acted_on
        for i, repair in self._rows.repairs.items():
            acted_on[i] |= repair.settling > 0
        acted_on &= row.active
        if not acted_on.any() or not (said := self._observer.forget(acted_on)):
            return {}
        return dict.fromkeys(map(int, np.flatnonzero(acted_on)), said)

    def _report(self, row: _Row, outcomes: Mapping[int, Outcome], failures: Sequence[Mapping[int, str]]) -> RowReport:
        """Return what there is to say of the rows."""
        alarm, event, failed = np.zeros(self._count, bool), row.weighed.event, row.observed.failures
        for i, outcome in outcomes.items():
            if outcome.alarm:
                alarm[i], event[i] = True, outcome.event
        for some in failures:
            failed = {**failed, **{i: joined(failed.get(i, ""), said) for i, said in some.items()}} if some else failed
        repairs = self._rows.repairs
        said = RowReport(
            row.observed.surprise,
            self.threshold.copy(),
            alarm,
            row.intervened,
            event,
            self._arbiter.state.copy(),
            row.severity,
            outcomes,
            failed,
            {i: (repair.names, repair.unread) for i, repair in repairs.items()} if repairs else NOTHING,
            row.believed.lost,
            row.observed.latency,
        )
        return said if row.active is self._everyone or row.active.all() else said.of(row.active)

    def _late(self, latency: float) -> bool:
        """Return whether the monitor took so long that it counts as an alarm."""
        late, self._warm = self._warm and latency > self._spec.dt, True
        if late and self.options.on_overrun == "warn" and not self._said_late:
            self._said_late = True
            said = f"the monitor took {1e3 * latency:.1f} ms for a row that lasts {1e3 * self._spec.dt:.1f} ms"
            warnings.warn(said, stacklevel=4)
        return late and self.options.on_overrun == "alarm"

    def _warn(self, robot: int, failure: str, instead: str) -> None:
        """Say what failed, and what happens instead: once an episode for each part that can fail."""
        who = robot, failure.partition(":")[0]
        if who not in self._warned:
            self._warned.add(who)
            warnings.warn(f"{failure}; {instead}", stacklevel=4)
