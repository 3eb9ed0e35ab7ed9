"""What the compiled code works on: MuJoCo's arrays, and where the arms stand in them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from asm_gym.compilation import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

JOINTS = 7
"""The most joints an arm may have; shorter arms leave the rest unused."""

FELT = JOINTS + 3
"""What an arm feels of its surroundings: external torque of its joints, then force at the wrist."""

OSC_POSE, JOINT_POSITION = 0, 1


class Views(NamedTuple):
    """MuJoCo's own arrays of one model and its data, not copies, and the addresses of both."""

    model: int
    data: int
    qpos: Floats  # (nq,)
    qvel: Floats  # (nv,)
    qacc: Floats  # (nv,)
    ctrl: Floats  # (nu,)
    mass: Floats  # (nM,) the sparse mass matrix
    bias: Floats  # (nv,) Coriolis, centrifugal and gravity
    passive: Floats  # (nv,)
    actuator: Floats  # (nv,)
    cdof: Floats  # (nv, 6)
    cvel: Floats  # (nbody, 6)
    subtree_com: Floats  # (nbody, 3)
    site_xpos: Floats  # (nsite, 3)
    site_xmat: Floats  # (nsite, 9)
    sensordata: Floats
    contact: Floats  # (nbody, 6) contact and applied force: torque, then force
    applied: Floats  # (nbody, 6) applied force: force, then torque
    ctrlrange: Floats  # (nu, 2)
    damping: Floats  # (nv,)
    mass_address: NDArray[np.int32]  # (nv,) where a row of `mass` begins
    parent: NDArray[np.int32]  # (nv,) the next joint towards the base, -1 at its end

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData) -> Views:
        """The arrays of a loaded model."""
        return cls(
            model=model._address,
            data=data._address,
            qpos=data.qpos,
            qvel=data.qvel,
            qacc=data.qacc,
            ctrl=data.ctrl,
            mass=data.qM,
            bias=data.qfrc_bias,
            passive=data.qfrc_passive,
            actuator=data.qfrc_actuator,
            cdof=data.cdof,
            cvel=data.cvel,
            subtree_com=data.subtree_com,
            site_xpos=data.site_xpos,
            site_xmat=data.site_xmat,
            sensordata=data.sensordata,
            contact=data.cfrc_ext,
            applied=data.xfrc_applied,
            ctrlrange=model.actuator_ctrlrange,
            damping=model.dof_damping,
            mass_address=model.dof_Madr,
            parent=model.dof_parentid,
        )


class NominalViews(NamedTuple):
    """The dynamics that the controllers and the torque estimate believe in, frozen when the model was loaded."""

    model: int  # 0 while the live model is the nominal one
    data: int
    qpos: Floats
    qvel: Floats
    mass: Floats
    bias: Floats
    damping: Floats


class Arms(NamedTuple):
    """Where each arm stands in the arrays, and its controller's settings; one row an arm."""

    joints: Ints  # (A,) how many
    qpos: Ints  # (A, JOINTS)
    dofs: Ints  # (A, JOINTS)
    motors: Ints  # (A, JOINTS)
    site: Ints  # (A,) between the fingers
    site_body: Ints  # (A,) that it belongs to
    root: Ints  # (A,) the robot's outermost body
    base: Ints  # (A,) the site that actions are relative to, -1 for the world
    wrench: Ints  # (A,) where the wrist's force and torque begin in sensordata
    bodies: Ints  # (A, B) bodies whose contacts count, padded with -1
    tree: Ints  # (A, T) dofs of the arm and all that hangs on it, padded with -1
    kind: Ints  # (A,) OSC_POSE or JOINT_POSITION
    kp: Floats  # (A, JOINTS)
    kd: Floats  # (A, JOINTS)
    compensate: NDArray[np.bool_]  # (A,) joint control that knows the arm's dynamics
    rest: Floats  # (A, JOINTS) the posture that spare joints tend to [rad]
    limits: Floats  # (A, JOINTS, 2) of the joint set-point [rad]


class Goals(NamedTuple):
    """The controllers' set-points, changed in place."""

    position: Floats  # (A, 3) relative to the base
    orientation: Floats  # (A, 3, 3) relative to the base
    joints: Floats  # (A, JOINTS)
    anchor: Floats  # (A, JOINTS) where an arm that is held is to stay [rad]
    held: Ints  # (A,) whether it is: 0, ``control.BRAKING`` or ``control.YIELDING``


class SubstepLimits(NamedTuple):
    """The most that arms may feel in every substep of a control step; changed in place."""

    most: Floats  # (A, FELT) [N m], [N]
    load: Floats  # (1,) the largest share of them that was felt since the control step began
    state: Ints  # (5,) see below


ARMED, ACTS, PASSED, LEFT, STAYED = range(5)
"""Of ``SubstepLimits.state``: whether they are looked at; whether the arms stay once one is passed; substeps since the
control step began; in which of them one was first passed, -1 for none; whether they were told to stay."""


def table(parts: Iterable[NDArray[Any] | int]) -> Ints:
    """(N, 4) where each array lies, and its shape; a number stands for itself.

    Handing over sixty arrays takes compiled code 9 µs, and one table of them none. Whoever keeps the table keeps them.
    """
    found = []
    for part in parts:
        if isinstance(part, int):
            found.append((part, 0, 0, 0))
            continue
        if not part.flags.c_contiguous:
            raise ValueError(f"an array of shape {part.shape} does not lie in one piece")
        found.append((part.ctypes.data, *part.shape, *(0,) * (3 - part.ndim)))
    return np.array(found, np.int64)


@intrinsic
def _at(context: Any, address: Any) -> Any:
    """What lies at an address, for compiled code."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), code


@compiled
def _f1(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1],), np.float64)


@compiled
def _f2(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.float64)


@compiled
def _f3(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2], t[k, 3]), np.float64)


@compiled
def _n1(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1],), np.int64)


@compiled
def _n2(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1], t[k, 2]), np.int64)


@compiled
def _s1(t: Any, k: int) -> Any:
    return carray(_at(t[k, 0]), (t[k, 1],), np.int32)


@compiled
def views_at(t: Any) -> Any:
    """``Views`` of its table."""
    state = _f1(t, 2), _f1(t, 3), _f1(t, 4), _f1(t, 5), _f1(t, 6), _f1(t, 7), _f1(t, 8), _f1(t, 9)
    bodies = _f2(t, 10), _f2(t, 11), _f2(t, 12), _f2(t, 13), _f2(t, 14)
    rest = _f1(t, 15), _f2(t, 16), _f2(t, 17), _f2(t, 18), _f1(t, 19), _s1(t, 20), _s1(t, 21)
    return Views(t[0, 0], t[1, 0], *state, *bodies, *rest)


@compiled
def nominal_at(t: Any) -> Any:
    """``NominalViews`` of its table."""
    return NominalViews(t[0, 0], t[1, 0], _f1(t, 2), _f1(t, 3), _f1(t, 4), _f1(t, 5), _f1(t, 6))


@compiled
def arms_at(t: Any) -> Any:
    """``Arms`` of its table."""
    joints = _n1(t, 0), _n2(t, 1), _n2(t, 2), _n2(t, 3)
    places = _n1(t, 4), _n1(t, 5), _n1(t, 6), _n1(t, 7), _n1(t, 8), _n2(t, 9), _n2(t, 10), _n1(t, 11)
    compensate = carray(_at(t[14, 0]), (t[14, 1],), np.bool_)
    return Arms(*joints, *places, _f2(t, 12), _f2(t, 13), compensate, _f2(t, 15), _f3(t, 16))


@compiled
def goals_at(t: Any) -> Any:
    """``Goals`` of its table."""
    return Goals(_f2(t, 0), _f3(t, 1), _f2(t, 2), _f2(t, 3), _n1(t, 4))


@compiled
def limits_at(t: Any) -> Any:
    """``SubstepLimits`` of its table."""
    return SubstepLimits(_f2(t, 0), _f1(t, 1), _n1(t, 2))
