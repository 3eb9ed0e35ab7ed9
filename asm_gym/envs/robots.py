"""The robots of a loaded model: arms, controllers, kinematic chains, grippers, and their nominal dynamics."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from asm_gym.detection.kinematics import Chain
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.mujoco_views import JOINT_POSITION, JOINTS, OSC_POSE, Arms, Ints, NominalViews, Views
from asm_gym.tasks import ROBOTS, TaskSpec
from asm_gym.validation import check_choice, check_text, short_repr

PHYSICS_FREQ = 500  # robosuite's physics rate [Hz]
CHANGES = ("OSC_POSE", "JOINT_POSITION")  # controllers whose actions are changes of the arm's pose
SLOWED = (*CHANGES, "OSC_POSITION")  # controllers whose actions tell how fast the hand will go
Part = tuple[Any, str]  # one of robosuite's robots, and the name of one of its arms


def robots_for(task: TaskSpec, robot: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return one robot for each of the task's arms; one name stands for all. Raise ValueError for any others."""
    if robot is not None and not isinstance(robot, Sequence):
        raise ValueError(f"robot must be a name or a sequence of names, got {short_repr(robot)}")
    names = (robot or "Panda",) * task.arms if robot is None or isinstance(robot, str) else tuple(robot)
    for name in names:
        check_choice("robot", check_text("robot", name), ROBOTS)
    if len(names) != task.arms:
        raise ValueError(f"{task.name} takes {task.arms} robot{'s' * (task.arms > 1)}, got {', '.join(names)}")
    return names


def free_first_joints(env: Any) -> None:
    """Let every Sawyer turn in its base, once a model is loaded.

    Robosuite's Sawyer touches its own base with its shoulder, to within rounding (1e-16 m): where that makes a contact,
    which depends on the pose, its friction holds the first joint against 20 N m and more.
    """
    model = env.sim.model
    for robot in env.robots:
        if robot.name == "Sawyer":
            shoulder = model.geom_name2id(f"{robot.robot_model.naming_prefix}link0_collision")
            model.geom_contype[shoulder] = model.geom_conaffinity[shoulder] = 0


def gripper_actions(robots: list[Any]) -> tuple[int, ...]:
    """Return the indices of an action that command grippers."""
    found, start = list[int](), 0
    for robot in robots:
        for part, (low, high) in robot._action_split_indexes.items():
            found += range(start + low, start + high) if "gripper" in part else ()
        start += robot.action_dim
    return tuple(found)


def is_compilable(robot: Any, arm: str) -> bool:
    """Whether the compiled loop implements the arm's controller, which has robosuite's own settings."""
    controller = robot.composite_controller.part_controllers[arm]
    known = controller.name in CHANGES and controller.joint_dim <= JOINTS
    return known and len(robot.arms) == 1 and not robot.is_mobile


def describe(parts: list[Part], model: mujoco.MjModel) -> Arms:
    """Return one row for each arm; the settings of controllers that do not run compiled stay 0."""
    n = len(parts)
    indices = ("joints", "site", "site_body", "root", "base", "wrench", "kind", "first", "inputs")
    fields: dict[str, Any] = {name: np.zeros(n, np.int64) for name in indices}
    fields |= {name: np.zeros((n, JOINTS), np.int64) for name in ("qpos", "dofs", "motors")}
    fields |= {name: np.zeros((n, JOINTS)) for name in ("kp", "kd", "rest")}
    arms = Arms(
        bodies=_padded([own[model.body_weldid[own] != 0] for own in (bodies(model, robot) for robot, _ in parts)]),
        links=_padded([_links(model, model.body(r.robot_model.eef_name[arm]).id) for r, arm in parts]),
        tree=_padded([_carried_dofs(model, robot) for robot, _ in parts]),
        compensate=np.zeros(n, bool),
        limits=np.tile([-np.inf, np.inf], (n, JOINTS, 1)),
        scaling=np.zeros((n, 5, JOINTS)),
        **fields,
    )
    for a, (robot, arm) in enumerate(parts):
        joints = slice(len(robot._ref_joint_pos_indexes))
        arms.joints[a] = joints.stop
        arms.qpos[a, joints] = robot._ref_joint_pos_indexes
        arms.dofs[a, joints] = robot._ref_joint_vel_indexes
        arms.motors[a, joints] = robot._ref_actuators_indexes_dict[arm]
        arms.site[a] = robot.eef_site_id[arm]
        arms.site_body[a] = model.site_bodyid[arms.site[a]]
        arms.root[a] = model.body_rootid[arms.site_body[a]]
        sensors = robot.gripper[arm].important_sensors
        arms.wrench[a], torque = (model.sensor(sensors[k]).adr[0] for k in ("force_ee", "torque_ee"))
        if torque != arms.wrench[a] + 3:
            raise RuntimeError("the wrist's force and torque sensors are expected side by side")
        if is_compilable(robot, arm):
            _fill_settings(arms, a, model, robot.composite_controller.part_controllers[arm])
    return arms


def bodies(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the bodies of a robot."""
    root = model.body(robot.robot_model.root_body).id
    return np.flatnonzero(model.body_rootid == root).astype(np.int64)


def _links(model: mujoco.MjModel, hand: int) -> Ints:
    """Return the bodies from a hand to what is fixed to the world."""
    found = [hand]
    while model.body_weldid[model.body_parentid[found[-1]]] != 0:
        found.append(int(model.body_parentid[found[-1]]))
    return np.array(found, np.int64)


def _fill_settings(arms: Arms, a: int, model: mujoco.MjModel, controller: Any) -> None:
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


def _carried_dofs(model: mujoco.MjModel, robot: Any) -> Ints:
    """Return the dofs of the robot and of everything fixed to it: MuJoCo numbers each tree of bodies that move."""
    return np.flatnonzero(model.dof_treeid == model.dof_treeid[robot._ref_joint_vel_indexes[0]]).astype(np.int64)


def _padded(rows: list[Ints]) -> Ints:
    out = np.full((len(rows), max(map(len, rows)) + 1), -1, np.int64)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = values
    return out


def chains_of(parts: list[Part], model: mujoco.MjModel, noise: float) -> tuple[Chain, ...]:
    """Return the kinematic chain of each arm, with sensors of ``noise``; an arm on a moving base has none."""
    data, found = mujoco.MjData(model), []
    for robot, _ in parts:
        data.qpos[robot._ref_joint_pos_indexes] = 0.0
    mujoco.mj_kinematics(model, data)
    for i, (robot, arm) in enumerate(parts):
        joints = np.asarray(robot._ref_joint_indexes)
        body = model.body(robot.robot_model.eef_name[arm]).id
        turns = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)
        between = np.flatnonzero(np.isin(model.jnt_bodyid, _links(model, body)))  # joints from world to hand
        if set(between.tolist()) != set(joints.tolist()) or not turns.all():
            continue
        turn = data.xmat[body].reshape(3, 3)
        hand = np.stack([data.site_xpos[robot.eef_site_id[arm]], turn[:, 0], turn[:, 1]])
        prefix = f"robot{i}_" if len(parts) > 1 else ""
        # Sites and bodies are where they were before the last substep moved the joints.
        late = 1.0 / PHYSICS_FREQ
        found.append(Chain(prefix, data.xaxis[joints].copy(), data.xanchor[joints].copy(), hand, late, max(noise, 1.0)))
    return tuple(found)


class NominalDynamics:
    """The robot's own model of its dynamics, frozen when the model was loaded.

    Whoever edits masses in the live model edits the world, and not the knowledge of the robots of bodies (R,).
    """

    _INERTIA = ("body_mass", "body_inertia", "body_ipos", "body_iquat")

    def __init__(self, model: mujoco.MjModel, views: Views, robots: Ints) -> None:
        self._model, self._robots = model, robots
        self._live = tuple(getattr(model, name).reshape(model.nbody, -1) for name in self._INERTIA)
        self._frozen = tuple(live.copy() for live in self._live)
        v = views
        self.unedited = NominalViews(0, 0, v.qpos, v.qvel, v.M, v.qfrc_bias, 0, v.dof_damping.copy())
        """Views of the live model, valid while the robots' masses are as they were loaded."""
        self._copy: tuple[mujoco.MjModel, mujoco.MjData, NominalViews] | None = None

    def now(self) -> NominalViews:
        """Return views of the live model, or of a copy once somebody has edited the robots' masses."""
        if not kernels.edited(self._live, self._frozen, self._robots):
            return self.unedited
        if self._copy is None:
            model = copy.copy(self._model)
            for name, frozen in zip(self._INERTIA, self._frozen, strict=True):
                getattr(model, name)[:] = frozen.reshape(getattr(model, name).shape)
            data = mujoco.MjData(model)
            addresses, motion = (model._address, data._address), (data.qpos, data.qvel, data.M)
            bias = np.zeros(model.nv)
            nominal = NominalViews(*addresses, *motion, bias, bias.ctypes.data, self.unedited.damping)
            self._copy = model, data, nominal
        return self._copy[2]
