"""What a robot does after an alarm: stay, go back, give way, or go on as expected.

    hold      the action for which the robot stays, or a brake beneath its controller
    retract   -u_t, -u_{t-1}, …   of the actions u that the policy executed last
    comply    dq = c dt sign(τ) max(|τ| - τ_tolerated, 0),   τ beyond the usual torque
    recall    the action that the memory expects

Whatever the reflex, a policy may leave a contact: of its action a the part along the direction c of ``comply`` is done,

    a' = max(0, a · c) c

A reflex is a function of ``FeltMotion`` and of the robot's index. To add one, write the function
and name it in ``REFLEXES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.guard.robot_facts import NO_COLUMNS, RobotFacts, columns_ending
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.policies.hold import HoldingActions
from asm_gym.spec import StreamSpec

GRADED = "graded"  # no reflex: severity and cause choose one
PATH = 10  # how many actions a retreat undoes
COMPLIANCE = 0.05  # how far a joint gives way in a second [rad / (N m s)]
TOLERATED = 4.0  # external torque that no joint gives way to under "graded" [N m]
TOLERATED_ALONE = 2.0  # and under "comply" [N m]
USUAL_GAIN = 0.1  # weight of the newest step in the usual external torque


class Motion(NamedTuple):
    """What a reflex does next."""

    action: Floats32  # (A,) not to be written to
    brakes: bool = False  # the robot stays, whatever the action is
    keeps_grip: bool = True  # the grippers are commanded as before the override


class MotionArrays(NamedTuple):
    """What reflexes need of rows and actions; compiled code writes it."""

    torque_columns: NDArray[np.intp]
    """(J,) of the external torques in the stream."""
    torque: NDArray[np.float64]
    """(n, J) external torque now [N m]."""
    usual_torque: NDArray[np.float64]
    """(n, J) external torque while the policy acts [N m]."""
    path: Floats32
    """(n, PATH, A) the policy's last actions, the newest last."""
    path_steps: NDArray[np.int64]
    """(n,) how many of them there are."""

    @classmethod
    def empty(
        cls, count: int, torque_columns: NDArray[np.intp] = NO_COLUMNS, path: int = 0, size: int = 0
    ) -> Self:
        """Return the arrays of robots that have felt and done nothing.

        Args:
            count: n.
            torque_columns: (J,) of the external torques; none where no reflex depends on them.
            path: how many actions are kept; 0 where no reflex depends on them.
            size: A, of an action.
        """
        return cls(
            torque_columns=torque_columns,
            torque=np.zeros((count, len(torque_columns))),
            usual_torque=np.zeros((count, len(torque_columns))),
            path=np.zeros((count, path, size), np.float32),
            path_steps=np.zeros(count, np.int64),
        )


@dataclass(frozen=True, eq=False)
class FeltMotion:
    """What n robots feel, did, and are expected to do; its arrays are written to."""

    robots: RobotFacts
    possible: frozenset[str]
    """Names of reflexes that the guard may ask for and the robots can do."""
    tolerated: float
    """External torque that no joint gives way to [N m]."""
    holding: HoldingActions
    arrays: MotionArrays
    expected: Floats32
    """(n, A) the action that the memory expects next; NaN where unknown."""

    @classmethod
    def of(cls, robots: RobotFacts, spec: StreamSpec, on_alarm: str) -> Self:
        """Return a record of robots that have felt nothing yet.

        Args:
            robots: what is known of them.
            spec: of their stream.
            on_alarm: the name of a reflex, or ``"graded"``.

        Raises:
            ValueError: the robots cannot do what ``on_alarm`` names.
        """
        torque_columns = columns_ending(spec.channels, "external_torque")
        refused = dict(robots.refused)
        if not torque_columns.size:
            needs = "comply needs the channel external_torque"
            refused.setdefault("comply", f"{needs}: make the environment with stream group torque")
        for name in (on_alarm, "hold"):
            if name in refused:
                raise ValueError(refused[name])

        possible = {on_alarm}
        tolerated = TOLERATED_ALONE
        if on_alarm == GRADED:
            possible = {"hold", "retract", "comply"}.difference(refused)
            tolerated = TOLERATED

        count = robots.count
        size = robots.rest.size
        arrays = MotionArrays.empty(count)
        if not possible <= {"hold", "recall"}:  # which depend on nothing that was felt or done
            arrays = MotionArrays.empty(count, torque_columns, PATH, size)
        return cls(
            robots=robots,
            possible=frozenset(possible),
            tolerated=tolerated,
            holding=HoldingActions(count, robots.meaning, robots.rest),
            arrays=arrays,
            expected=np.zeros((count, size), np.float32),
        )

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.arrays.torque[which] = 0.0
        self.arrays.usual_torque[which] = 0.0
        self.arrays.path_steps[which] = 0
        self.expected[which] = np.nan

    def move(self, robot: int, name: str) -> Motion:
        """Return what a robot does; it stays where it cannot do the reflex of that name."""
        if name not in self.possible:
            name = "hold"
        return REFLEXES[name](self, robot)


def hold(motion: FeltMotion, robot: int) -> Motion:
    """Stay, by a brake beneath the controller where there is one."""
    return Motion(action=motion.holding.stay(robot), brakes=motion.robots.brakes)


def retract(motion: FeltMotion, robot: int) -> Motion:
    """Undo the last actions, the newest first, then stay.

    Under a controller of changes, the negative of an action undoes it.
    """
    if not motion.arrays.path_steps[robot]:
        return hold(motion, robot)

    path = motion.arrays.path[robot]
    undone = -path[-1]
    path[1:] = path[:-1]
    motion.arrays.path_steps[robot] -= 1
    return Motion(undone)


def comply(motion: FeltMotion, robot: int) -> Motion:
    """Give way along the external torque beyond the usual, as a damper would."""
    robots = motion.robots
    assert robots.turning_action is not None
    beyond = pressing_torque(motion, robot)
    return Motion(robots.turning_action(robot, COMPLIANCE * robots.dt * beyond))


def pressing_torque(motion: FeltMotion, robot: int) -> NDArray[np.float64]:
    """Return (J,) the external torque of a robot's joints beyond what is usual and tolerated [N m]."""
    torque = motion.arrays.torque[robot] - motion.arrays.usual_torque[robot]
    return np.asarray(np.sign(torque) * np.maximum(np.abs(torque) - motion.tolerated, 0.0))


def leaving(motion: FeltMotion, robot: int, proposed: Floats32) -> Motion | None:
    """Return the part of a policy's action (A,) that leads away from what presses; None without such a part."""
    robots = motion.robots
    if robots.turning_action is None or not motion.arrays.torque_columns.size:
        return None
    beyond = pressing_torque(motion, robot)
    if not beyond.any():
        return None
    way = np.array(robots.turning_action(robot, COMPLIANCE * robots.dt * beyond), np.float64)
    way[robots.grip] = 0.0
    length = np.linalg.norm(way)
    along = float(proposed @ way)
    if not along > 0.0:
        return None
    return Motion((along / length**2 * way).astype(np.float32))


def recall(motion: FeltMotion, robot: int) -> Motion:
    """Do what the memory expects, grip included; stay where it expects nothing yet."""
    expected = motion.expected[robot]
    if not np.isfinite(expected).all():
        return hold(motion, robot)
    return Motion(expected, keeps_grip=False)


REFLEXES: dict[str, Callable[[FeltMotion, int], Motion]] = {
    "hold": hold,
    "retract": retract,
    "comply": comply,
    "recall": recall,
}
"""Reflexes by name."""


@compiled
def record_motion(robots: Any, rows: Any, executed: Any, motion: Any) -> None:
    """Take rows into external torques, and executed actions into the policies' paths.

    The rows (n, D) end a step; the actions (n, A) are what policies executed.

    Args:
        robots: (n,) records of ``ROBOT``.
        motion: ``MotionArrays``, written to.
    """
    for n in range(len(robots)):
        robot = robots[n]
        if not (robot.active and robot.ends_step):
            continue
        for j in range(len(motion.torque_columns)):
            if not robot.overridden:
                # What is carried weighs on the joints as well; only what came since is yielded to.
                motion.usual_torque[n, j] += USUAL_GAIN * (
                    motion.torque[n, j] - motion.usual_torque[n, j]
                )
            torque = float(rows[n, motion.torque_columns[j]])
            motion.torque[n, j] = torque if np.isfinite(torque) else 0.0
        if not robot.overridden:
            extend_path(motion, n, executed[n])


@inner
def extend_path(motion: Any, n: int, executed: Any) -> None:
    """Append an action (A,) to the path of a robot."""
    path = motion.path[n]
    newest = len(path) - 1
    for i in range(path.shape[1]):
        for k in range(newest):
            path[k, i] = path[k + 1, i]
        path[newest, i] = executed[i]
    motion.path_steps[n] = min(motion.path_steps[n] + 1, len(path))
