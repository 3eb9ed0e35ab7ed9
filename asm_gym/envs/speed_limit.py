"""Slow an action down so that no point of a hand goes faster than it may.

A controller that is asked for an action u again and again comes to the speeds w = Kp/Kd k (u - u₀), where u₀ changes
nothing and k is the change that one unit asks for. These are speeds of the hand, or of the joints, so that the hand's
twist is

    v = R w      or      v = J w      R: the frame that actions are relative to.

Its fastest point, r from the fingers, goes |v_linear| + r |v_angular|. Of this motion the hand may have a share s at
its place (``detection.hand_speed``), so that the action becomes u₀ + s (u - u₀). The momentum of the arm behind its
hand is |Λ v|, Λ⁻¹ = J M⁻¹ Jᵀ (Khatib 1995): the impulse that stops it, which grows as the arm is stretched.

Where actions mean something else they stay as they are. Whatever was commanded, a brake slows the arm down beneath its
controller once it moves too fast (``arm_brake``).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import Bound, bind, compiled, inner
from asm_gym.envs.arm_brake import (
    Approach,
    closing_speed,
    how_soon,
    is_beside_base,
    present_gap,
    share_at,
    stopping_impulse,
    twist_speed,
)
from asm_gym.envs.controllers import velocity_at
from asm_gym.envs.mujoco_views import (
    EVERYWHERE,
    JOINT_ANGLES,
    UNKNOWN_CHANGE,
    Ahead,
    Arm,
    Arms,
    Floats,
    MotionLimits,
    Views,
)

Action = NDArray[np.float32]

_address = types.intp
_on_arrays = types.void(_address, _address, _address, _address, types.int32)
_site_jacobian: Any = types.ExternalFunction("mj_jacSite", _on_arrays)
_solve_mass: Any = types.ExternalFunction("mj_solveM", _on_arrays)


class Motion(NamedTuple):
    """Work space for the motion that is asked of one hand, overwritten for the next."""

    jacobian: Floats  # (6, nv) of the hand: linear, then angular velocity
    twist: Floats  # (6,) of the hand [m/s], [rad/s]
    turning_first: Floats  # (6,) the same, angular before linear
    place: Floats  # (3,) of a point of the hand [m]
    solved: Floats  # (3, nv) M⁻¹ Jᵀ of the linear velocity
    inverse_mass: Floats  # (3, 3) Λ⁻¹ [1/kg]
    factor: Floats  # (3, 3) of it
    momentum: Floats  # (3,) Λ v [N s]


class SpeedLimiter:
    """Slows the actions of one episode down.

    Args:
        views: arrays of the loaded model.
        arms: its arms, and what their inputs are.
        rest: (A,) the action that changes nothing.
        brake_speeds: (arms,) written with each call: the speed from which on an arm is braked [m/s].
        ahead: where the arms are near obstacles.
    """

    def __init__(
        self, views: Views, arms: Arms, rest: Action, brake_speeds: Floats, ahead: Ahead
    ) -> None:
        self._views = views
        self._arms = arms
        self._ahead = ahead
        self._rest = rest
        self._brake_speeds = brake_speeds
        joints = len(views.qvel)
        self._motion = Motion(
            jacobian=np.zeros((6, joints)),
            twist=np.zeros(6),
            turning_first=np.zeros(6),
            place=np.zeros(3),
            solved=np.zeros((3, joints)),
            inverse_mass=np.zeros((3, 3)),
            factor=np.zeros((3, 3)),
            momentum=np.zeros(3),
        )
        self._limits: MotionLimits | None = None  # that the compiled code is bound to

    def slowed(self, action: Action, limits: MotionLimits) -> Action:
        """Return the action (A,) at the hand speed that the limits allow."""
        if limits is not self._limits:
            self._limits = limits
            parts = (
                self._views,
                self._arms,
                self._rest,
                limits,
                self._motion,
                self._brake_speeds,
                self._ahead,
            )
            self._bound: Bound = bind(*parts)
        slow_action = action.copy()
        slow(self._bound, action, slow_action)
        return slow_action


@inner
def add_joint(jacobian: Floats, dof: int, speed: float, twist: Floats) -> None:
    """Add what a joint's speed [rad/s] gives the hand to its twist (6,)."""
    for axis in range(6):
        twist[axis] += jacobian[axis, dof] * speed


@partial(inner, inlined=True)
def add_direction(views: Views, base: int, number: int, speed: float, twist: Floats) -> None:
    """Add a speed along, or about, an axis of the frame that actions are relative to."""
    column = number % 3
    first = number - column  # 0 for linear, 3 for angular velocity
    for axis in range(3):
        cosine = views.site_xmat[base, 3 * axis + column]
        twist[first + axis] += cosine * speed


@partial(inner, inlined=True)
def read_asked(
    views: Views,
    arm: Arm,
    rest: Action,
    action: Action,
    motion: Motion,
) -> None:
    """Write the twist that the action asks of an arm's hand."""
    twist = motion.twist
    for axis in range(6):
        twist[axis] = 0.0
    for i in range(arm.input_count):
        number = arm.first_input + i
        asked = action[number] - rest[number]
        speed = arm.input_speeds[i] * asked
        if arm.changes == JOINT_ANGLES:
            add_joint(motion.jacobian, arm.dofs[i], speed, twist)
        else:
            add_direction(views, arm.frame, i, speed, twist)


@partial(inner, inlined=True)
def asks_soon(views: Views, arm: Arm, ahead: Ahead, a: int, motion: Motion) -> float:
    """Return how soon arm ``a``'s hand touches an obstacle in the motion that is asked of it; see ``how_soon``."""
    if ahead.counts[a, 0] == EVERYWHERE:
        return 1.0
    for axis in range(3):
        motion.turning_first[axis] = motion.twist[3 + axis]
        motion.turning_first[3 + axis] = motion.twist[axis]
    most = 0.0
    for k in range(ahead.counts[a, 0]):
        point = ahead.points[a, 0, k]
        gap = present_gap(views, arm.links[0], point, motion.place)
        x, y, z = velocity_at(motion.turning_first, motion.place, views.site_xpos[arm.site])
        most = max(most, how_soon(closing_speed(point.way, x, y, z), gap))
    return most


@partial(inner, inlined=True)
def asked_momentum(views: Views, motion: Motion) -> float:
    """Return |Λ v|, the momentum of an arm's hand in the motion that is asked of it [N s]."""
    address = motion.solved.ctypes.data
    _solve_mass(views.model, views.data, address, motion.jacobian.ctypes.data, 3)
    for row in range(3):
        motion.momentum[row] = motion.twist[row]
        for column in range(3):
            entry = 0.0
            for dof in range(motion.solved.shape[1]):
                entry += motion.jacobian[row, dof] * motion.solved[column, dof]
            motion.inverse_mass[row, column] = entry
    return stopping_impulse(motion.inverse_mass, motion.factor, motion.momentum)


@partial(inner, inlined=True)
def scale_part(arm: Arm, share: np.float32, rest: Action, action: Action) -> None:
    """Leave a share of an arm's part of an action, in place."""
    first = arm.first_input
    end = first + arm.input_count
    for number in range(first, end):
        asked = action[number] - rest[number]
        action[number] = rest[number] + share * asked


@partial(compiled, nogil=True, calls=("detection",))
def slow(bound: Bound, action: Action, slowed: Action) -> None:
    """Scale each arm's part of the action (A,) along its own direction.

    Args:
        bound: of ``SpeedLimiter``, which has the speeds at which arms are braked written into it.
        action: what was asked for.
        slowed: a copy of it, in which the parts of arms that would be too fast are replaced.
    """
    views, arms, rest, limits, motion, brake_speeds, ahead = bound.parts
    for a in range(len(arms)):
        arm = arms[a]
        limit = limits[int(is_beside_base(views, arm))]
        brake_speeds[a] = limit.hand_speed
        if arm.changes == UNKNOWN_CHANGE:
            continue

        linear = motion.jacobian.ctypes.data
        angular = motion.jacobian[3:].ctypes.data
        _site_jacobian(views.model, views.data, linear, angular, arm.site)
        read_asked(views, arm, rest, action, motion)
        soon = asks_soon(views, arm, ahead, a, motion)
        momentum = 0.0
        if soon > 0.0 and limit.momentum < np.inf:
            momentum = soon * asked_momentum(views, motion)
        approach = Approach(soon=soon, momentum=momentum, link_momentum=0.0, leans=False)
        share = share_at(views, arm, a, limit, motion.twist, approach)
        brake_speeds[a] = max(limit.hand_speed, share * twist_speed(motion.twist))
        if share < 1.0:
            scale_part(arm, np.float32(share), rest, slowed)
