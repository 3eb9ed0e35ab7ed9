"""The guard of n robots: from the actions that are proposed to them to what they do, and from their rows to who acts.

    act      proposed actions (n, A) ► the policy's, or a reflex's ► Command

    judge    SensedRows ► validate ► observe ► measure contact ► alarm rule ► count        one compiled call
                 └► only for robots with something to decide: evidence ► prescribe ► arbitrate
             ► RowReport

The state of the robots is one table, ``robot_table.ROBOT``. Each stage is entered once a row.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import one_thread_for
from asm_gym.compilation import bind
from asm_gym.detection.alarm_rule import FAULT_EVENT, JUDGED, KNOCK_EVENT
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.alarm_terms import BY_CAUSE, CONTACT, SURPRISE, AlarmTerms
from asm_gym.guard.arbiter import Arbiter
from asm_gym.guard.commander import Command, Commander, Floats32, Observe
from asm_gym.guard.contact_state import contact_columns, measure_contacts, no_load
from asm_gym.guard.diagnostician import Diagnostician
from asm_gym.guard.episode_limits import EpisodeLimits, limits_of
from asm_gym.guard.fitted_monitor import STALE, FittedMonitor, diagnosis_of
from asm_gym.guard.judged_rows import STOPPED, GuardArrays, apply_alarm_rule, judge_rows
from asm_gym.guard.observer import Observer, joined, unjudged
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.preview import Preview, preview_chunk
from asm_gym.guard.reflexes import GRADED, REFLEXES, FeltMotion, motion_arrays, record_motion
from asm_gym.guard.report import Outcome, RowReport
from asm_gym.guard.responses import Response, responses_from, unexplained
from asm_gym.guard.robot_facts import NOTHING, RobotFacts
from asm_gym.guard.robot_table import (
    POLICY,
    REFLEX,
    Mask,
    RobotTable,
    cleared,
    copied,
    damaged,
)
from asm_gym.guard.row_evidence import RowEvidence
from asm_gym.guard.row_validation import RowValidator, ValidatedRows
from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.base import Policy


@dataclass(slots=True)
class Row:
    """A row of n robots while it is judged."""

    rows: Floats32  # (n, D) as they were sensed, with NaN for stale senses
    load: NDArray[np.float64]  # (n, 2 + F), see ``no_load``
    executed: Floats32  # (n, A) in the step of the row
    ends_step: bool
    attribution: NDArray[np.float64]  # (n, D)
    failures: dict[int, str] = field(default_factory=dict)  # by robot
    # what failed without a consequence, by robot
    unreported: Mapping[int, str] = field(default_factory=dict)
    # numbers that are not finite, by robot
    lost: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    contradictions: Mapping[int, Any] = field(default_factory=dict)  # by robot
    terms: Mapping[str, Mask] = field(default_factory=dict)  # where each alarm term holds (n,)
    outcomes: dict[int, Outcome] = field(default_factory=dict)  # by robot


class Guard:
    """Guards n robots that one monitor watches.

    Args:
        facts: what is known of the robots.
        monitor: fitted and calibrated for their stream.
        options: what the guard is told.
        policies: the user's own, one for each robot, where ``options`` name no reflex.
        rows_per_step: rows of the stream in a control step.

    Attributes:
        table: the records of the robots.
        terms: alarm terms, and how often each held.
        fitted: the monitor as it was taken up.
        running: the threshold that follows a policy; None where it does not.
        ends_on_alarm: an alarm ends the episode.

    Raises:
        ValueError: a reflex that these robots cannot do, or contact limits of another arm; ``"recall"`` with a monitor
            that expects no action.
    """

    def __init__(
        self,
        facts: RobotFacts,
        monitor: Monitor,
        options: GuardOptions,
        policies: Sequence[Policy] = (),
        rows_per_step: int = 1,
    ) -> None:
        spec = monitor.spec
        diagnosis = diagnosis_of(monitor)
        reaction = options.reaction(diagnosis is not None)
        name = ""  # a policy of the user's own acts
        if isinstance(reaction, str):
            name = reaction
        self._name = name
        self._graded = name == GRADED
        self._facts = facts
        self._spec = spec
        self.options = options
        self.ends_on_alarm = name == "terminate"
        self.fitted = FittedMonitor.of(monitor, spec)
        self.terms = AlarmTerms()
        self.table = RobotTable(facts.count, spec, self.fitted.threshold)

        motion = None
        rule = None
        if policies or name in (*REFLEXES, GRADED):
            rule = options.rule(self._graded, facts.dt, rows_per_step)
            if not policies:
                motion = FeltMotion.of(facts, spec, name)
        completion = None
        if diagnosis is not None and self._graded:
            completion = diagnosis.completion

        table = responses_from(options.responses)
        self._arbiter = Arbiter(self.table, rule, options.adaptive_threshold)
        self._diagnostician = Diagnostician(spec, diagnosis, table, self._graded)
        self._validator = RowValidator(facts, self.table, completion, self._diagnostician.rows)
        self._observer = Observer(monitor, facts.count, recalls=name == "recall")
        self._commander = Commander(
            facts=facts,
            table=self.table,
            motion=motion,
            policies=policies,
            arbiter=self._arbiter,
            warn=self._warn,
            commands=getattr(monitor, "commands_", None),
        )
        limits = limits_of(options.contact_limits, monitor, facts)
        self._limits = EpisodeLimits(facts, limits, acts=name != "monitor" and facts.rest.size > 0)
        self._bind(motion)

        self.running = self._arbiter.running
        self._warned: set[tuple[int, str]] = set()  # robots, and the part that failed
        self._nobody = np.zeros(facts.count, bool)  # never written to
        self._everyone = ~self._nobody
        self._all_active = True  # what the records say
        self._marked = False  # there is something to say of the row: it failed, or is to be decided
        self._unreported: Mapping[int, str] = NOTHING  # what failed when the command was chosen

    def _bind(self, motion: FeltMotion | None) -> None:
        """Gather the arrays that compiled code works on."""
        facts = self._facts
        hands = self._validator.hands
        self._no_load = no_load(facts.count, facts.felt_size)
        self._arrays = GuardArrays(
            robots=self.table.records,
            recent=self._validator.recent.arrays,
            hand_geometry=hands.geometry,
            hand_state=hands.state,
            contact_columns=contact_columns(facts.felt_channels, self._spec),
            motion=motion_arrays(motion, facts),
            judged=np.zeros(facts.count, JUDGED),
            dt=self._spec.dt,
            most_impulse=float(self._arbiter.most_impulse),
        )
        self._bound = bind(self._arrays)

    # ------------------------------------------------------------------ what wrappers ask

    @property
    def latency(self) -> float:
        """How long the monitor took for the last rows [s]."""
        return self._observer.latency

    @property
    def limits(self) -> tuple[Any, ...]:
        """Of each robot its contact limits now; the same objects as long as nothing has changed."""
        return self._limits.now

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        return np.array(self.table.records["threshold"])

    @property
    def overriding(self) -> Mask:
        """(n,) whose reflex acts next."""
        return np.asarray(self.table.records["state"] == REFLEX)

    @property
    def repaired(self) -> Mapping[int, tuple[Floats32, Mask]]:
        """The last row (D,) as it should be, and which of its numbers were completed (D,), by robot."""
        repairs = self._validator.repairs
        if not repairs:
            return NOTHING
        return {
            robot: (self._validator.last(robot)[-1], repair.missing)
            for robot, repair in repairs.items()
            if repair.missing.any()
        }

    def confirm(self, which: Mask) -> None:
        """Confirm that the alarms of the robots of ``which`` (n,) in these episodes were real."""
        self.table.records["confirmed"] |= which

    def begin(self, which: Mask | None = None) -> RowReport:
        """Begin new episodes of the robots of ``which`` (n,), all by default; return what there is to say of that."""
        if which is None:
            which = self._everyone
        self._arbiter.follow_thresholds(which)
        for part in (
            self.table,
            self._arbiter,
            self._commander,
            self._observer,
            self._validator,
            self._limits,
        ):
            part.begin(which)
        for robot in np.flatnonzero(which).tolist():
            self._diagnostician.begin(robot)
        self._warned = {(robot, part) for robot, part in self._warned if not which[robot]}
        return self.nothing()

    def nothing(self) -> RowReport:
        """Return that there is nothing to say of any robot, as before the first row of an episode."""
        attribution = np.zeros((self._facts.count, self._spec.size))
        return RowReport(cleared(self.table.records), attribution)

    def sense(self, rows: Floats32) -> None:
        """Tell where the robots are, by rows (n, D) that are not judged."""
        self._commander.holding.sense(rows)

    def amend(self, rows: Floats32) -> None:
        """Tell the monitor that the last rows (n, D) were these: something else was commanded than it seemed."""
        self._observer.amend(rows)

    def preview(self, robot: int, chunk: Floats32, row: Floats32, last: Floats32) -> Preview:
        """Return what becomes of a robot's chunk of actions (k, A), after a row (D,) and the action (A,) done last."""
        facts = self._facts
        limits = self.limits[robot]
        within = np.where(np.isfinite(chunk), np.clip(chunk, facts.low, facts.high), chunk)
        slows = limits is not None and np.isfinite(limits.hand_speed) and facts.limits_contact
        if not slows:
            limits = None
        preview = preview_chunk(within, row, last, self.fitted.monitor, facts.dt, limits)
        if self._name == "monitor":
            return preview._replace(kept=chunk)
        return preview._replace(kept=chunk[: preview.at])

    def __str__(self) -> str:
        """Return the alarm terms, with how often each held, and the table of robots."""
        return f"{self.terms}\n\n{self.table}"

    # ------------------------------------------------------------------ act

    def act(self, proposed: Floats32, observe: Observe, idle: Mask | None = None) -> Command:
        """Return what is to be done.

        Args:
            proposed: (n, A) actions of the policies.
            observe: returns the observation of a robot.
            idle: (n,) nothing is done, for an episode begins.
        """
        reflexes = self._arbiter.response
        if not self._graded:
            reflexes = [self._name] * self._facts.count
        if idle is None:
            idle = self._nobody
        command = self._commander.choose(proposed, idle, reflexes, observe)
        self._unreported = command.failures
        return command

    # ------------------------------------------------------------------ judge

    def judge(
        self,
        sensed: SensedRows,
        executed: Floats32,
        ends_step: bool = True,
        active: Mask | None = None,
    ) -> RowReport:
        """Judge the next rows, and decide who acts next.

        Args:
            sensed: rows, loads and failures.
            executed: (n, A) in the step of the rows.
            ends_step: the rows end a control step.
            active: (n,) whose rows count; all by default.
        """
        row = self._take_up(sensed, executed, ends_step, active)
        memory = self._compiled_memory()
        if memory is None:
            to_decide = self._judge_in_steps(row, self._validator.validate(row.rows))
        else:
            to_decide = self._judge_in_one_call(row, memory)
            if to_decide == STOPPED:
                to_decide = self._judge_in_steps(row, self._validator.repair(row.rows))
        for robot, failure in row.failures.items():
            self._warn(robot, failure, "which counts as an alarm")
        if to_decide:
            self._marked = True
            self._decide(row)
        self._follow(row)
        report = self._report(row)
        self._clear_marks()
        return report

    def _take_up(
        self, sensed: SensedRows, executed: Floats32, ends_step: bool, active: Mask | None
    ) -> Row:
        """Write into the table what is known before the rows are judged."""
        records = self.table.records
        rows = np.array(sensed.rows, np.float32)  # a copy, in which stale senses are left out
        self.table.rows = rows
        self.table.infos = sensed.infos
        if active is None:
            active = self._everyone
        if active is not self._everyone or not self._all_active:
            records["active"] = active
            self._all_active = bool(active.all())
        records["ends_step"] = ends_step
        load = sensed.load
        if load is None:
            load = self._no_load
        row = Row(
            rows=rows,
            load=load,
            executed=executed,
            ends_step=ends_step,
            attribution=np.empty(rows.shape),
        )
        if sensed.failures or self._unreported or self.fitted.stale:
            self._mark_failures(row, sensed.failures)
        incidents = self._diagnostician.incidents
        if incidents:
            records["must_decide"][list(incidents)] = True
            self._marked = True
        return row

    def _mark_failures(self, row: Row, sensing: Mapping[int, str]) -> None:
        """Take up what failed before the rows are looked at: choosing the command, sensing, or a monitor refitted."""
        records = self.table.records
        refused = records["refused"] & ~records["out_of_range"]
        choosing = self._unreported
        row.unreported = {robot: why for robot, why in choosing.items() if not refused[robot]}
        self._unreported = NOTHING
        self._marked = True
        stale = ""
        if self.fitted.stale:
            stale = STALE
        for robot in np.flatnonzero(records["active"]).tolist():
            failures = [sensing.get(robot, ""), stale]
            if refused[robot]:
                failures.insert(0, choosing.get(robot, ""))
            if any(failures):
                self._fail(row, robot, joined(*failures))

    def _fail(self, row: Row, robot: int, failure: str) -> None:
        """Note that something failed in the row of an active robot: its surprise is infinite."""
        if not self.table.records["active"][robot]:
            return
        row.failures[robot] = joined(row.failures.get(robot, ""), failure)
        self.table.records["failed"][robot] = True
        self._marked = True

    def _compiled_memory(self) -> Any:
        """Return what compiled code needs to judge the next rows; None where Python takes part in them."""
        if self._validator.repairs or self.terms.of_user:
            return None
        return self._observer.compiled_step()

    def _judge_in_one_call(self, row: Row, memory: Any) -> int:
        """Judge rows by one compiled call; return how many robots there are to decide about, or ``STOPPED``."""
        start = time.perf_counter()
        with one_thread_for(len(row.rows)):
            to_decide = judge_rows(
                self._bound, memory, row.rows, row.load, row.executed, row.attribution
            )
        if to_decide != STOPPED:
            self._observer.stepped(memory, time.perf_counter() - start)
        return to_decide

    def _judge_in_steps(self, row: Row, validated: ValidatedRows) -> int:
        """Judge validated rows by the functions that ``judge_rows`` is made of; return how many are to decide about.

        Python takes part: a monitor that is not compiled, a sense that is completed, or a user's alarm term.
        """
        records = self.table.records
        row.rows = validated.rows
        row.lost = validated.lost
        row.contradictions = validated.contradictions
        if row.lost or self._validator.repairs:
            self._marked = True
        for robot, failure in validated.failures.items():
            self._fail(row, robot, failure)
        for robot, failure in self._observer.observe(
            row.rows, self._arrays.judged, row.attribution
        ).items():
            self._fail(row, robot, failure)
        self._leave_out_repaired(row)
        arrays = self._arrays
        measure_contacts(
            records, row.rows, row.load, arrays.contact_columns, arrays.dt, arrays.most_impulse
        )
        if self.terms.of_user:
            self._ask_users(row)
        records["must_decide"][list(self._validator.repairs)] = True
        to_decide = apply_alarm_rule(records, self._arrays.judged, row.attribution)
        record_motion(records, row.rows, row.executed, self._arrays.motion)
        return int(to_decide)

    def _ask_users(self, row: Row) -> None:
        """Mark the robots for which an alarm term of the user's own holds, or all where one fails."""
        failure = self.terms.ask_users(self.table)
        self.table.records["must_decide"] |= self.terms.any_of_user()
        if failure:
            for robot in range(self._facts.count):
                self._fail(row, robot, failure)

    def _leave_out_repaired(self, row: Row) -> None:
        """Leave out of the surprise what is completed, or changes from what was."""
        for robot, repair in self._validator.repairs.items():
            own = slice(robot, robot + 1)
            judged = self._arrays.judged[own]
            surprise = Surprise(
                judged["surprise"], row.attribution[own], raw=judged["raw_surprise"]
            )
            surprise = surprise.without(repair.unjudged)
            if repair.settling and robot not in row.failures:
                surprise = surprise.silenced(np.ones(1, bool))
            judged["surprise"] = surprise.value
            judged["raw_surprise"] = surprise.raw
            row.attribution[own] = surprise.attribution

    # ------------------------------------------------------------------ decide

    def _decide(self, row: Row) -> None:
        """Decide about the robots that are marked."""
        records = self.table.records
        for failures in (unjudged(self._arrays.judged), damaged(records)):
            for robot, failure in failures.items():
                self._fail(row, robot, failure)
                self._warn(robot, failure, "which counts as an alarm")
        row.terms = self.terms.masks(self.table)
        for robot in np.flatnonzero(records["must_decide"]).tolist():
            row.outcomes[robot] = self._decide_about(robot, row)
        self._forget_evidence(row)
        self._validator.drop_repairs()

    def _decide_about(self, index: int, row: Row) -> Outcome:
        """Return what is done about the row of one robot."""
        robot = self.table.robot(index)
        evidence = RowEvidence(
            index=index,
            robot=robot,
            rows=self._validator.last(index),
            attribution=row.attribution[index],
            accounted_for=self._validator.accounted_for(index),
            terms=tuple(name for name, mask in row.terms.items() if mask[index]),
            contradiction=row.contradictions.get(index),
            completed=self._validator.completed_names(index),
            may_go_on=self._arbiter.may_go_on(index),
        )
        if evidence.alarm:
            response = self._respond(evidence)
        else:
            response = self._diagnostician.watch(evidence, policy_acts=bool(robot.state == POLICY))
        if not robot.overridden and np.isfinite(robot.surprise):
            warning = self._arbiter.count_policy_row(evidence)
            if warning:
                warnings.warn(warning, stacklevel=5)

        decision = self._arbiter.decide(evidence, response)
        if decision.takes_over:
            self._commander.start_override(index, row.executed[index])
        self.terms.count(evidence.terms)
        if not evidence.alarm:
            return Outcome(response=response, decision=decision)
        robot.alarm = True
        robot.event = FAULT_EVENT
        if self._is_knock(evidence):
            robot.event = KNOCK_EVENT
        return Outcome(evidence.terms, int(robot.event), response, decision)

    @staticmethod
    def _is_knock(evidence: RowEvidence) -> bool:
        """Return whether an alarm is of a contact, or of surprise that a knock keeps under the threshold."""
        return set(evidence.terms) <= {CONTACT, SURPRISE} and not evidence.robot.over

    def _respond(self, evidence: RowEvidence) -> Response:
        """Return what is to be done about an alarm, once the sensors at fault are completed."""
        reason = evidence.terms[0]
        asked = self.terms.terms[reason].response
        if asked != BY_CAUSE and self._graded:
            return unexplained(asked, reason)
        response, columns = self._diagnostician.prescribe(evidence)
        # Complete the sensors that diagnosis blames: what is only missing is completed already.
        # Then diagnosis begins anew, on the completed rows.
        if columns.size or (response.name == "complete" and not evidence.only_lost):
            if self._validator.suspect(evidence.index, columns):
                self._diagnostician.begin(evidence.index)
            elif response.name == "complete":
                return self._diagnostician.instead_of_completing(response)
        return response

    def _forget_evidence(self, row: Row) -> None:
        """Let evidence begin anew where it was acted on, or is of rows not yet repaired."""
        acted_on = self._nobody.copy()
        for robot, outcome in row.outcomes.items():
            acted_on[robot] = outcome.decision.acted_on
        for robot, repair in self._validator.repairs.items():
            acted_on[robot] |= repair.settling > 0
        acted_on &= self.table.records["active"]
        if not acted_on.any():
            return
        failure = self._observer.forget(acted_on)
        for robot in np.flatnonzero(acted_on).tolist():
            if failure:
                row.failures[robot] = joined(row.failures.get(robot, ""), failure)

    # ------------------------------------------------------------------ report

    def _follow(self, row: Row) -> None:
        """Let what acts next take account of the row: holding actions, expected actions, contact limits."""
        if row.ends_step:
            self._commander.holding.sense(row.rows)
        if self._observer.expected is not None:
            self._commander.expect(self._observer.expected)
        if self._marked or not self._limits.steady:
            records = self.table.records
            policy = records["active"] & ~records["overridden"]
            pressed = policy & records["presses"]
            self._limits.follow(policy & (pressed | row.ends_step), pressed)

    def _report(self, row: Row) -> RowReport:
        """Return what became of the row; there is nothing to say of robots whose rows do not count."""
        robots = copied(self.table.records)
        if not self._all_active:
            silent = ~robots["active"]
            robots = robots.copy()
            robots[silent] = cleared(robots[silent])
        if not self._marked:  # nothing but healthy rows
            return RowReport(robots, row.attribution)
        repairs = {robot: repair.names for robot, repair in self._validator.repairs.items()}
        failures = dict(row.unreported)
        for robot, failure in row.failures.items():
            failures[robot] = joined(failures.get(robot, ""), failure)
        return RowReport(robots, row.attribution, row.outcomes, failures, repairs, row.lost)

    def _clear_marks(self) -> None:
        """Clear what records say of one row alone."""
        if self._marked:
            for name in ("failed", "refused", "out_of_range", "must_decide"):
                self.table.records[name] = False
            self._marked = False

    def _warn(self, robot: int, failure: str, instead: str) -> None:
        """Say what failed, and what happens instead: once an episode for each part that can fail."""
        part = failure.partition(":")[0]
        if (robot, part) not in self._warned:
            self._warned.add((robot, part))
            warnings.warn(f"{failure}; {instead}", stacklevel=5)
