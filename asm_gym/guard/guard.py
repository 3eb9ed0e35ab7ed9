"""The guard of n robots: from the actions that are proposed to them to what they do, and from their rows to who acts.

    act      proposed actions (n, A) ► the policy's, or a reflex's ► Command

    judge    SensedRows ► validate ► observe ► measure contact ► alarm rule ► count        one compiled call
                 └► only for robots with something to decide: evidence ► prescribe ► arbitrate
             ► RowReport

The state of the robots is one table, ``robot_table.ROBOT``. Each stage is entered once a row.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.acknowledgement import Acknowledgements
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.alarm_terms import AlarmTerms
from asm_gym.guard.arbiter import Arbiter
from asm_gym.guard.chunk_preview import Preview, one_row_each, preview_chunk
from asm_gym.guard.commander import Command, Commander, Observe
from asm_gym.guard.contact_state import no_load
from asm_gym.guard.diagnostician import Diagnostician
from asm_gym.guard.episode_limits import EpisodeLimits, limits_of
from asm_gym.guard.fitted_monitor import STALE, FittedMonitor, diagnosis_of
from asm_gym.guard.judged_rows import JudgedRow, RowJudge
from asm_gym.guard.observer import Observer, invalid_surprises, merged_failures
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.reflexes import GRADED, REFLEXES, FeltMotion, MotionArrays
from asm_gym.guard.responses import SLOW, responses_from
from asm_gym.guard.robot_facts import NOTHING, RobotFacts
from asm_gym.guard.robot_table import (
    REFLEX,
    Floats32,
    Mask,
    RobotTable,
    cleared,
    copied,
    damaged,
)
from asm_gym.guard.row_decisions import RowDecider
from asm_gym.guard.row_validation import RowValidator
from asm_gym.guard.step_info import RowReport
from asm_gym.guard.wear_watch import WearWatch
from asm_gym.monitors import Monitor
from asm_gym.monitors.expectation import LevelShift
from asm_gym.policies.policy import Policy

LOG = logging.getLogger("asm_gym.safety")

ROW_MARKS = "failed", "refused", "out_of_range", "must_decide"  # fields that hold for one row alone


class Guard:
    """Guards n robots that one monitor watches.

    Args:
        facts: what is known of the robots.
        monitor: fitted and calibrated for their stream.
        options: what the guard is told.
        policies: the user's own, one for each robot, where ``options`` name no reflex.
        rows_per_step: rows of the stream in a control step.
        explains: find the cause of each alarm, which takes longer than to judge its row.

    Attributes:
        table: the records of the robots.
        terms: alarm terms, and how often each held.
        fitted: the monitor as it was taken up.
        running: the threshold that follows a policy; None where it does not.
        ends_on_alarm: an alarm ends the episode.

    Raises:
        ValueError: a reflex or response that these robots cannot do, or contact limits of another arm;
            ``"recall"`` with a monitor that expects no action.
    """

    def __init__(
        self,
        facts: RobotFacts,
        monitor: Monitor,
        options: GuardOptions,
        policies: Sequence[Policy] = (),
        rows_per_step: int = 1,
        explains: bool = True,
    ) -> None:
        spec = monitor.spec
        diagnosis = None
        if explains:
            diagnosis = diagnosis_of(monitor)
        reaction = options.reaction(diagnosis is not None)
        self._on_alarm = ""  # a policy of the user's own acts
        if isinstance(reaction, str):
            self._on_alarm = reaction
        self._graded = self._on_alarm == GRADED
        self._facts = facts
        self._spec = spec
        self.ends_on_alarm = self._on_alarm == "terminate"
        self.fitted = FittedMonitor.of(monitor, spec)
        self.terms = AlarmTerms()
        self.table = RobotTable(facts.count, spec, self.fitted.threshold)

        self._nobody = np.zeros(facts.count, bool)  # never written to
        self._everyone = ~self._nobody
        motion = None
        rule = None
        if policies or self._on_alarm in (*REFLEXES, GRADED):
            rule = options.rule(self._graded, facts.dt, rows_per_step)
            if not policies:
                motion = FeltMotion.of(facts, spec, self._on_alarm)
        completion = None
        if diagnosis is not None and self._graded:
            completion = diagnosis.completion

        self._arbiter = Arbiter(self.table, rule, options.adaptive_threshold)
        responses = responses_from(options.responses, can_slow=facts.limits_contact)
        self._diagnostician = Diagnostician(spec, diagnosis, responses, self._graded)
        self._validator = RowValidator(facts, self.table, completion, self._diagnostician.rows)
        self._decider = self._new_decider()
        self._observer = Observer(monitor, facts.count, recalls=self._on_alarm == "recall")
        self._row_judge = self._new_row_judge(motion)
        self._commander = self._new_commander(motion, policies, monitor)
        limits = limits_of(options.contact_limits, monitor, facts)
        acts = self._on_alarm != "monitor" and facts.rest.size > 0
        self._limits = EpisodeLimits(facts, limits, acts)

        self._wear = WearWatch(monitor, facts.count)
        self.running = self._arbiter.running
        self._acknowledgements = Acknowledgements(monitor, spec, facts.count)
        self._no_load = no_load(facts.count, facts.felt_size)
        self._warned: set[tuple[int, str]] = set()  # robots, and the part that failed
        self._all_active = True  # the field ``active`` of every record is True
        # What failed when the newest command was chosen, by robot.
        self._command_failures: Mapping[int, str] = NOTHING

    def _new_decider(self) -> RowDecider:
        """Return what decides about rows."""
        return RowDecider(
            table=self.table,
            terms=self.terms,
            validator=self._validator,
            diagnostician=self._diagnostician,
            arbiter=self._arbiter,
            graded=self._graded,
        )

    def _new_row_judge(self, motion: FeltMotion | None) -> RowJudge:
        """Return what judges rows in one compiled call."""
        arrays = MotionArrays.empty(self._facts.count)
        if motion is not None:
            arrays = motion.arrays
        return RowJudge(
            facts=self._facts,
            table=self.table,
            validator=self._validator,
            observer=self._observer,
            terms=self.terms,
            motion=arrays,
            most_impulse=self._arbiter.most_impulse,
        )

    def _new_commander(
        self, motion: FeltMotion | None, policies: Sequence[Policy], monitor: Monitor
    ) -> Commander:
        """Return what chooses the action of each robot."""
        return Commander(
            facts=self._facts,
            table=self.table,
            motion=motion,
            policies=policies,
            arbiter=self._arbiter,
            warn=self._warn,
            commands=getattr(monitor, "commands_", None),
        )

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
        return {
            robot: (self._validator.last(robot)[-1], repair.missing)
            for robot, repair in self._validator.repairs.items()
            if repair.missing.any()
        }

    def confirm(self, which: Mask) -> None:
        """Confirm that the alarms of the robots of ``which`` (n,) in these episodes were real."""
        self.table.records["confirmed"] |= which

    def acknowledge(self, robot: int = 0, column: int | None = None) -> LevelShift:
        """Take the level at which a channel in alarm is steady for its own from now on, and return the shift.

        It ends with this guard; ``keep`` saves it. No other channel is silenced.

        Args:
            robot: its number.
            column: of the channel; by default the one that the open incident points to.

        Raises:
            ValueError: no incident is open, or the channel is not steady at another level.
        """
        shift = self._acknowledgements.acknowledge(robot, self._validator.last(robot), column)
        only = self._nobody.copy()
        only[robot] = True
        self._observer.forget(only)
        LOG.info("acknowledged: %s", shift)
        return shift

    def recentred(self, row: NDArray[np.float64], robot: int = 0) -> NDArray[np.float64]:
        """Return a row (D,) as it is judged: without the level shifts that were acknowledged."""
        return self._acknowledgements.recentred(robot, row)

    def keep(self, path: str | Path, robot: int = 0) -> None:
        """Write the memory with the level shifts of a robot that were acknowledged, in a note."""
        self._acknowledgements.save(path, robot)

    def acknowledge_wear(self) -> None:
        """Forget all wear: the next blocks of operation say what is healthy."""
        self._wear.acknowledge()

    def begin(self, which: Mask | None = None) -> RowReport:
        """Begin new episodes of the robots of ``which`` (n,), all by default; return the empty report."""
        if which is None:
            which = self._everyone
        self._arbiter.follow_thresholds(which)
        for part in (
            self.table,
            self._arbiter,
            self._commander,
            self._observer,
            self._validator,
            self._diagnostician,
            self._limits,
            self._acknowledgements,
            self._wear,
        ):
            part.begin(which)
        self._warned = {(robot, part) for robot, part in self._warned if not which[robot]}
        return self.empty_report()

    def empty_report(self) -> RowReport:
        """Return the report before the first row of an episode: no alarm, nothing failed."""
        attribution = np.zeros((self._facts.count, self._spec.size))
        return RowReport(cleared(self.table.records), attribution, wear=self._wear.worn)

    def sense(self, rows: Floats32) -> None:
        """Tell where the robots are, by rows (n, D) that are not judged."""
        self._commander.holding.sense(rows)

    def amend(self, rows: Floats32) -> None:
        """Tell the monitor that the last rows (n, D) were these: something else was commanded than it seemed."""
        self._observer.amend(rows)

    def preview(
        self,
        robot: int,
        chunk: Floats32,
        row: Floats32,
        last: Floats32,
        as_streamed: Callable[[Floats32], Floats32] = one_row_each,
    ) -> Preview:
        """Return what becomes of a robot's chunk of actions.

        Args:
            robot: its number.
            chunk: (k, ...) actions as the robot's policy gives them.
            row: (D,) sensed before it.
            last: the action that was done last.
            as_streamed: returns actions (k, A) as the stream would tell them.
        """
        facts = self._facts
        limits = self.limits[robot]
        is_finite = np.isfinite(chunk)
        shape = chunk.shape[1:]
        clipped = np.clip(chunk, facts.low.reshape(shape), facts.high.reshape(shape))
        streamed = np.array(as_streamed(np.where(is_finite, clipped, np.float32(np.nan))))
        streamed[~one_row_each(is_finite).all(axis=1)] = np.nan  # whatever wrappers make of it
        last = as_streamed(last.reshape(1, *shape))[0]
        slows = limits is not None and np.isfinite(limits.hand_speed) and facts.limits_contact
        if not slows:
            limits = None
        preview = preview_chunk(streamed, row, last, self.fitted.monitor, facts.dt, limits)
        if self._on_alarm == "monitor":
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
            reflexes = [self._on_alarm] * self._facts.count
        if idle is None:
            idle = self._nobody
        command = self._commander.choose(proposed, idle, reflexes, observe)
        self._command_failures = command.failures
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
        row = self._begin_row(sensed, executed, ends_step, active)
        to_decide = self._row_judge.judge(row)
        for robot, failure in row.failures.items():
            self._warn(robot, failure, "which counts as an alarm")
        if to_decide:
            self._acknowledgements.note_alarms(self.table.records["over"], row.attribution)
            self._decide(row)
        self._wear.follow(row.rows, self.table.records)
        self._prepare_next_step(row)
        report = self._report(row)
        if row.eventful:
            for name in ROW_MARKS:
                self.table.records[name] = False
        return report

    def _begin_row(
        self, sensed: SensedRows, executed: Floats32, ends_step: bool, active: Mask | None
    ) -> JudgedRow:
        """Write into the table what is known before the rows are judged."""
        records = self.table.records
        rows = np.array(sensed.rows, np.float32)  # a copy, in which stale senses are left out
        self._acknowledgements.recentre(rows)
        self.table.rows = rows
        self.table.infos = sensed.infos
        self._mark_active(active)
        records["ends_step"] = ends_step
        load = sensed.load
        if load is None:
            load = self._no_load
        row = JudgedRow(
            robots=records,
            rows=rows,
            load=load,
            executed=executed,
            ends_step=ends_step,
            attribution=np.empty(rows.shape),
        )
        if sensed.failures or self._command_failures or self.fitted.stale:
            self._take_up_failures(row, sensed.failures)
        incidents = self._diagnostician.incidents
        if incidents:
            records["must_decide"][list(incidents)] = True
            row.eventful = True
        return row

    def _mark_active(self, active: Mask | None) -> None:
        """Write to the records whose rows count (n,); None for all, which is seldom a change."""
        if active is None:
            if self._all_active:
                return
            active = self._everyone
        self.table.records["active"] = active
        self._all_active = bool(active.all())

    def _take_up_failures(self, row: JudgedRow, sensing_failures: Mapping[int, str]) -> None:
        """Take up what failed before the row is judged, and mark the robots for which that is an alarm.

        An action of the policy that is not finite is an alarm, as are a failure of sensing and a
        monitor that was fitted meanwhile. A reflex that failed is none: the robot stays instead.
        """
        not_finite = row.robots["refused"] & ~row.robots["out_of_range"]
        policy_failures: dict[int, str] = {}
        reflex_failures: dict[int, str] = {}
        for robot, failure in self._command_failures.items():
            if not_finite[robot]:
                policy_failures[robot] = failure
            else:
                reflex_failures[robot] = failure
        self._command_failures = NOTHING
        row.harmless_failures = reflex_failures
        row.eventful = True
        row.fail(merged_failures(policy_failures, sensing_failures))
        if self.fitted.stale:
            row.fail(dict.fromkeys(range(self._facts.count), STALE))

    # ------------------------------------------------------------------ decide

    def _decide(self, row: JudgedRow) -> None:
        """Decide about the robots that are marked."""
        records = self.table.records
        row.eventful = True
        for failures in (invalid_surprises(self._row_judge.surprises), damaged(records)):
            row.fail(failures)
            for robot, failure in failures.items():
                self._warn(robot, failure, "which counts as an alarm")
        row.terms = self.terms.masks(self.table)
        for robot in np.flatnonzero(records["must_decide"]).tolist():
            outcome = self._decider.decide(robot, row)
            row.outcomes[robot] = outcome
            if outcome.decision.takes_over:
                self._commander.start_override(robot, row.executed[robot])
        self._forget_evidence(row)
        self._validator.drop_repairs()

    def _forget_evidence(self, row: JudgedRow) -> None:
        """Clear a robot's evidence where it was acted on, or comes from rows that were not yet repaired."""
        cleared_robots = self._nobody.copy()
        for robot, outcome in row.outcomes.items():
            cleared_robots[robot] = outcome.decision.acted_on
        for robot, repair in self._validator.repairs.items():
            cleared_robots[robot] |= repair.settling > 0  # rows before the repair still count
        cleared_robots &= self.table.records["active"]
        if not cleared_robots.any():
            return
        failure = self._observer.forget(cleared_robots)
        if failure:
            failures = dict.fromkeys(np.flatnonzero(cleared_robots).tolist(), failure)
            row.failures = merged_failures(row.failures, failures)

    # ------------------------------------------------------------------ report

    def _prepare_next_step(self, row: JudgedRow) -> None:
        """Let what acts next take account of the row: holding actions, expected actions, contact limits."""
        if row.ends_step:
            self._commander.holding.sense(row.rows)
        if self._observer.expected is not None:
            self._commander.expect(self._observer.expected)
        if row.eventful or not self._limits.steady:
            records = self.table.records
            policy_acted = records["active"] & ~records["overridden"]
            pressed = policy_acted & records["presses"]
            # An arm that presses counts at once, any other at the end of its step.
            counts = pressed
            if row.ends_step:
                counts = policy_acted
            slowed = self._nobody.copy()
            for robot, outcome in row.outcomes.items():
                slowed[robot] = outcome.decision.transition == SLOW
            self._limits.follow(counts | slowed, pressed | slowed)

    def _report(self, row: JudgedRow) -> RowReport:
        """Return what became of the row; there is nothing to say of robots whose rows do not count."""
        robots = copied(self.table.records)
        if not self._all_active:
            inactive = ~robots["active"]
            robots = robots.copy()
            robots[inactive] = cleared(robots[inactive])
        if not row.eventful:
            return RowReport(robots, row.attribution, wear=self._wear.worn)
        return RowReport(
            robots=robots,
            attribution=row.attribution,
            outcomes=row.outcomes,
            failures=merged_failures(row.harmless_failures, row.failures),
            repairs={robot: repair.names for robot, repair in self._validator.repairs.items()},
            lost=row.lost,
            wear=self._wear.worn,
        )

    def _warn(self, robot: int, failure: str, instead: str) -> None:
        """Say what failed, and what happens instead: once an episode for each part that can fail."""
        part = failure.partition(":")[0]
        if (robot, part) not in self._warned:
            self._warned.add((robot, part))
            warnings.warn(f"{failure}; {instead}", stacklevel=5)
