"""What the compiled code works on: MuJoCo's arrays, and where the arms stand in them."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.addresses import flags1, floats1, floats2, floats3, shorts1, whole1, whole2
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


@compiled
def views_at(t: Any) -> Any:
    """``Views`` of its table."""
    state = (
        floats1(t, 2),
        floats1(t, 3),
        floats1(t, 4),
        floats1(t, 5),
        floats1(t, 6),
        floats1(t, 7),
        floats1(t, 8),
        floats1(t, 9),
    )
    bodies = floats2(t, 10), floats2(t, 11), floats2(t, 12), floats2(t, 13), floats2(t, 14)
    rest = (
        floats1(t, 15),
        floats2(t, 16),
        floats2(t, 17),
        floats2(t, 18),
        floats1(t, 19),
        shorts1(t, 20),
        shorts1(t, 21),
    )
    return Views(t[0, 0], t[1, 0], *state, *bodies, *rest)


@compiled
def nominal_at(t: Any) -> Any:
    """``NominalViews`` of its table."""
    return NominalViews(t[0, 0], t[1, 0], floats1(t, 2), floats1(t, 3), floats1(t, 4), floats1(t, 5), floats1(t, 6))


@compiled
def arms_at(t: Any) -> Any:
    """``Arms`` of its table."""
    joints = whole1(t, 0), whole2(t, 1), whole2(t, 2), whole2(t, 3)
    places = (
        whole1(t, 4),
        whole1(t, 5),
        whole1(t, 6),
        whole1(t, 7),
        whole1(t, 8),
        whole2(t, 9),
        whole2(t, 10),
        whole1(t, 11),
    )
    compensate = flags1(t, 14)
    return Arms(*joints, *places, floats2(t, 12), floats2(t, 13), compensate, floats2(t, 15), floats3(t, 16))


@compiled
def goals_at(t: Any) -> Any:
    """``Goals`` of its table."""
    return Goals(floats2(t, 0), floats3(t, 1), floats2(t, 2), floats2(t, 3), whole1(t, 4))


@compiled
def limits_at(t: Any) -> Any:
    """``SubstepLimits`` of its table."""
    return SubstepLimits(floats2(t, 0), floats1(t, 1), whole1(t, 2))
