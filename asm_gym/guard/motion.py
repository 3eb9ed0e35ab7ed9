"""What n robots do in a step: what their policies want, or what a reflex does in their place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.guard.observer import joined
from asm_gym.guard.reflexes import FeltMotion, Motion
from asm_gym.guard.robot_facts import NOTHING, RobotFacts
from asm_gym.policies.base import Policy
from asm_gym.policies.hold import Hold, HoldingActions
from asm_gym.validation import as_float32, short_repr

USUAL_GAIN = 0.1  # weight of the newest step in the external torque that is taken to be usual

Floats32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Command(NamedTuple):
    """What is to be done in a step."""

    actions: Floats32  # (n, A) finite, in the action space
    brakes: Mask  # (n,) the robot stays, whatever the action is
    overridden: Mask  # (n,) something else than the policy's action is done
    failures: Mapping[int, str]  # what failed when it was chosen, by robot


class Motions:
    """Chooses what the robots do.

    Args:
        reflexes: act after an alarm; None where policies do, or nothing.
        policies: the user's own, for each robot, in the place of reflexes.
        take_over: lets the reflex of a robot act from now on, for its policy's action is none.
        warn: says what failed, and what happens instead.
    """

    def __init__(
        self,
        robots: RobotFacts,
        reflexes: FeltMotion | None,
        policies: Sequence[Policy],
        take_over: Callable[[int], None],
        warn: Callable[[int, str, str], None],
    ) -> None:
        self._robots, self._reflexes, self._policies = robots, reflexes, policies
        self._take_over, self._warn, self._reacts = take_over, warn, reflexes is not None or bool(policies)
        if reflexes is None:
            self.places = HoldingActions(robots.count, robots.meaning, robots.rest)
        else:
            self.places = reflexes.holding
        self._last = np.zeros((robots.count, robots.rest.size), np.float32)  # executed last
        self.nobody: Mask = np.zeros(robots.count, bool)  # (n,) never written to
        self._memory: dict[int, Any] = {}  # the states of policies that are in an override
        self.begin(~self.nobody)

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._last[which] = self._robots.rest
        self.places.begin(which)
        if self._reflexes is not None:
            self._reflexes.begin(which)
        self._memory = {robot: state for robot, state in self._memory.items() if not which[robot]}

    def start(self, robot: int, executed: Floats32) -> None:
        """The override of a robot has begun, after it has ``executed`` (A,)."""
        self.places.start(robot, executed)
        self._memory.pop(robot, None)

    def choose(
        self, actions: Floats32, acts: Mask, idle: Mask, names: Sequence[str], seen: Callable[[int], Any]
    ) -> tuple[Command, Mask]:
        """Return what is to be done, and whose policy wanted what is no action; see ``Engine.act``.

        Args:
            acts: (n,) the reflex acts.
            names: of the reflex that each is to do.
        """
        robots, executed = self._robots, np.empty_like(actions)
        if not _clip(actions, robots.low, robots.high, acts, idle, executed, self._last):
            return Command(executed, self.nobody, self.nobody, NOTHING), self.nobody
        failures, brakes = {}, np.zeros(len(actions), bool)
        overridden: Mask = (acts | ~np.isfinite(actions).all(axis=1)) & ~idle
        refused = overridden & ~acts
        executed[idle] = np.clip(np.nan_to_num(robots.rest), robots.low, robots.high)
        for robot in np.flatnonzero(overridden).tolist():
            said = ""
            if refused[robot]:
                said = f"policy: the action must be finite, got {short_repr(actions[robot].tolist())}"
                self._warn(robot, said, "another is done instead")
                if self._reacts:
                    self._take_over(robot)
                self.start(robot, self._last[robot])
            executed[robot], brakes[robot], failed = self._reaction(robot, names[robot], seen)
            if said or failed:
                failures[robot] = joined(said, failed)
        self._last[:] = executed
        return Command(executed, brakes, overridden, failures), refused

    def feel(self, rows: Floats32, executed: Floats32, intervened: Mask, active: Mask) -> None:
        """Let the reflexes feel rows (n, D), and what was executed (n, A)."""
        self.places.sense(rows)
        r = self._reflexes
        if r is not None and r.feels:
            _feel(rows, r.torque_columns, executed, intervened, active, r.torque, r.usual_torque, r.path, r.path_steps)

    def expect(self, expected: Floats32) -> None:
        """Take up what the memory expects to be commanded next (n, A)."""
        if self._reflexes is not None:
            self._reflexes.expected[:] = expected

    def _reaction(self, robot: int, name: str, seen: Callable[[int], Any]) -> tuple[Floats32, bool, str]:
        """Return what is done, whether the robot brakes, and what failed; where nothing reacts the robot stays."""
        robots, failed = self._robots, ""
        stay = Motion(self.places.stay(robot), robots.brakes, keeps_grip=robots.rest_is_known)
        try:
            motion = self._asked(robot, name, seen) if self._reacts else stay
            action = np.array(as_float32(motion.action)).reshape(-1)
            if action.shape != robots.rest.shape or not np.isfinite(action).all():
                raise ValueError(f"the action must be {robots.rest.size} finite numbers, got {action}")
        except Exception as error:
            # Whatever a user's policy does, an alarm must not end in no action.
            failed = f"reflex: {error!r}"
            self._warn(robot, failed, "the robot holds instead")
            motion, action = stay, stay.action.copy()
        if motion.keeps_grip:
            grip = self.places.executed[robot, robots.grip]
            action[robots.grip] = np.where(np.isfinite(grip), grip, action[robots.grip])
        return np.clip(action, robots.low, robots.high), motion.brakes, failed

    def _asked(self, robot: int, name: str, seen: Callable[[int], Any]) -> Motion:
        if self._reflexes is not None:
            return self._reflexes.move(robot, name)
        policy, fresh, state = self._policies[robot], robot not in self._memory, self._memory.get(robot)
        if fresh and isinstance(policy, Hold):  # any other policy starts as in a new episode
            state = policy.begin(self.places.executed[robot].copy())
        given: dict[str, Any] = {"state": state, "episode_start": np.array([fresh]), "deterministic": True}
        action, self._memory[robot] = policy.predict(seen(robot), **given)
        return Motion(action, keeps_grip=False)


@partial(compiled, calls=(".",))
def _clip(actions: Any, low: Any, high: Any, acts: Any, idle: Any, executed: Any, last: Any) -> bool:
    """Write the actions (n, A) within their bounds, and keep them; return whether more is to be done about some."""
    more = False
    for n in range(len(actions)):
        more = more or acts[n] or idle[n]
        for i in range(len(low)):
            executed[n, i] = min(max(actions[n, i], low[i]), high[i])
            more = more or not np.isfinite(actions[n, i])
    for n in range(0 if more else len(actions)):
        for i in range(len(low)):
            last[n, i] = executed[n, i]
    return more


@partial(compiled, calls=(".",))
def _feel(
    rows: Any, columns: Any, executed: Any, intervened: Any, active: Any, torque: Any, usual: Any, path: Any, steps: Any
) -> None:
    """Take rows (n, D) into external torques (n, J), and what policies executed (n, A) into their paths."""
    for n in range(len(rows)):
        if not active[n]:
            continue
        for j in range(len(columns)):
            if not intervened[n]:
                # What is carried weighs on the joints as well; only what has come since is yielded to.
                usual[n, j] += USUAL_GAIN * (torque[n, j] - usual[n, j])
            felt = float(rows[n, columns[j]])
            torque[n, j] = felt if np.isfinite(felt) else 0.0
        if not intervened[n]:
            newest = path.shape[1] - 1
            for i in range(executed.shape[1]):
                for k in range(newest):
                    path[n, k, i] = path[n, k + 1, i]
                path[n, newest, i] = executed[n, i]
            steps[n] = min(steps[n] + 1, path.shape[1])
