"""Where robosuite's arms stand in MuJoCo's arrays, and which controllers run compiled."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.mujoco_views import JOINT_POSITION, JOINTS, OSC_POSE, Arms


def compilable(robot: Any, arm: str) -> bool:
    """Whether ``kernels`` knows the arm's controller."""
    controller = robot.composite_controller.part_controllers[arm]
    if len(robot.arms) > 1 or robot.is_mobile or controller.name not in ("OSC_POSE", "JOINT_POSITION"):
        return False
    if controller.impedance_mode != "fixed" or controller.input_type != "delta" or not controller.lite_physics:
        return False
    if controller.joint_dim > JOINTS:
        return False
    if controller.name == "JOINT_POSITION":
        return controller.interpolator is None
    return bool(
        controller.uncoupling
        and controller._goal_update_mode == "achieved"
        and controller.interpolator_pos is None
        and controller.interpolator_ori is None
        and controller.position_limits is None
        and controller.orientation_limits is None
    )


def describe(parts: list[tuple[Any, str]], model: mujoco.MjModel) -> Arms:
    """One row for each robot and arm of ``parts``; controllers that do not run compiled are left out."""
    n = len(parts)

    def whole(*shape: int) -> NDArray[np.int64]:
        return np.zeros((n, *shape), np.int64)

    arms = Arms(
        joints=whole(),
        qpos=whole(JOINTS),
        dofs=whole(JOINTS),
        motors=whole(JOINTS),
        site=whole(),
        site_body=whole(),
        root=whole(),
        base=whole(),
        wrench=whole(),
        bodies=_padded([bodies(model, robot) for robot, _ in parts]),
        tree=_padded([_carried(model, robot) for robot, _ in parts]),
        kind=whole(),
        kp=np.zeros((n, JOINTS)),
        kd=np.zeros((n, JOINTS)),
        compensate=np.zeros(n, bool),
        rest=np.zeros((n, JOINTS)),
        limits=np.tile([-np.inf, np.inf], (n, JOINTS, 1)),
    )
    for a, (robot, arm) in enumerate(parts):
        _place(arms, a, model, robot, arm)
        if compilable(robot, arm):
            _settings(arms, a, model, robot.composite_controller.part_controllers[arm])
    return arms


def bodies(model: mujoco.MjModel, robot: Any) -> NDArray[np.int64]:
    """The bodies of a robot."""
    root = model.body(robot.robot_model.root_body).id
    return np.flatnonzero(model.body_rootid == root).astype(np.int64)


def _place(arms: Arms, a: int, model: mujoco.MjModel, robot: Any, arm: str) -> None:
    joints = slice(len(robot._ref_joint_pos_indexes))
    arms.joints[a] = joints.stop
    arms.qpos[a, joints] = robot._ref_joint_pos_indexes
    arms.dofs[a, joints] = robot._ref_joint_vel_indexes
    arms.motors[a, joints] = robot._ref_actuators_indexes_dict[arm]
    arms.site[a] = robot.eef_site_id[arm]
    arms.site_body[a] = model.site_bodyid[arms.site[a]]
    arms.root[a] = model.body_rootid[arms.site_body[a]]
    sensors = robot.gripper[arm].important_sensors
    force, torque = (model.sensor(sensors[k]).adr[0] for k in ("force_ee", "torque_ee"))
    if torque != force + 3:
        raise RuntimeError("the wrist's force and torque sensors are expected side by side")
    arms.wrench[a] = force


def _settings(arms: Arms, a: int, model: mujoco.MjModel, controller: Any) -> None:
    joints = slice(arms.joints[a])
    gains = slice(len(controller.kp))
    arms.kp[a, gains], arms.kd[a, gains] = controller.kp, controller.kd
    if controller.name == "OSC_POSE":
        arms.kind[a] = OSC_POSE
        arms.rest[a, joints] = controller.initial_joint
        base = f"{controller.naming_prefix}{controller.part_name}_center"
        arms.base[a] = model.site(base).id if controller.input_ref_frame == "base" else -1
    else:
        arms.kind[a] = JOINT_POSITION
        arms.compensate[a] = controller.use_torque_compensation
        if controller.position_limits is not None:
            arms.limits[a, joints] = np.transpose(controller.position_limits)


def _carried(model: mujoco.MjModel, robot: Any) -> NDArray[np.int64]:
    """The dofs of the arm and of everything it carries for good."""
    first = min(robot._ref_joint_vel_indexes)
    found = []
    for dof in range(model.nv):
        j = dof
        while j > first:
            j = model.dof_parentid[j]
        if j == first:
            found.append(dof)
    return np.array(found, np.int64)


def _padded(rows: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    out = np.full((len(rows), max(map(len, rows)) + 1), -1, np.int64)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = values
    return out
