"""What a robot does after an alarm: it stays, goes back, gives way, or goes on as the memory expects.

A reflex is a function of ``Reflexes``, which knows what was felt and done, and of which robot it is. To add one, write
the function and name it in ``REFLEXES``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeaning
from asm_gym.guard.robots import Robots, named
from asm_gym.spec import StreamSpec

Mask = NDArray[np.bool_]

GRADED = "graded"  # not a reflex, but the one that severity and cause ask for
PATH = 10  # how many actions a retreat undoes
COMPLIANCE = 0.05  # how far a joint gives way in a second [rad / (N m s)]
TOLERATED, TOLERATED_ALONE = 4.0, 2.0  # external torque that none gives way to [N m]: under "graded"; "comply" alone

NO_TORQUE = "comply needs the channel external_torque: make the environment with stream group torque"


class Motion(NamedTuple):
    """What a reflex does next."""

    action: NDArray[np.float32]  # (A,)
    brakes: bool = False  # the robot stays, whatever the action is
    keeps_grip: bool = True  # the grippers are told what they were told before the override


class Places:
    """The actions (n, A) for which n robots stay: each where it was when its override began.

    Args:
        meaning: of their actions; None where ``rest`` is known to make them stay.
        rest: (A,) what is left to do where nothing else is known.
    """

    def __init__(self, count: int, meaning: ActionMeaning | None, rest: NDArray[np.float32]) -> None:
        self._meaning, self._rest = meaning, rest
        self.executed = np.tile(rest, (count, 1))  # (n, A) last before the override
        self._actions = np.full((count, rest.size), np.nan, np.float32)
        self._rows: NDArray[np.float32] = np.zeros((count, 0), np.float32)  # (n, D) newest that were finite
        self._before = self._rows  # (n, D) those before them

    def begin(self, which: NDArray[np.bool_]) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self.executed[which], self._actions[which] = self._rest, np.nan
        self._rows[which] = self._before[which] = np.nan

    def sense(self, rows: NDArray[np.float32]) -> None:
        """Take in the newest rows (n, D)."""
        if self._meaning is not None:
            self._before = self._rows if self._rows.size else np.full_like(rows, np.nan)
            self._rows = np.where(np.isfinite(rows), rows, self._before)

    def start(self, robot: int, executed: NDArray[np.float32]) -> None:
        """An override begins, after the robot has ``executed`` (A,)."""
        self.executed[robot], self._actions[robot] = executed, np.nan

    def stay(self, robot: int) -> NDArray[np.float32]:
        """Return the action (A,) for which a robot stays; a number that is not known yet is that of ``rest``."""
        if self._meaning is None:
            return self._rest.copy()
        action = self._actions[robot]
        if not np.isfinite(action).all() and self._rows.size:
            found = self._meaning.staying(self._rows[robot], self._before[robot], self.executed[robot])
            action[:] = np.where(np.isfinite(action), action, found)
        return np.where(np.isfinite(action), action, self._rest)


class Reflexes:
    """What the reflexes of n robots have felt.

    Raises:
        ValueError: the robots cannot do what ``on_alarm`` names: a reflex, or ``"graded"``.
    """

    def __init__(self, robots: Robots, spec: StreamSpec, on_alarm: str) -> None:
        n, actions = robots.count, robots.rest.size
        wanted = ("hold", "retract", "comply") if on_alarm == GRADED else (on_alarm,)
        self.torques = named(spec.channels, "external_torque")  # (J,) columns of external torques
        lacks = dict(robots.refused)
        if not self.torques.size:
            lacks.setdefault("comply", NO_TORQUE)
        for name in (on_alarm, "hold"):
            if name in lacks:
                raise ValueError(lacks[name])
        self.possible = frozenset(name for name in wanted if name not in lacks)
        self.feels = bool(self.possible - {"hold", "recall"})  # one of them depends on what was felt and done
        self.robots = robots
        self.tolerated = TOLERATED if on_alarm == GRADED else TOLERATED_ALONE
        # (n, J) external torque now, and what is usual while the policy acts [N m]
        self.torque, self.usual = np.zeros((n, len(self.torques))), np.zeros((n, len(self.torques)))
        # (n, PATH, A) what the policy did last, the newest last, and (n,) how much of it there is
        self.path, self.steps = np.zeros((n, PATH, actions), np.float32), np.zeros(n, np.int64)
        self.expected = np.zeros((n, actions), np.float32)  # (n, A) what is likely to be commanded next; NaN: unknown
        self.places = Places(n, robots.meaning, robots.rest)

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self.torque[which] = self.usual[which] = 0.0
        self.steps[which] = 0
        self.expected[which] = np.nan

    def move(self, robot: int, name: str) -> Motion:
        """Return what a robot does; it stays where it cannot do what is asked for."""
        return REFLEXES[name if name in self.possible else "hold"](self, robot)


def hold(felt: Reflexes, robot: int) -> Motion:
    """Stay, by a brake beneath the controller where there is one."""
    return Motion(felt.places.stay(robot), felt.robots.brakes)


def retract(felt: Reflexes, robot: int) -> Motion:
    """Undo the last actions, the newest first, then stay: under a delta controller its negative undoes an action."""
    if not felt.steps[robot]:
        return hold(felt, robot)
    undone = -felt.path[robot, -1]
    felt.path[robot, 1:] = felt.path[robot, :-1].copy()
    felt.steps[robot] -= 1
    return Motion(undone)


def comply(felt: Reflexes, robot: int) -> Motion:
    """Give way along the external torque beyond the usual, as a damper would."""
    assert felt.robots.turn is not None
    more = felt.torque[robot] - felt.usual[robot]
    beyond = np.sign(more) * np.maximum(np.abs(more) - felt.tolerated, 0.0)
    return Motion(np.array(felt.robots.turn(robot, COMPLIANCE * felt.robots.dt * beyond), np.float32))


def recall(felt: Reflexes, robot: int) -> Motion:
    """Go on along what the memory expects to be commanded, grip included; stay where it expects nothing yet."""
    expected = felt.expected[robot]
    return Motion(expected.copy(), keeps_grip=False) if np.isfinite(expected).all() else hold(felt, robot)


REFLEXES: dict[str, Callable[[Reflexes, int], Motion]] = {f.__name__: f for f in (hold, retract, comply, recall)}
"""Reflexes by name."""
