"""The arms of a loaded model: their places in MuJoCo's arrays, their controllers, grippers and kinematic chains."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from asm_gym.detection.kinematics import Chain
from asm_gym.envs.commands import scaling_of
from asm_gym.envs.mujoco_views import (
    HAND_POSE,
    JOINT_ANGLES,
    JOINT_POSITION,
    JOINTS,
    OSC_POSE,
    Arms,
    Floats,
    Ints,
)

PHYSICS_FREQ = 500  # robosuite's physics rate [Hz]
CHANGES = ("OSC_POSE", "JOINT_POSITION")  # controllers whose actions are changes of the arm's pose
SLOWED = (*CHANGES, "OSC_POSITION")  # controllers whose actions tell how fast the hand will go
Part = tuple[Any, str]  # one of robosuite's robots, and the name of one of its arms


def gripper_actions(robots: list[Any]) -> tuple[int, ...]:
    """Return the indices of an action that command grippers."""
    indices: list[int] = []
    start = 0
    for robot in robots:
        for part, (low, high) in robot._action_split_indexes.items():
            if "gripper" in part:
                indices += range(start + low, start + high)
        start += robot.action_dim
    return tuple(indices)


def controller_of(part: Part) -> Any:
    """Return robosuite's controller of an arm."""
    robot, arm = part
    return robot.composite_controller.part_controllers[arm]


def unit_change(controller: Any) -> Floats:
    """Return (inputs,) the change of the arm's pose that a unit of each input asks for [m], [rad]."""
    return (controller.output_max - controller.output_min) / 2


def is_compilable(part: Part) -> bool:
    """Whether the compiled loop implements the arm's controller, which has robosuite's own settings."""
    robot = part[0]
    controller = controller_of(part)
    if controller.name not in CHANGES or controller.joint_dim > JOINTS:
        return False
    return len(robot.arms) == 1 and not robot.is_mobile


def describe(parts: list[Part], model: mujoco.MjModel) -> Arms:
    """Return one row for each arm; the settings of controllers that do not run compiled stay 0."""
    arms = _unset(parts, model)
    for a, part in enumerate(parts):
        _fill_indices(arms, a, model, part)
        if is_compilable(part):
            _fill_settings(arms, a, model, controller_of(part))
    return arms


def describe_inputs(
    arms: Arms, a: int, model: mujoco.MjModel, controller: Any, part: slice
) -> None:
    """Write what the inputs of arm ``a`` are, where they tell how fast its hand will go; ``part`` of an action."""
    size = part.stop - part.start
    if controller.name not in SLOWED or size > JOINTS:
        return
    arms.first[a] = part.start
    arms.inputs[a] = size
    arms.scaling[a, :, :size] = scaling_of(controller, size)
    if controller.input_type != "delta":
        return

    # A controller that is asked for a change again and again comes to the velocity Kp/Kd times the change.
    gains = controller.kp / controller.kd
    arms.speeds[a, :size] = gains[:size] * unit_change(controller)
    if controller.name == "JOINT_POSITION":
        arms.changes[a] = JOINT_ANGLES
    else:
        arms.changes[a] = HAND_POSE
        arms.base[a] = _base_site(model, controller)


def _unset(parts: list[Part], model: mujoco.MjModel) -> Arms:
    """Return the rows of arms of which nothing but the bodies is filled in."""
    count = len(parts)
    moving: list[Ints] = []  # bodies of the robots, less what is fixed to the world
    links: list[Ints] = []
    trees: list[Ints] = []
    for robot, arm in parts:
        own = bodies(model, robot)
        moving.append(own[model.body_weldid[own] != 0])
        links.append(_links(model, model.body(robot.robot_model.eef_name[arm]).id))
        trees.append(_carried_dofs(model, robot))

    indices = (
        "joints",
        "site",
        "site_body",
        "root",
        "base",
        "wrench",
        "kind",
        "first",
        "inputs",
        "changes",
    )
    fields: dict[str, Any] = {name: np.zeros(count, np.int64) for name in indices}
    fields |= {name: np.zeros((count, JOINTS), np.int64) for name in ("qpos", "dofs", "motors")}
    fields |= {name: np.zeros((count, JOINTS)) for name in ("kp", "kd", "rest", "speeds")}
    return Arms(
        bodies=_padded(moving),
        links=_padded(links),
        tree=_padded(trees),
        compensate=np.zeros(count, bool),
        limits=np.tile([-np.inf, np.inf], (count, JOINTS, 1)),
        scaling=np.zeros((count, 5, JOINTS)),
        **fields,
    )


def _fill_indices(arms: Arms, a: int, model: mujoco.MjModel, part: Part) -> None:
    """Write where in MuJoCo's arrays the joints, motors, site and sensors of arm ``a`` are."""
    robot, arm = part
    joints = slice(len(robot._ref_joint_pos_indexes))
    arms.joints[a] = joints.stop
    arms.qpos[a, joints] = robot._ref_joint_pos_indexes
    arms.dofs[a, joints] = robot._ref_joint_vel_indexes
    arms.motors[a, joints] = robot._ref_actuators_indexes_dict[arm]
    arms.site[a] = robot.eef_site_id[arm]
    arms.site_body[a] = model.site_bodyid[arms.site[a]]
    arms.root[a] = model.body_rootid[arms.site_body[a]]

    sensors = robot.gripper[arm].important_sensors
    arms.wrench[a] = model.sensor(sensors["force_ee"]).adr[0]
    if model.sensor(sensors["torque_ee"]).adr[0] != arms.wrench[a] + 3:
        raise RuntimeError("the wrist's force and torque sensors are expected side by side")


def _fill_settings(arms: Arms, a: int, model: mujoco.MjModel, controller: Any) -> None:
    """Write the settings of a controller that runs compiled."""
    joints = slice(arms.joints[a])
    gains = slice(len(controller.kp))
    arms.kp[a, gains] = controller.kp
    arms.kd[a, gains] = controller.kd
    if controller.name == "OSC_POSE":
        arms.kind[a] = OSC_POSE
        arms.rest[a, joints] = controller.initial_joint
        arms.base[a] = _base_site(model, controller)
    else:
        arms.kind[a] = JOINT_POSITION
        arms.compensate[a] = controller.use_torque_compensation
        if controller.position_limits is not None:
            arms.limits[a, joints] = np.transpose(controller.position_limits)


def _base_site(model: mujoco.MjModel, controller: Any) -> int:
    """Return the site that actions of operational space control are relative to; -1 for the world."""
    if controller.input_ref_frame != "base":
        return -1
    return int(model.site(f"{controller.naming_prefix}{controller.part_name}_center").id)


def bodies(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the bodies of a robot."""
    root = model.body(robot.robot_model.root_body).id
    return np.flatnonzero(model.body_rootid == root).astype(np.int64)


def _links(model: mujoco.MjModel, hand: int) -> Ints:
    """Return the bodies from a hand to what is fixed to the world."""
    links = [hand]
    parent = int(model.body_parentid[hand])
    while model.body_weldid[parent] != 0:
        links.append(parent)
        parent = int(model.body_parentid[parent])
    return np.array(links, np.int64)


def _carried_dofs(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the dofs of the robot and of everything fixed to it: MuJoCo numbers each tree of bodies that move."""
    first = robot._ref_joint_vel_indexes[0]
    return np.flatnonzero(model.dof_treeid == model.dof_treeid[first]).astype(np.int64)


def _padded(rows: list[Ints]) -> Ints:
    """Return rows of different lengths in one array, each followed by -1 at least once."""
    padded = np.full((len(rows), max(map(len, rows)) + 1), -1, np.int64)
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded


def chains_of(parts: list[Part], model: mujoco.MjModel, noise: float) -> tuple[Chain, ...]:
    """Return the kinematic chain of each arm, with sensors of ``noise``; an arm on a moving base has none."""
    data = mujoco.MjData(model)
    for robot, _ in parts:
        data.qpos[robot._ref_joint_pos_indexes] = 0.0
    mujoco.mj_kinematics(model, data)

    chains = []
    for i, (robot, arm) in enumerate(parts):
        joints = np.asarray(robot._ref_joint_indexes)
        body = model.body(robot.robot_model.eef_name[arm]).id
        if not _is_chain(model, joints, body):
            continue
        prefix = ""
        if len(parts) > 1:
            prefix = f"robot{i}_"
        place = data.site_xpos[robot.eef_site_id[arm]]
        turn = data.xmat[body].reshape(3, 3)
        chains.append(
            Chain(
                prefix=prefix,
                axes=data.xaxis[joints].copy(),
                anchors=data.xanchor[joints].copy(),
                hand=np.stack([place, turn[:, 0], turn[:, 1]]),
                late_s=1.0
                / PHYSICS_FREQ,  # the last substep has moved the joints, and not yet sites and bodies
                noise=max(noise, 1.0),
            )
        )
    return tuple(chains)


def _is_chain(model: mujoco.MjModel, joints: Ints, hand: int) -> bool:
    """Whether the joints all turn, and nothing else moves between the world and the hand."""
    between = np.flatnonzero(np.isin(model.jnt_bodyid, _links(model, hand)))
    turns = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)
    return set(between.tolist()) == set(joints.tolist()) and bool(turns.all())
