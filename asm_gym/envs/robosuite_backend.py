"""Robosuite underneath: imported quietly, built for a task, and seeded where it does not seed itself."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from functools import lru_cache
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import somewhere
from asm_gym.envs.arms import PHYSICS_FREQ
from asm_gym.envs.compiled_substeps import touching
from asm_gym.envs.mujoco_views import Floats
from asm_gym.envs.robots import ROBOTS, robot_named
from asm_gym.extras import require
from asm_gym.spec import Channel
from asm_gym.tasks import TaskSpec
from asm_gym.validation import check_choice, check_number, check_text

CONTROLLERS = ("OSC_POSE", "OSC_POSITION", "JOINT_POSITION", "JOINT_TORQUE", "IK_POSE")
"""Robosuite's controllers of an arm, less JOINT_VELOCITY, which fails inside robosuite 1.5."""

_POSITIONS = {int(mujoco.mjtJoint.mjJNT_FREE): 7, int(mujoco.mjtJoint.mjJNT_BALL): 4}
_VELOCITIES = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}
"""Numbers of a joint that has several, by its type."""

# Tasks that choose one of several objects an episode: attributes with the objects and the choice.
_CHOSEN = {"PickPlaceSingle": ("objects", "object_id"), "NutAssemblySingle": ("nuts", "nut_id")}


def import_robosuite() -> Any:
    """Return robosuite, without the warnings it prints at import about optional parts."""
    logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)
    with suppress(ImportError):
        import cv2  # noqa: F401
    no_viewer = "cv2" not in sys.modules
    if no_viewer:  # for want of libGL: only robosuite's own viewer would use it
        sys.modules["cv2"] = ModuleType("cv2")
    try:
        robosuite = somewhere(_required)
    finally:
        if no_viewer:
            del sys.modules["cv2"]
    _fit_to_mujoco()
    _compile_less()
    return robosuite


def _required() -> Any:
    # Parts that an import which failed has left are no attributes of a new one.
    if "robosuite" not in sys.modules:
        for name in tuple(sys.modules):
            if name.startswith("robosuite."):
                del sys.modules[name]
    return require("robosuite", what="a robosuite environment")


def _fit_to_mujoco() -> None:
    """Adapt robosuite 1.5.2 to every MuJoCo from 3.4 to 4.0.

    - 3.10 changed the arguments of ``mj_fullM``, and 3.11 removed ``qM``.
    - From 3.12 on an integer is not ``in`` a tuple of enum members: ``get_joint_qpos_addr`` and
      ``get_joint_qvel_addr`` then fail in their assertion about the joint's type.

    3.12 also moves contacts of overlapping meshes: see ``robots.iiwa.touch_at_one_point``.
    """
    from robosuite.controllers.parts import controller
    from robosuite.utils.binding_utils import MjData, MjModel

    MjData.qM = property(lambda data: data._data.M)
    controller.mujoco = SimpleNamespace(mj_fullM=_whole_mass_matrix)
    MjModel.get_joint_qpos_addr = _position_address
    MjModel.get_joint_qvel_addr = _velocity_address


def _whole_mass_matrix(model: mujoco.MjModel, whole: Floats, triangle: Floats) -> None:
    rows = np.repeat(np.arange(model.nv), model.M_rownnz)
    columns = model.M_colind
    whole[:] = 0.0
    whole[rows, columns] = triangle
    whole[columns, rows] = triangle


def _position_address(model: Any, name: str) -> Any:
    joint = model.joint_name2id(name)
    return _address(model.jnt_qposadr[joint], model.jnt_type[joint], _POSITIONS)


def _velocity_address(model: Any, name: str) -> Any:
    joint = model.joint_name2id(name)
    return _address(model.jnt_dofadr[joint], model.jnt_type[joint], _VELOCITIES)


def _address(first: Any, joint_type: Any, sizes: dict[int, int]) -> Any:
    """Return where a joint's number lies, or first and end where it has several."""
    size = sizes.get(int(joint_type), 1)
    if size == 1:
        return first
    return first, first + size


def _compile_less() -> None:
    """Leave uncompiled what takes seconds to compile, for an observable of robosuite's robots that nothing reads."""
    from robosuite.robots import robot
    from robosuite.utils import transform_utils

    mat2quat = getattr(transform_utils.mat2quat, "py_func", transform_utils.mat2quat)
    robot.T = SimpleNamespace(**{**vars(transform_utils), "mat2quat": mat2quat})


def row_substeps(rate: int | None, control_freq: int) -> int:
    """Return the physics substeps between two rows at ``rate``, by default that of control [Hz].

    Raises ValueError, listing the rates that fit.
    """
    if rate is None:
        rate = control_freq
    check_number("stream_freq", rate, low=1, whole=True)
    rates = range(control_freq, PHYSICS_FREQ + 1, control_freq)
    possible = [f for f in rates if PHYSICS_FREQ % f == 0]
    if rate not in possible:
        raise ValueError(
            f"stream_freq must divide the physics rate of {PHYSICS_FREQ} Hz and be a multiple of "
            f"the control rate of {control_freq} Hz, one of {', '.join(map(str, possible))}, "
            f"got {rate}"
        )
    return PHYSICS_FREQ // rate


def make(
    task: TaskSpec,
    robots: tuple[str, ...],
    controller: str,
    control_freq: int,
    reward_shaping: bool,
) -> Any:
    """Return robosuite's environment; raise ValueError for a controller that is unknown or does not fit the robot."""
    robosuite = import_robosuite()
    check_choice("controller", check_text("controller", controller), CONTROLLERS)
    if controller == "IK_POSE":
        _check_inverse_kinematics(robots)
    configurations = None  # robosuite's own: OSC_POSE
    if controller != "OSC_POSE":
        configurations = [_configuration(controller, robot) for robot in robots]
    has_dense_reward = task.name != "TwoArmTransport"
    return robosuite.make(
        task.name,
        robots=list(robots),
        controller_configs=configurations,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=control_freq,
        reward_shaping=reward_shaping and has_dense_reward,
        ignore_done=True,
    )


def _check_inverse_kinematics(robots: tuple[str, ...]) -> None:
    for name in robots:
        if not robot_named(name).has_inverse_kinematics:
            known = [robot.name for robot in ROBOTS.values() if robot.has_inverse_kinematics]
            raise ValueError(f"IK_POSE is for {', '.join(known)}, and not for {name}")


def _configuration(controller: str, robot: str) -> dict[str, Any]:
    from robosuite.controllers import load_part_controller_config
    from robosuite.controllers.composite.composite_controller_factory import (
        refactor_composite_controller_config,
    )

    part = load_part_controller_config(default_controller=controller)
    return refactor_composite_controller_config(part, robot, ["right"])


def reseed(env: Any, rng: np.random.Generator) -> None:
    """Seeds the generator that all of robosuite's randomness comes from."""
    # In place: placement samplers hold the generator itself.
    env.rng.bit_generator.state = np.random.default_rng(rng.integers(2**63)).bit_generator.state


def choose_object(env: Any, task: TaskSpec) -> None:
    """Draw the object of the next episode, where the task has a choice.

    Robosuite would draw from the order of a set of strings, which differs from process to process.
    """
    if task.name in _CHOSEN:
        candidates, chosen = _CHOSEN[task.name]
        env.single_object_mode = 2  # "the object that is named", where 1 is "draw one"
        setattr(env, chosen, int(env.rng.integers(len(getattr(env, candidates)))))


def speed_up_contacts(env: Any) -> None:
    """Replace the methods of robosuite on which rewards rest, for the loaded model.

    Robosuite puts the names of geoms together at every call, and looks up two for each contact and pair of groups;
    these compare ids in one pass.
    """
    contacts = Contacts(env)
    env.check_contact = contacts.check_contact
    env._check_grasp = contacts.check_grasp
    env._gripper_to_target = contacts.gripper_to_target


class Contacts:
    """Tells what touches in the loaded model, and how far a gripper is from its target, as robosuite does."""

    def __init__(self, env: Any) -> None:
        self._data = env.sim.data._data
        self._ids = {name: env.sim.model.geom_name2id(name) for name in env.sim.model.geom_names}
        self._everything = np.ones(env.sim.model.ngeom, bool)
        self._members = lru_cache(self._find_members)
        self._pads = lru_cache(_find_pads)
        self._grip_site = lru_cache(self._find_grip_site)
        self._place = lru_cache(self._find_place)

    def check_contact(self, geoms_1: Any, geoms_2: Any = None) -> bool:
        """Whether any geom of one group touches any of the other; of anything where there is no other."""
        other = self._everything
        if geoms_2 is not None:
            other = self._mask(geoms_2)
        return touching(self._data.contact.geom, self._mask(geoms_1), other)

    def check_grasp(self, gripper: Any, object_geoms: Any) -> bool:
        """Whether the pads on both sides of a gripper, or of any of several, touch an object."""
        if isinstance(gripper, dict):
            return any(self.check_grasp(each, object_geoms) for each in gripper.values())
        return all(self.check_contact(pad, object_geoms) for pad in self._pads(gripper))

    def gripper_to_target(
        self, gripper: Any, target: Any, target_type: str = "body", return_distance: bool = False
    ) -> Any:
        """Way from a gripper, or from the nearest of several, to a target; or its length."""
        place = self._place(target, target_type)
        if isinstance(gripper, dict):
            ways = [place - self._grip_site(each) for each in gripper.values()]
            way = min(ways, key=np.linalg.norm)
        else:
            way = place - self._grip_site(gripper)
        if return_distance:
            return np.sqrt(way.dot(way))  # as NumPy's norm does it
        return way

    def _mask(self, geoms: Any) -> NDArray[np.bool_]:
        if isinstance(geoms, list):
            geoms = tuple(geoms)
        return self._members(geoms)

    def _find_members(self, group: Any) -> NDArray[np.bool_]:
        names = getattr(group, "contact_geoms", group)  # of a model
        if isinstance(names, str):
            names = (names,)
        mask = np.zeros(len(self._everything), bool)
        mask[[self._ids[name] for name in names if name in self._ids]] = True
        return mask

    def _find_grip_site(self, gripper: Any) -> Floats:
        return np.asarray(self._data.site(gripper.important_sites["grip_site"]).xpos)

    def _find_place(self, target: Any, kind: str) -> Floats:
        if hasattr(target, "root_body"):  # a model
            return np.asarray(self._data.body(target.root_body).xpos)
        return np.asarray(getattr(self._data, kind)(target).xpos)


def _find_pads(gripper: Any) -> tuple[tuple[str, ...], ...]:
    geoms = gripper.important_geoms
    return tuple(geoms["left_fingerpad"]), tuple(geoms["right_fingerpad"])


class _NotedDict(dict[str, Any]):
    """A dict that notes the names whose values were read."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.names.add(name)
        return super().__getitem__(name)


class ObjectSensors:
    """Poses of the task's objects, as robosuite's own observables give them.

    Where the task chooses one of several objects, every one has its channels, and those out of play read 0.
    """

    def __init__(self, env: Any, task: TaskSpec) -> None:
        observables = env._observables
        # Others compute from these: poses of hands, and of the world in a hand's frame.
        hidden = [name for name in observables if name.startswith("world_pose_in")]
        hands: list[str] = []
        for i in range(len(env.robots)):
            hands += [f"robot{i}_eef_pos", f"robot{i}_eef_quat"]
        self._observables = _poses_shown(observables, task)

        channels: list[Channel] = []
        self._rest: list[Floats] = []  # of objects out of play
        for observable in self._observables:
            size = int(np.prod(observable._data_shape)) or 1
            channels.append(Channel(observable.name, size, group="object"))
            self._rest.append(np.zeros(size))
        self.channels = tuple(channels)

        # Relative poses are computed from absolute ones, which robosuite lists after them.
        self._in_order = sorted(self._observables, key=_is_relative)
        values = _NotedDict()
        known = [observables[name] for name in (*hands, *hidden) if name in observables]
        for observable in (*known, *self._in_order):
            values[observable.name] = observable._sensor(values)
        self._inputs = [observable for observable in known if observable.name in values.names]

    def read(self) -> list[Floats]:
        """One array for each of ``channels``."""
        values: dict[str, Any] = {}
        for observable in self._inputs:
            values[observable.name] = observable._sensor(values)
        for observable in self._in_order:
            if observable.is_active():
                values[observable.name] = observable._sensor(values)

        poses: list[Floats] = []
        for observable, rest in zip(self._observables, self._rest, strict=True):
            value = values.get(observable.name, rest)
            poses.append(np.asarray(value, np.float64).reshape(-1))
        return poses


def _poses_shown(observables: dict[str, Any], task: TaskSpec) -> list[Any]:
    """Return robosuite's observables of the task's objects."""
    poses: list[Any] = []
    for name, observable in observables.items():
        if observable.modality != "object" or name.startswith("world_pose_in"):
            continue
        if task.name in _CHOSEN or observable.is_active():
            poses.append(observable)
    return poses


def _is_relative(observable: Any) -> bool:
    return "_to_" in observable.name
