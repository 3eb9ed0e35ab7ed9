"""Slow an action down so that no point of a hand goes faster than it may.

A controller that is asked for a change of pose Δx, or of joint angles Δq, again and again comes to the hand's twist

    v = Kp/Kd Δx      or      v = J Kp/Kd Δq.

Its fastest point, r from the fingers, goes |v_linear| + r |v_angular|. Of this motion the hand may have a share s at
its place (``detection.hand_speed_map``), so that the action u becomes

    u₀ + s (u - u₀)      where u₀ changes nothing.

The momentum of the arm along the motion is m |v|, with the reflected mass 1/m = nᵀ J M⁻¹ Jᵀ n, n = v/|v| (Khatib 1995),
which grows as the arm is stretched. Where actions mean something else they stay as they are, and a brake slows the arm
down beneath its controller once it is too fast (``control.slow_down``).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed_map import SpeedLimit, allowed_share
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.commands import scaled
from asm_gym.envs.control import REACHES
from asm_gym.envs.mujoco_views import JOINT_ANGLES, UNKNOWN_CHANGE, Arms, Bound, Floats, Views

BESIDE = 0.3  # nearer to the axis of its own base a hand goes half as fast, for its mount is hard [m]
LIGHT = 1e-12  # no inverse mass is taken to be less [1/kg]

ASKED, PRESENT = range(2)
"""Rows of ``Motions``: what the action asks for, and what the hand does now."""

_address = types.intp
_site_jacobian: Any = types.ExternalFunction(
    "mj_jacSite", types.void(_address, _address, _address, _address, types.int32)
)
_solve_mass: Any = types.ExternalFunction("mj_solveM", types.void(_address, _address, _address, _address, types.int32))


class ActionScale(NamedTuple):
    """The numbers of an action."""

    middle: Floats  # (A,) of what robosuite's controllers are given, for an action of 0
    half: Floats  # (A,) of its range
    rest: NDArray[np.float32]  # (A,) the action that changes nothing


class Motions(NamedTuple):
    """Work space for the motions of one hand, overwritten for the next."""

    jacobian: Floats  # (6, nv) of the hand: linear, then angular velocity
    twists: Floats  # (2, 6) of the hand [m/s], [rad/s]
    forces: Floats  # (2, nv) Jᵀ v of the linear velocities
    accelerations: Floats  # (2, nv) M⁻¹ Jᵀ v


class SpeedLimiter:
    """Slows the actions of one episode down.

    Args:
        views: arrays of the loaded model.
        arms: its arms, and what their inputs are.
        scale: of the actions.
        brake_speeds: (arms,) written with each call: the speed from which on an arm is braked [m/s].
    """

    def __init__(self, views: Views, arms: Arms, scale: ActionScale, brake_speeds: Floats) -> None:
        joints = len(views.qvel)
        self._views = views
        self._arms = arms
        self._scale = scale
        self._brake_speeds = brake_speeds
        self._motions = Motions(
            jacobian=np.zeros((6, joints)),
            twists=np.zeros((2, 6)),
            forces=np.zeros((2, joints)),
            accelerations=np.zeros((2, joints)),
        )
        self._limits: ContactLimits | None = None
        self._bound: Bound | None = None

    def slowed(self, action: NDArray[np.float32], limits: ContactLimits) -> NDArray[np.float32]:
        """Return the action (A,) at the hand speed that the limits allow."""
        if limits is not self._limits:
            self._bind(limits)
        slow_action = action.copy()
        slow(self._bound, action, slow_action)
        return slow_action

    def _bind(self, limits: ContactLimits) -> None:
        beside_base = limits.stricter(1.0, limits.hand_speed / 2)
        speed_limits = (limits.speed_limit(), beside_base.speed_limit())
        self._limits = limits
        self._bound = kernels.bind(
            self._views, self._arms, self._scale, speed_limits, self._motions, self._brake_speeds
        )


@inner
def add_joint(motions: Motions, row: int, dof: int, speed: float) -> None:
    """Add the twist that a joint's speed [rad/s] gives the hand."""
    for axis in range(6):
        motions.twists[row, axis] += motions.jacobian[axis, dof] * speed


@partial(inner, inlined=True)
def add_direction(views: Views, base: int, motions: Motions, number: int, speed: float) -> None:
    """Add a speed along, or about, an axis of the frame that actions are relative to."""
    part = number - number % 3  # 0 for linear, 3 for angular velocity
    column = number % 3
    for axis in range(3):
        if base >= 0:
            motions.twists[ASKED, part + axis] += views.site_xmat[base, 3 * axis + column] * speed
        elif axis == column:
            motions.twists[ASKED, part + axis] += speed


@partial(inner, inlined=True)
def read_twists(
    views: Views, arms: Arms, scale: ActionScale, motions: Motions, a: int, action: NDArray[np.float32]
) -> None:
    """Write the twists of arm ``a``'s hand: what the action asks for, and the present one."""
    motions.twists[:] = 0.0
    for i in range(arms.inputs[a]):
        number = arms.first[a] + i
        command = scale.middle[number] + scale.half[number] * action[number]
        speed = arms.gain[a, i] * scaled(command, arms.scaling, a, i)
        if arms.changes[a] == JOINT_ANGLES:
            add_joint(motions, ASKED, arms.dofs[a, i], speed)
        else:
            add_direction(views, arms.base[a], motions, i, speed)
    for i in range(arms.joints[a]):
        dof = arms.dofs[a, i]
        add_joint(motions, PRESENT, dof, views.qvel[dof])


@inner
def length(vectors: Floats, row: int, first: int) -> float:
    """Return the length of three numbers of a row."""
    squares = 0.0
    for i in range(first, first + 3):
        squares += vectors[row, i] * vectors[row, i]
    return np.sqrt(squares)


@partial(inner, inlined=True)
def momentum(views: Views, motions: Motions, row: int) -> float:
    """Return m |v|, the momentum of an arm along its hand's motion [N s]."""
    joints = motions.jacobian.shape[1]
    for i in range(joints):
        motions.forces[row, i] = 0.0
        for axis in range(3):
            motions.forces[row, i] += motions.jacobian[axis, i] * motions.twists[row, axis]
    forces = motions.forces[row:]
    accelerations = motions.accelerations[row:]
    _solve_mass(views.model, views.data, accelerations.ctypes.data, forces.ctypes.data, 1)

    yielding = 0.0  # |v|²/m
    for i in range(joints):
        yielding += motions.forces[row, i] * motions.accelerations[row, i]
    return length(motions.twists, row, 0) ** 3 / max(yielding, LIGHT)


@partial(inner, inlined=True)
def share_of(views: Views, arms: Arms, limit: SpeedLimit, motions: Motions, a: int, row: int, speed: float) -> float:
    """Return the share that arm ``a``'s hand may have of a motion whose fastest point has a speed [m/s]."""
    along = 0.0
    if limit.grid.shape[0] > 0:
        along = momentum(views, motions, row)
    place = views.site_xpos[arms.site[a]]
    return allowed_share(limit, a, place, motions.twists[row], speed, along)


@partial(inner, inlined=True)
def is_beside_base(views: Views, arms: Arms, a: int) -> bool:
    """Whether arm ``a``'s hand is near the axis of its own base."""
    x = views.site_xpos[arms.site[a], 0] - views.xpos[arms.root[a], 0]
    y = views.site_xpos[arms.site[a], 1] - views.xpos[arms.root[a], 1]
    return np.sqrt(x * x + y * y) < BESIDE


@partial(compiled, nogil=True, calls=("detection",))
def slow(bound: Bound, action: NDArray[np.float32], slowed: NDArray[np.float32]) -> None:
    """Scale the action (A,) along its own direction into ``slowed`` (A,), a copy of it.

    Args:
        bound: of ``SpeedLimiter``, which has the speeds at which arms are braked written into it.
        action: what was asked for.
        slowed: where an arm would be too fast, its part is written.
    """
    views, arms, scale, limits, motions, brake_speeds = bound.parts
    for a in range(len(arms.joints)):
        limit = limits[int(is_beside_base(views, arms, a))]
        brake_speeds[a] = limit.hand_speed
        if arms.changes[a] == UNKNOWN_CHANGE:
            continue

        linear = motions.jacobian
        angular = motions.jacobian[3:]
        _site_jacobian(views.model, views.data, linear.ctypes.data, angular.ctypes.data, arms.site[a])
        read_twists(views, arms, scale, motions, a, action)
        asked_speed = length(motions.twists, ASKED, 0) + REACHES * length(motions.twists, ASKED, 3)
        present_speed = length(motions.twists, PRESENT, 0) + REACHES * length(motions.twists, PRESENT, 3)
        share = share_of(views, arms, limit, motions, a, ASKED, asked_speed)
        present_share = share_of(views, arms, limit, motions, a, PRESENT, present_speed)

        fastest = asked_speed * share
        if present_share < 1.0:
            fastest = min(fastest, present_speed * present_share)
        if fastest > limit.hand_speed:
            brake_speeds[a] = fastest
        if share < 1.0:
            for n in range(arms.first[a], arms.first[a] + arms.inputs[a]):
                rest = scale.rest[n]
                slowed[n] = rest + np.float32(share) * (action[n] - rest)
