"""The arms of a loaded model: their places in MuJoCo's arrays, their controllers, grippers and kinematic chains."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from asm_gym.detection.kinematics import Chain
from asm_gym.envs.controller_inputs import scaling_of
from asm_gym.envs.mujoco_views import (
    ARM,
    HAND_POSE,
    JOINT_ANGLES,
    JOINT_POSITION,
    OSC_POSE,
    Arm,
    Floats,
    Ints,
    records,
)

PHYSICS_FREQ = 500  # robosuite's physics rate [Hz]
AT_STOP = 0.01  # a joint so near to the end of its range is at its stop [rad]
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
    return controller_of(part).name in CHANGES


def describe(parts: list[Part], model: mujoco.MjModel) -> Any:
    """Return one record for each arm; the settings of controllers that do not run compiled stay 0."""
    arms = records(len(parts), ARM)
    for arm, part in zip(arms, parts, strict=True):
        _fill_places(arm, model, part)
        if is_compilable(part):
            _fill_settings(arm, model, controller_of(part))
    return arms


def describe_inputs(arm: Arm, model: mujoco.MjModel, controller: Any, part: slice) -> None:
    """Write what the inputs of an arm are, where they tell how fast its hand will go.

    They are ``part`` of an action.
    """
    if controller.name not in SLOWED:
        return
    size = part.stop - part.start
    arm.first_input = part.start
    arm.input_count = size
    arm.scaling[:, :size] = scaling_of(controller, size)
    # A controller asked for a change again and again reaches a velocity of Kp/Kd times the change.
    gains = controller.kp / controller.kd
    arm.input_speeds[:size] = gains[:size] * unit_change(controller)
    if controller.name == "JOINT_POSITION":
        arm.changes = JOINT_ANGLES
    else:
        arm.changes = HAND_POSE
        arm.frame = _base_site(model, controller)


def _fill_places(arm: Arm, model: mujoco.MjModel, part: Part) -> None:
    """Write where in MuJoCo's arrays an arm's joints, motors, bodies, site and sensors are."""
    robot, name = part
    joints = len(robot._ref_joint_pos_indexes)
    arm.joint_count = joints
    arm.qpos[:joints] = robot._ref_joint_pos_indexes
    arm.dofs[:joints] = robot._ref_joint_vel_indexes
    arm.motors[:joints] = robot._ref_actuators_indexes_dict[name]
    arm.gears[:joints] = model.actuator_gear[arm.motors[:joints], 0]
    arm.lowest[:joints], arm.highest[:joints] = free_angles(model, robot._ref_joint_indexes)
    arm.site = robot.eef_site_id[name]
    arm.site_body = model.site_bodyid[arm.site]
    arm.root = model.body_rootid[arm.site_body]

    # What is fixed to the world belongs to it.
    own = bodies(model, robot)
    hand = model.body(robot.robot_model.eef_name[name]).id
    _fill(arm.bodies, own[model.body_weldid[own] != 0])
    links = _links(model, hand)
    _fill(arm.links, links)
    _fill(arm.link_joints, _joints_that_move(model, links, arm.dofs[:joints]))
    _fill(arm.tree_dofs, _carried_dofs(model, robot))

    sensors = robot.gripper[name].important_sensors
    arm.wrench = model.sensor(sensors["force_ee"]).adr[0]  # the torque sensor follows


def _fill(row: Ints, values: Ints) -> None:
    """Write values into a row, and -1 after them."""
    row[:] = -1
    row[: len(values)] = values


def _fill_settings(arm: Arm, model: mujoco.MjModel, controller: Any) -> None:
    """Write the settings of a controller that runs compiled."""
    gains = len(controller.kp)
    arm.kp[:gains] = controller.kp
    arm.kd[:gains] = controller.kd
    if controller.name == "OSC_POSE":
        arm.controller = OSC_POSE
        arm.rest_angles[: arm.joint_count] = controller.initial_joint
        arm.frame = _base_site(model, controller)
    else:
        arm.controller = JOINT_POSITION


def joint_ranges(model: mujoco.MjModel, joints: Any) -> Floats:
    """Return (J, 2) the least and the greatest angle of each joint [rad]; infinite without stops."""
    limited = model.jnt_limited[joints].astype(bool)[:, None]
    return np.where(limited, model.jnt_range[joints], (-np.inf, np.inf))


def free_angles(model: mujoco.MjModel, joints: Any) -> tuple[Floats, Floats]:
    """Return the least and the greatest angle of each joint at which it is not at a stop [rad]."""
    ranges = joint_ranges(model, joints)
    return ranges[:, 0] + AT_STOP, ranges[:, 1] - AT_STOP


def _base_site(model: mujoco.MjModel, controller: Any) -> int:
    """Return the site that actions of operational space control are relative to, at the arm's base."""
    return int(model.site(f"{controller.naming_prefix}{controller.part_name}_center").id)


def bodies(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the bodies of a robot."""
    root = model.body(robot.robot_model.root_body).id
    return np.flatnonzero(model.body_rootid == root)


def _links(model: mujoco.MjModel, hand: int) -> Ints:
    """Return the bodies from a hand to what is fixed to the world."""
    links = [hand]
    parent = int(model.body_parentid[hand])
    while model.body_weldid[parent] != 0:
        links.append(parent)
        parent = int(model.body_parentid[parent])
    return np.array(links, np.int64)


def _joints_that_move(model: mujoco.MjModel, links: Ints, dofs: Ints) -> Ints:
    """Return how many of an arm's joints, of degrees of freedom ``dofs``, move each of its links."""
    counts = np.zeros(len(links), np.int64)
    for dof in dofs:
        first = np.flatnonzero(links == model.dof_bodyid[dof])[0]
        counts[: first + 1] += 1
    return counts


def _carried_dofs(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the dofs of the robot and of everything fixed to it: MuJoCo numbers each tree of bodies that move."""
    first = robot._ref_joint_vel_indexes[0]
    return np.flatnonzero(model.dof_treeid == model.dof_treeid[first])


def chains_of(parts: list[Part], model: mujoco.MjModel, noise: float) -> tuple[Chain, ...]:
    """Return the kinematic chain of each arm, with sensors of ``noise``."""
    data = mujoco.MjData(model)
    for robot, _ in parts:
        data.qpos[robot._ref_joint_pos_indexes] = 0.0
    mujoco.mj_kinematics(model, data)

    chains = []
    for i, (robot, arm) in enumerate(parts):
        joints = np.asarray(robot._ref_joint_indexes)
        hand = model.body(robot.robot_model.eef_name[arm]).id
        fingers = data.site_xpos[robot.eef_site_id[arm]]
        turn = data.xmat[hand].reshape(3, 3)
        chain = Chain(
            prefix=prefix_of(i, len(parts)),
            axes=data.xaxis[joints].copy(),
            anchors=data.xanchor[joints].copy(),
            hand=np.stack([fingers, turn[:, 0], turn[:, 1]]),
            # The last substep has moved the joints, and not yet sites and bodies.
            late_s=1.0 / PHYSICS_FREQ,
            noise=max(noise, 1.0),
        )
        chains.append(chain)
    return tuple(chains)


def prefix_of(number: int, robots: int) -> str:
    """Return what begins the names of a robot's channels, where there are several."""
    if robots > 1:
        return f"robot{number}_"
    return ""
