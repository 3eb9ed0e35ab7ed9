"""What n robots do in a step: what their policies want, or what a reflex does in their place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.commands import command_limits
from asm_gym.guard.arbiter import Arbiter
from asm_gym.guard.observer import joined
from asm_gym.guard.reflexes import FeltMotion, Motion, leaving
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import REFLEX, Floats32, Mask, RobotTable
from asm_gym.policies.hold import Hold, HoldingActions
from asm_gym.policies.policy import Policy
from asm_gym.validation import as_float32, short_repr

Observe = Callable[[int], Any]
"""Returns the observation of a robot."""

# Rows of the limits (5, A) of actions.
LOW, HIGH, LEAST_EXECUTED, MOST_EXECUTED, GREATEST_STEP = range(5)


@dataclass(frozen=True, slots=True)
class Command:
    """What is to be done in a step."""

    actions: Floats32  # (n, A) finite, in the action space
    brakes: Mask  # (n,) the robot stays, whatever the action is
    overridden: Mask  # (n,) something else than the policy's action is done
    # what failed when it was chosen, by robot
    failures: Mapping[int, str] = field(default_factory=dict)


class Commander:
    """Chooses what the robots do.

    Args:
        facts: what is known of the robots.
        table: their records.
        motion: of reflexes that act after an alarm; None where policies do, or nothing.
        policies: the user's own, for each robot, in the place of reflexes.
        arbiter: lets the reflex of a robot take over whose policy's action cannot be executed.
        warn: says what failed, and what happens instead.
        commands: (3, A) the least, the most and the greatest change of healthy commands; None where unknown.

    Attributes:
        holding: the actions for which the robots stay.
    """

    def __init__(
        self,
        facts: RobotFacts,
        table: RobotTable,
        motion: FeltMotion | None,
        policies: Sequence[Policy],
        arbiter: Arbiter,
        warn: Callable[[int, str, str], None],
        commands: NDArray[np.floating[Any]] | None = None,
    ) -> None:
        self._facts = facts
        self._records = table.records
        self._motion = motion
        self._policies = policies
        self._arbiter = arbiter
        self._warn = warn
        self._reacts = motion is not None or bool(policies)
        if motion is None:
            self.holding = HoldingActions(facts.count, facts.meaning, facts.rest)
        else:
            self.holding = motion.holding
        self._limits = _limits(facts, commands)  # (5, A)
        shape = facts.count, facts.rest.size
        self._proposed = np.full(shape, np.nan, np.float32)  # in the last step
        self._executed = np.zeros(shape, np.float32)  # in the last step
        self._nobody = np.zeros(facts.count, bool)  # never written to
        self._policy_states: dict[int, Any] = {}  # of policies that act in an override
        self.begin(~self._nobody)

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self._executed[which] = self._facts.rest
        self._proposed[which] = np.nan
        self.holding.begin(which)
        if self._motion is not None:
            self._motion.begin(which)
        self._policy_states = {
            robot: state for robot, state in self._policy_states.items() if not which[robot]
        }

    def start_override(self, robot: int, executed: Floats32) -> None:
        """Begin the override of a robot that has ``executed`` (A,)."""
        self.holding.start(robot, executed)
        self._policy_states.pop(robot, None)

    def expect(self, expected: Floats32) -> None:
        """Take up what the memory expects to be commanded next (n, A)."""
        if self._motion is not None:
            self._motion.expected[:] = expected

    def choose(
        self, proposed: Floats32, idle: Mask, reflexes: Sequence[str], observe: Observe
    ) -> Command:
        """Return what is to be done.

        Args:
            proposed: (n, A) by the policies.
            idle: (n,) nothing is done, for an episode begins.
            reflexes: name of the reflex that each robot does in an override.
            observe: returns the observation of a robot.
        """
        executed = np.empty_like(proposed)
        previous = self._proposed
        self._proposed = proposed.copy()
        needs_choice = clip_actions(self._records, proposed, previous, self._limits, idle, executed)
        if needs_choice:
            return self._choose_each(proposed, executed, idle, reflexes, observe)
        self._executed = executed.copy()  # the caller may write to the array of the command
        return Command(executed, brakes=self._nobody, overridden=self._nobody)

    def _choose_each(
        self,
        proposed: Floats32,
        executed: Floats32,
        idle: Mask,
        reflexes: Sequence[str],
        observe: Observe,
    ) -> Command:
        """Return what is to be done where a robot is overridden or idle; ``executed`` is written to."""
        records = self._records
        facts = self._facts
        refused = records["refused"] & ~idle
        records["refused"] = refused
        records["out_of_range"] &= ~idle
        brakes = np.zeros(len(proposed), bool)
        reflex_acts = (records["state"] == REFLEX) & ~idle
        overridden = reflex_acts | refused
        executed[idle] = np.clip(np.nan_to_num(facts.rest), facts.low, facts.high)
        failures: dict[int, str] = {}
        for robot in np.flatnonzero(overridden).tolist():
            refusal = ""
            if refused[robot]:
                refusal = self._refuse(robot, proposed[robot])
            leaving_action = None
            if not refused[robot]:
                leaving_action = proposed[robot]
            motion, reflex_failure = self._react(robot, reflexes[robot], observe, leaving_action)
            executed[robot] = motion.action
            brakes[robot] = motion.brakes
            failure = joined(refusal, reflex_failure)
            if failure:
                failures[robot] = failure
        self._executed = executed.copy()
        return Command(executed, brakes, overridden, failures)

    def _refuse(self, robot: int, proposed: Floats32) -> str:
        """Let the reflex take over from a policy whose action cannot be executed; return what failed, if anything."""
        failure = ""
        if not np.isfinite(proposed).all():
            failure = f"policy: the action must be finite, got {short_repr(proposed.tolist())}"
            self._warn(robot, failure, "another is done instead")
        if self._reacts and self._records["state"][robot] != REFLEX:
            self._arbiter.take_over(robot)
        self.start_override(robot, self._executed[robot])
        return failure

    def _react(
        self, robot: int, reflex: str, observe: Observe, proposed: Floats32 | None
    ) -> tuple[Motion, str]:
        """Return what a robot does in an override, within its bounds, and what failed: then the robot stays.

        An action (A,) that the policy proposes may lead away from a contact; None for none.
        """
        facts = self._facts
        stay = Motion(self.holding.stay(robot), brakes=facts.brakes, keeps_grip=facts.rest_is_known)
        motion = stay
        failure = ""
        try:
            if self._reacts:
                motion = self._reflex_motion(robot, reflex, observe, proposed)
            action = np.array(as_float32(motion.action)).reshape(-1)
            if action.shape != facts.rest.shape or not np.isfinite(action).all():
                raise ValueError(
                    f"the action must be {facts.rest.size} finite numbers, got {action}"
                )
        except Exception as error:
            # Whatever a user's policy does, an alarm must not end in no action.
            failure = f"reflex: {error!r}"
            self._warn(robot, failure, "the robot holds instead")
            motion = stay
            action = stay.action.copy()
        if motion.keeps_grip:
            grip = self.holding.executed[robot, facts.grip]
            is_known = np.isfinite(grip)
            action[facts.grip[is_known]] = grip[is_known]
        within = np.clip(action, facts.low, facts.high)
        return motion._replace(action=within), failure

    def _reflex_motion(
        self, robot: int, reflex: str, observe: Observe, proposed: Floats32 | None
    ) -> Motion:
        """Return what the reflex of a name, or the user's own policy, does."""
        if self._motion is not None:
            away = None
            if proposed is not None:
                away = leaving(self._motion, robot, proposed)
            if away is not None:
                return away
            return self._motion.move(robot, reflex)
        policy = self._policies[robot]
        is_first = robot not in self._policy_states  # step of the override
        state = self._policy_states.get(robot)
        if is_first and isinstance(policy, Hold):  # any other policy starts as in a new episode
            state = policy.begin(self.holding.executed[robot].copy())
        action, state = policy.predict(
            observe(robot), state=state, episode_start=np.array([is_first]), deterministic=True
        )
        self._policy_states[robot] = state
        return Motion(action, keeps_grip=False)


def _limits(facts: RobotFacts, commands: NDArray[np.floating[Any]] | None) -> Floats32:
    """Return (5, A): least and greatest action, least and greatest that is executed, greatest step.

    Numbers with bounds may be anything within them; others stay near healthy ``commands`` (3, A).
    """
    any_step = np.full_like(facts.low, np.inf)
    limits = np.stack([facts.low, facts.high, facts.low, facts.high, any_step])
    if commands is None or commands.shape[1] != facts.rest.size:
        return limits
    is_bounded = np.isfinite(facts.low) & np.isfinite(facts.high)
    is_unbounded = ~is_bounded
    limits[LEAST_EXECUTED:, is_unbounded] = command_limits(commands)[:, is_unbounded]
    return limits.astype(np.float32)


@partial(compiled, calls=(".",))
def clip_actions(
    robots: Any, proposed: Any, previous: Any, limits: Any, idle: Any, executed: Any
) -> bool:
    """Write the proposed actions (n, A) within their bounds, and mark those that cannot be executed.

    Args:
        robots: (n,) records.
        proposed: (n, A).
        previous: (n, A) proposed a step before; NaN at the beginning.
        limits: (5, A) as ``_limits`` returns them.
        idle: (n,) nothing is done.
        executed: (n, A) written to.

    Returns:
        Whether any robot is overridden, refused or idle.
    """
    needs_choice = False
    for n in range(len(robots)):
        robot = robots[n]
        can_execute = clip_action(robot, proposed[n], previous[n], limits, executed[n])
        needs_choice = needs_choice or not can_execute or robot.state == REFLEX or idle[n]
    return needs_choice


@inner
def clip_action(robot: Any, proposed: Any, previous: Any, limits: Any, executed: Any) -> bool:
    """Write one action (A,) within its bounds, and mark it; return whether it can be executed."""
    is_finite = True
    is_out_of_range = False  # of healthy commands
    for i in range(len(proposed)):
        action = min(max(proposed[i], limits[LOW, i]), limits[HIGH, i])
        step = np.abs(action - previous[i])
        is_finite = is_finite and np.isfinite(proposed[i])
        is_out_of_range = is_out_of_range or action < limits[LEAST_EXECUTED, i]
        is_out_of_range = is_out_of_range or action > limits[MOST_EXECUTED, i]
        is_out_of_range = is_out_of_range or step > limits[GREATEST_STEP, i]
        executed[i] = action
    policy_acts = robot.state != REFLEX
    can_execute = is_finite and not is_out_of_range
    robot.out_of_range = policy_acts and is_finite and is_out_of_range
    robot.refused = policy_acts and not can_execute
    return can_execute
