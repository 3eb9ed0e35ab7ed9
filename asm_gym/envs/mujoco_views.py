"""The arrays that the compiled loop works on: MuJoCo's own, and the arms' places in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from llvmlite import binding
from numpy.typing import NDArray

from asm_gym.detection.hand_speed import SpeedLimit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
JOINTS = 7  # the most joints an arm may have; shorter arms leave the rest unused
MOST_BODIES = 48  # the most bodies, or dofs, of a robot with its gripper
# numbers that limits apply to: external torque of the joints, then force at the wrist
FELT = JOINTS + 3

NEAR_POINTS = 8  # the most of a link that are kept, those nearest to something
EVERYWHERE = -1  # in the place of their number: the link is surrounded

# Controllers that run compiled.
OSC_POSE = 0
JOINT_POSITION = 1

# What the inputs of an arm change.
UNKNOWN_CHANGE = 0
JOINT_ANGLES = 1
HAND_POSE = 2


def link_library() -> None:
    """Let compiled code call MuJoCo's own functions, linked by name so that it can be cached on disk."""
    folder = Path(mujoco.__file__).parent
    binding.load_library_permanently(str(next(folder.glob("libmujoco*"))))


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
    xmat: Floats  # (nbody, 9)
    geom_xpos: Floats  # (ngeom, 3)
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
        arrays = {}
        for name in cls._fields[2:]:
            owner = data if hasattr(data, name) else model
            arrays[name] = getattr(owner, name)
        return cls(model=model._address, data=data._address, **arrays)


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


ARM = np.dtype(
    [
        ("joint_count", np.int64),
        ("qpos", np.int64, JOINTS),  # the joints' places in MuJoCo's arrays
        ("dofs", np.int64, JOINTS),
        ("motors", np.int64, JOINTS),
        ("gears", np.float64, JOINTS),  # torque that a motor delivers of a command of 1 [N m]
        ("site", np.int64),  # between the fingers
        ("site_body", np.int64),  # that the site belongs to
        ("root", np.int64),  # the robot's outermost body
        ("frame", np.int64),  # the site that actions are relative to
        ("wrench", np.int64),  # where the wrist's force and torque begin in sensordata
        ("bodies", np.int64, MOST_BODIES),  # whose contacts count; then -1
        ("links", np.int64, MOST_BODIES),  # bodies from the hand to the base; then -1
        ("link_joints", np.int64, MOST_BODIES),  # how many of the joints move each of them
        ("tree_dofs", np.int64, MOST_BODIES),  # dofs of the arm and all that hangs on it; then -1
        ("controller", np.int64),  # OSC_POSE or JOINT_POSITION
        ("kp", np.float64, JOINTS),
        ("kd", np.float64, JOINTS),
        ("lowest", np.float64, JOINTS),  # a joint below it is at its stop [rad]
        ("highest", np.float64, JOINTS),  # and one above this
        ("rest_angles", np.float64, JOINTS),  # the posture that spare joints tend to [rad]
        ("first_input", np.int64),  # where the arm's part of the action begins
        ("input_count", np.int64),  # how many numbers it has
        ("scaling", np.float64, (5, JOINTS)),  # of the inputs; see ``controller_inputs``
        ("changes", np.int64),  # what the inputs change: UNKNOWN_CHANGE, JOINT_ANGLES or HAND_POSE
        ("input_speeds", np.float64, JOINTS),  # that a lasting input of 1 leads to [m/s], [rad/s]
    ]
)
"""One arm: its places in the arrays, and its controller's settings."""

GOAL = np.dtype(
    [
        ("position", np.float64, 3),  # of the hand [m]
        ("orientation", np.float64, (3, 3)),
        ("joints", np.float64, JOINTS),  # [rad]
        ("anchor", np.float64, JOINTS),  # where an arm that is held is to stay [rad]
        ("strengths", np.float64, JOINTS),  # share of its commanded torque that a motor delivered
        ("drive_lost", np.float64),  # w of ``arm_brake``
        ("held", np.int64),  # 0, or HELD, BRAKING, YIELDING of ``controllers``
    ]
)
"""The set-point of one arm's controller, changed in place."""

Arms = NDArray[np.void]  # (A,) of ARM
Goals = NDArray[np.void]  # (A,) of GOAL
Arm = Any  # one of them
Goal = Any


def records(count: int, kind: np.dtype[np.void]) -> Any:
    """Return records (count,) of zeros, whose fields are attributes."""
    return np.zeros(count, kind).view(np.recarray)


class Work(NamedTuple):
    """What control computes of one arm, overwritten for the next; letters are those of ``control``."""

    angles: Floats  # (JOINTS,) q
    velocities: Floats  # (JOINTS,) q̇
    mass: Floats  # (JOINTS, JOINTS) M
    bias: Floats  # (JOINTS,) h
    jacobian: Floats  # (6, JOINTS) J of the hand: linear, then angular velocity
    displacement: Floats  # (JOINTS,) of a set-point from the arm
    acceleration: Floats  # (JOINTS,) wanted of the joints
    force: Floats  # (6,) wanted acceleration of the hand, then F
    posture_force: Floats  # (6,) Λ J M⁻¹ p
    torques: Floats  # (JOINTS,) τ
    factor: Floats  # (JOINTS, JOINTS) L, a Cholesky factor
    weighted: Floats  # (JOINTS, JOINTS) J L⁻ᵀ, and below it p L⁻ᵀ
    products: Floats  # (JOINTS, JOINTS) J M⁻¹ Jᵀ, and below it J M⁻¹ p
    rotations: Floats  # (3, 3, 3) frames on the way to a set-point
    twist: Floats  # (6,) of the hand [m/s], [rad/s]
    gained: Floats  # (JOINTS,) speed that the motors are about to add [rad/s]
    ends: Floats  # (2, 3) the nearest points of two geoms [m]
    place: Floats  # (3,) of a point of a link [m]
    momentum: Floats  # (3,) of it [N s]
    inverse_mass: Floats  # (3, 3) a factor of that of a link [1/kg]

    @classmethod
    def empty(cls) -> Work:
        """Return arrays to write into."""
        square = (JOINTS, JOINTS)
        return cls(
            angles=np.zeros(JOINTS),
            velocities=np.zeros(JOINTS),
            mass=np.zeros(square),
            bias=np.zeros(JOINTS),
            jacobian=np.zeros((6, JOINTS)),
            displacement=np.zeros(JOINTS),
            acceleration=np.zeros(JOINTS),
            force=np.zeros(6),
            posture_force=np.zeros(6),
            torques=np.zeros(JOINTS),
            factor=np.zeros(square),
            weighted=np.zeros(square),
            products=np.zeros(square),
            rotations=np.zeros((3, 3, 3)),
            twist=np.zeros(6),
            gained=np.zeros(JOINTS),
            ends=np.zeros((2, 3)),
            place=np.zeros(3),
            momentum=np.zeros(3),
            inverse_mass=np.zeros((3, 3)),
        )


STATUS = np.dtype(
    [
        ("armed", np.int64),  # 1: limits are compared
        ("stops", np.int64),  # 1: the arms stay once a limit is passed
        ("substeps", np.int64),  # since the control step began
        ("passed_after", np.int64),  # so many of them a limit was passed first; 0: none was
        ("braked", np.int64),  # substeps in which an arm was slowed down, added over the arms
    ]
)
"""What became of the limits in a control step."""


MotionLimits = tuple[SpeedLimit, SpeedLimit]  # of hands, and of those beside their own base


NEAR_POINT = np.dtype(
    [
        ("place", np.float64, 3),  # of the link, where it was nearest to something [m]
        ("in_link", np.float64, 3),  # the same in the link's frame
        ("way", np.float64, 3),  # from there to the obstacle, a unit vector
        ("gap", np.float64),  # how far it was [m]
        ("geom", np.int64),  # of the link
        ("obstacle", np.int64),  # a geom
    ]
)
"""Where a link was near an obstacle, when that was looked for last."""


class Ahead(NamedTuple):
    """Where the links of arms are near obstacles; see ``obstacles``. Changed in place."""

    counts: Ints  # (A, MOST_BODIES) how many points of each link are, or ``EVERYWHERE``
    points: Any  # (A, MOST_BODIES, NEAR_POINTS) of NEAR_POINT

    @classmethod
    def everywhere(cls, arms: int) -> Ahead:
        """Return arrays that say of each link that something is near it on all sides."""
        points = np.zeros((arms, MOST_BODIES, NEAR_POINTS), NEAR_POINT)
        return cls(
            counts=np.full((arms, MOST_BODIES), EVERYWHERE, np.int64),
            points=points.view(np.recarray),
        )


class SubstepLimits(NamedTuple):
    """Limits of the arms' load in every substep of a control step; changed in place."""

    load_limits: Floats  # (A, FELT) [N m], [N]; infinite for none
    load_share: (
        Floats  # (1,) the largest share of a limit that was reached since the control step began
    )
    status: Any  # (1,) of STATUS
    speed_limits: Floats  # (A,) of an arm's fastest point, beyond which it is slowed down [m/s]
    motion: MotionLimits
    ahead: Ahead
