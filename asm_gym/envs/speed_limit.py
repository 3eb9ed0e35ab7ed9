"""Slow an action down so that no point of a hand goes faster than it may.

A controller that is asked for an action u again and again comes to the speeds w = Kp/Kd k (u - u₀), where u₀ changes
nothing and k is the change that one unit asks for. These are speeds of the hand, or of the joints, so that the hand's
twist is

    v = R w      or      v = J w      R: the frame that actions are relative to.

Its fastest point, r from the fingers, goes |v_linear| + r |v_angular|. Of this motion the hand may have a share s at
its place (``detection.hand_speed``), so that the action becomes u₀ + s (u - u₀). The momentum of the arm along the
motion is m |v|, with the reflected mass 1/m = nᵀ J M⁻¹ Jᵀ n, n = v/|v| (Khatib 1995), which grows as the arm is
stretched.

Where actions mean something else they stay as they are, and a brake slows the arm down beneath its controller once it
is too fast (``controllers.slow_down``).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import Bound, bind, compiled, inner
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed import SpeedLimit, allowed_share
from asm_gym.envs.controllers import REACHES, length
from asm_gym.envs.mujoco_views import JOINT_ANGLES, UNKNOWN_CHANGE, Arm, Arms, Floats, Views

# Nearer to the axis of its own base a hand goes half as fast, for its mount is hard [m].
BESIDE_BASE = 0.3
LEAST_INVERSE_MASS = 1e-12  # [1/kg]

# Rows of ``Motions``.
ASKED = 0  # what the action asks for
PRESENT = 1  # what the hand does now

Action = NDArray[np.float32]

_address = types.intp
_on_arrays = types.void(_address, _address, _address, _address, types.int32)
_site_jacobian: Any = types.ExternalFunction("mj_jacSite", _on_arrays)
_solve_mass: Any = types.ExternalFunction("mj_solveM", _on_arrays)


class Motions(NamedTuple):
    """Work space for the motions of one hand, overwritten for the next."""

    jacobian: Floats  # (6, nv) of the hand: linear, then angular velocity
    twists: Floats  # (2, 6) of the hand [m/s], [rad/s]
    forces: Floats  # (2, nv) Jᵀ v of the linear velocities
    solved: Floats  # (2, nv) M⁻¹ Jᵀ v


class SpeedLimiter:
    """Slows the actions of one episode down.

    Args:
        views: arrays of the loaded model.
        arms: its arms, and what their inputs are.
        rest: (A,) the action that changes nothing.
        brake_speeds: (arms,) written with each call: the speed from which on an arm is braked [m/s].
    """

    def __init__(self, views: Views, arms: Arms, rest: Action, brake_speeds: Floats) -> None:
        self._views = views
        self._arms = arms
        self._rest = rest
        self._brake_speeds = brake_speeds
        joints = len(views.qvel)
        self._motions = Motions(
            jacobian=np.zeros((6, joints)),
            twists=np.zeros((2, 6)),
            forces=np.zeros((2, joints)),
            solved=np.zeros((2, joints)),
        )
        self._limits: ContactLimits | None = None  # that the compiled code is bound to

    def slowed(self, action: Action, limits: ContactLimits) -> Action:
        """Return the action (A,) at the hand speed that the limits allow."""
        if limits is not self._limits:
            self._bind(limits)
        slow_action = action.copy()
        slow(self._bound, action, slow_action)
        return slow_action

    def _bind(self, limits: ContactLimits) -> None:
        beside_base = limits.reduced(1.0, limits.hand_speed / 2)
        self._limits = limits
        self._bound: Bound = bind(
            self._views,
            self._arms,
            self._rest,
            (limits.speed_limit(), beside_base.speed_limit()),
            self._motions,
            self._brake_speeds,
        )


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
    motions: Motions,
) -> None:
    """Write the twist that the action asks of an arm's hand."""
    twist = motions.twists[ASKED]
    for axis in range(6):
        twist[axis] = 0.0
    for i in range(arm.input_count):
        number = arm.first_input + i
        asked = action[number] - rest[number]
        speed = arm.input_speeds[i] * asked
        if arm.changes == JOINT_ANGLES:
            add_joint(motions.jacobian, arm.dofs[i], speed, twist)
        else:
            add_direction(views, arm.frame, i, speed, twist)


@partial(inner, inlined=True)
def read_present(views: Views, arm: Arm, motions: Motions) -> None:
    """Write the twist that an arm's hand has now."""
    twist = motions.twists[PRESENT]
    for axis in range(6):
        twist[axis] = 0.0
    for i in range(arm.joint_count):
        dof = arm.dofs[i]
        add_joint(motions.jacobian, dof, views.qvel[dof], twist)


@inner
def hand_speed(twist: Floats) -> float:
    """Return how fast the furthest point of a hand can go [m/s]."""
    return length(twist[:3]) + REACHES * length(twist[3:])


@partial(inner, inlined=True)
def momentum(views: Views, motions: Motions, row: int) -> float:
    """Return m |v|, the momentum of an arm along its hand's motion [N s]."""
    jacobian = motions.jacobian
    velocity = motions.twists[row, :3]
    force = motions.forces[row]
    solved = motions.solved[row]
    for dof in range(len(force)):
        force[dof] = 0.0
        for axis in range(3):
            force[dof] += jacobian[axis, dof] * velocity[axis]
    _solve_mass(views.model, views.data, solved.ctypes.data, force.ctypes.data, 1)

    inverse = 0.0  # |v|²/m
    for dof in range(len(force)):
        inverse += force[dof] * solved[dof]
    return length(velocity) ** 3 / max(inverse, LEAST_INVERSE_MASS)


@partial(inner, inlined=True)
def share_of(
    views: Views, arms: Arms, a: int, limit: SpeedLimit, motions: Motions, row: int
) -> float:
    """Return the share that arm ``a``'s hand may have of a motion."""
    twist = motions.twists[row]
    place = views.site_xpos[arms[a].site]
    along = 0.0
    if limit.grid.size > 0:
        along = momentum(views, motions, row)
    speed = hand_speed(twist)
    return allowed_share(limit, a, place, twist, speed, along)


@partial(inner, inlined=True)
def is_beside_base(views: Views, arm: Arm) -> bool:
    """Whether an arm's hand is near the axis of its own base."""
    hand = views.site_xpos[arm.site]
    base = views.xpos[arm.root]
    x = hand[0] - base[0]
    y = hand[1] - base[1]
    return np.hypot(x, y) < BESIDE_BASE


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
    views, arms, rest, limits, motions, brake_speeds = bound.parts
    for a in range(len(arms)):
        arm = arms[a]
        limit = limits[int(is_beside_base(views, arm))]
        brake_speeds[a] = limit.hand_speed
        if arm.changes == UNKNOWN_CHANGE:
            continue

        linear = motions.jacobian.ctypes.data
        angular = motions.jacobian[3:].ctypes.data
        _site_jacobian(views.model, views.data, linear, angular, arm.site)
        read_asked(views, arm, rest, action, motions)
        read_present(views, arm, motions)
        share = share_of(views, arms, a, limit, motions, ASKED)
        present_share = share_of(views, arms, a, limit, motions, PRESENT)

        fastest = share * hand_speed(motions.twists[ASKED])
        if present_share < 1.0:
            present = hand_speed(motions.twists[PRESENT])
            fastest = min(fastest, present_share * present)
        if fastest > limit.hand_speed:
            brake_speeds[a] = fastest
        if share < 1.0:
            scale_part(arm, np.float32(share), rest, slowed)
