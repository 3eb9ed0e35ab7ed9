"""The arrays that the compiled loop works on: MuJoCo's own, and the arms' places in them."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import types
from numba.experimental import structref
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
JOINTS = 7  # the most joints an arm may have; shorter arms leave the rest unused
# numbers that limits apply to: external torque of the joints, then force at the wrist
FELT = JOINTS + 3
OSC_POSE, JOINT_POSITION = 0, 1
UNKNOWN_CHANGE, JOINT_ANGLES, HAND_POSE = range(3)  # what the inputs of an arm change


class Views(NamedTuple):
    """MuJoCo's own arrays of one model and its data, by its own names and not copied; and the addresses of both."""

    model: int
    data: int
    qpos: Floats  # (nq,)
    qvel: Floats  # (nv,)
    qacc: Floats  # (nv,)
    ctrl: Floats  # (nu,)
    M: Floats  # (nC,) the lower triangle of the mass matrix, its rows one after the other
    qfrc_bias: Floats  # (nv,) Coriolis, centrifugal and gravity
    qfrc_passive: Floats  # (nv,)
    qfrc_actuator: Floats  # (nv,)
    cdof: Floats  # (nv, 6)
    cvel: Floats  # (nbody, 6)
    subtree_com: Floats  # (nbody, 3)
    xpos: Floats  # (nbody, 3)
    site_xpos: Floats  # (nsite, 3)
    site_xmat: Floats  # (nsite, 9)
    sensordata: Floats
    cfrc_ext: Floats  # (nbody, 6) contact and applied force: torque, then force
    xfrc_applied: Floats  # (nbody, 6) applied force: force, then torque
    actuator_ctrlrange: Floats  # (nu, 2)
    dof_damping: Floats  # (nv,)
    M_rowadr: NDArray[np.int32]  # (nv,) where a row of `M` begins
    M_rownnz: NDArray[np.int32]  # (nv,) how many numbers it has; the last is the diagonal's
    M_colind: NDArray[np.int32]  # (nC,) their columns: the joints between the base and the row's

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData) -> Views:
        """Return the arrays of a loaded model."""
        arrays = (getattr(data if hasattr(data, name) else model, name) for name in cls._fields[2:])
        return cls(model._address, data._address, *arrays)


class NominalViews(NamedTuple):
    """Dynamics that controllers and torque estimate use, frozen when the model was loaded."""

    model: int  # 0 while the live model is the nominal one
    data: int
    qpos: Floats
    qvel: Floats
    mass: Floats
    bias: Floats
    bias_at: int  # its address
    damping: Floats


class Arms(NamedTuple):
    """Each arm's indices in the arrays, and its controller's settings; one row an arm."""

    joints: Ints  # (A,) how many
    qpos: Ints  # (A, JOINTS)
    dofs: Ints  # (A, JOINTS)
    motors: Ints  # (A, JOINTS)
    site: Ints  # (A,) between the fingers
    site_body: Ints  # (A,) that it belongs to
    root: Ints  # (A,) the robot's outermost body
    base: Ints  # (A,) the site that actions are relative to, -1 for the world
    wrench: Ints  # (A,) where the wrist's force and torque begin in sensordata
    bodies: Ints  # (A, B) bodies whose contacts count, padded with -1; what is fixed to the world belongs to it
    links: Ints  # (A, L) bodies from the hand to the base, padded with -1
    tree: Ints  # (A, T) dofs of the arm and all that hangs on it, padded with -1
    kind: Ints  # (A,) OSC_POSE or JOINT_POSITION
    kp: Floats  # (A, JOINTS)
    kd: Floats  # (A, JOINTS)
    compensate: NDArray[np.bool_]  # (A,) joint control that knows the arm's dynamics
    rest: Floats  # (A, JOINTS) the posture that spare joints tend to [rad]
    limits: Floats  # (A, JOINTS, 2) of the joint set-point [rad]
    first: Ints  # (A,) where the arm's part of the action begins
    inputs: Ints  # (A,) how many numbers it has
    scaling: Floats  # (A, 5, JOINTS) of them; see ``commands``
    changes: Ints  # (A,) what they change: UNKNOWN_CHANGE, JOINT_ANGLES or HAND_POSE
    speeds: Floats  # (A, JOINTS) that a unit of them, asked for again and again, leads to [m/s], [rad/s]


class Goals(NamedTuple):
    """The controllers' set-points, changed in place."""

    action: Floats  # that moves them, in robosuite's units
    position: Floats  # (A, 3)
    orientation: Floats  # (A, 3, 3)
    joints: Floats  # (A, JOINTS)
    anchor: Floats  # (A, JOINTS) where an arm that is held is to stay [rad]
    held: (
        Ints  # (A,) whether it is: 0, ``control.HELD``, ``control.BRAKING`` or ``control.YIELDING``
    )

    @classmethod
    def of(cls, arms: int, inputs: int) -> Goals:
        """Return set-points of 0, which no arm is held at."""
        shapes = (inputs,), (arms, 3), (arms, 3, 3), (arms, JOINTS), (arms, JOINTS)
        return cls._make([*map(np.zeros, shapes), np.zeros(arms, np.int64)])


class Work(NamedTuple):
    """What control computes of one arm, overwritten for the next."""

    M: Floats  # (JOINTS, JOINTS) mass matrix
    L: Floats  # (JOINTS, JOINTS) a Cholesky factor
    A: Floats  # (JOINTS, JOINTS)
    G: Floats  # (JOINTS, JOINTS)
    J: Floats  # (6, JOINTS) Jacobian of the hand: linear, then angular velocity
    F: Floats  # (2, 6)
    h: Floats  # (JOINTS,) bias
    v: Floats  # (JOINTS,) velocities
    p: Floats  # (JOINTS,)
    tau: Floats  # (JOINTS,) torques

    @classmethod
    def empty(cls) -> Work:
        """Return arrays to write into."""
        shapes = *[(JOINTS, JOINTS)] * 4, (6, JOINTS), (2, 6), *[(JOINTS,)] * 4
        return cls._make(map(np.zeros, shapes))


class SubstepLimits(NamedTuple):
    """Limits of the arms' load in every substep of a control step; changed in place."""

    most: Floats  # (A, FELT) [N m], [N]
    load: Floats  # (1,) the largest share of a limit that was reached since the control step began
    state: Ints  # (6,) see below
    speed: Floats  # (A,) of the fastest point of an arm, from which on it is slowed down; infinite for none [m/s]


ARMED, ACTS, SUBSTEPS, PASSED_IN, STAYED, BRAKED = range(6)
"""Of ``SubstepLimits.state``: whether limits are compared; whether the arms stay once one is passed; substeps since the
control step began; the first of them in which a limit was passed, -1 for none; whether the arms were stopped;
in how many of them, counted for each arm, it was slowed down."""


@structref.register
class _BoundType(types.StructRef):
    """The compiler's type of ``Bound``."""


class Bound(structref.StructRefProxy):
    """All that the compiled loop works on, in one object: ``parts`` is a tuple of it.

    Numba takes an array apart at every call that it is given to, which for all of these together takes longer than some
    substeps; it takes this apart once.
    """

    parts: tuple[Any, ...]


structref.define_proxy(Bound, _BoundType, ["parts"])  # type: ignore[no-untyped-call]
