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
from asm_gym.validation import check_choice, check_text

CONTROLLERS = ("OSC_POSE", "OSC_POSITION", "JOINT_POSITION", "JOINT_TORQUE", "IK_POSE")
"""Robosuite's controllers of an arm, less JOINT_VELOCITY, which fails inside robosuite 1.5."""

# Tasks that choose one of several objects for each episode: attributes with the objects and with the choice.
_CHOSEN = {"PickPlaceSingle": ("objects", "object_id"), "NutAssemblySingle": ("nuts", "nut_id")}


def import_robosuite() -> Any:
    """Return robosuite, without the warnings it prints at import about optional parts."""
    logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)
    with suppress(ImportError):
        import cv2  # noqa: F401
    if (
        no_viewer := "cv2" not in sys.modules
    ):  # for want of libGL: only robosuite's own viewer would use it
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
    if (
        "robosuite" not in sys.modules
    ):  # parts that an import which failed has left are no attributes of a new one
        for name in [name for name in sys.modules if name.startswith("robosuite.")]:
            del sys.modules[name]
    return require("robosuite", what="a robosuite environment")


def _fit_to_mujoco() -> None:
    """Mend robosuite 1.5.2's mass matrix: MuJoCo 3.10 changed the arguments of ``mj_fullM``, 3.11 removed ``qM``."""
    from robosuite.controllers.parts import controller
    from robosuite.utils.binding_utils import MjData

    def whole_mass_matrix(model: mujoco.MjModel, whole: Floats, triangle: Floats) -> None:
        rows, columns = np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind
        whole[:] = 0.0
        whole[rows, columns] = whole[columns, rows] = triangle

    MjData.qM = property(lambda data: data._data.M)
    controller.mujoco = SimpleNamespace(mj_fullM=whole_mass_matrix)


def _compile_less() -> None:
    """Leave uncompiled what takes seconds to compile, for an observable of robosuite's robots that nothing reads."""
    from robosuite.robots import robot
    from robosuite.utils import transform_utils

    mat2quat = getattr(transform_utils.mat2quat, "py_func", transform_utils.mat2quat)
    robot.T = SimpleNamespace(**{**vars(transform_utils), "mat2quat": mat2quat})


def row_substeps(rate: int, control_freq: int) -> int:
    """Return the physics substeps between two rows at ``rate`` [Hz]; raise ValueError, listing those that fit."""
    possible = [
        f
        for f in range(control_freq, PHYSICS_FREQ + 1)
        if not (PHYSICS_FREQ % f or f % control_freq)
    ]
    if rate not in possible:
        raise ValueError(
            f"stream_freq must divide the physics rate of {PHYSICS_FREQ} Hz and be a multiple of the control rate of "
            f"{control_freq} Hz, one of {', '.join(map(str, possible))}, got {rate}"
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
    return robosuite.make(
        task.name,
        robots=list(robots),
        controller_configs=None
        if controller == "OSC_POSE"
        else [_configuration(controller, r) for r in robots],
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=control_freq,
        reward_shaping=reward_shaping
        and task.name != "TwoArmTransport",  # which has no dense reward
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
    data, count = env.sim.data._data, env.sim.model.ngeom
    ids = {name: env.sim.model.geom_name2id(name) for name in env.sim.model.geom_names}

    @lru_cache
    def members(group: Any) -> NDArray[np.bool_]:
        names = getattr(group, "contact_geoms", group)  # of a model
        names = (names,) if isinstance(names, str) else names
        mask = np.zeros(count, bool)
        mask[[ids[name] for name in names if name in ids]] = True
        return mask

    everything = np.ones(count, bool)

    def mask(geoms: Any) -> NDArray[np.bool_]:
        return members(tuple(geoms) if isinstance(geoms, list) else geoms)

    def check_contact(geoms_1: Any, geoms_2: Any = None) -> bool:
        """Whether any geom of one group touches any of the other; of anything where there is no other."""
        return touching(
            data.contact.geom, mask(geoms_1), everything if geoms_2 is None else mask(geoms_2)
        )

    @lru_cache
    def pads(gripper: Any) -> tuple[tuple[str, ...], ...]:
        return tuple(
            tuple(gripper.important_geoms[f"{side}_fingerpad"]) for side in ("left", "right")
        )

    def check_grasp(gripper: Any, object_geoms: Any) -> bool:
        """Whether the pads on both sides of a gripper, or of any of several, touch an object."""
        if isinstance(gripper, dict):
            return any(check_grasp(each, object_geoms) for each in gripper.values())
        return all(check_contact(pad, object_geoms) for pad in pads(gripper))

    @lru_cache
    def grip_site(gripper: Any) -> NDArray[np.float64]:
        return np.asarray(data.site(gripper.important_sites["grip_site"]).xpos)

    @lru_cache
    def place(target: Any, kind: str) -> NDArray[np.float64]:
        name = getattr(target, "root_body", None)  # of a model
        return np.asarray(data.body(name).xpos if name else getattr(data, kind)(target).xpos)

    def gripper_to_target(
        gripper: Any, target: Any, target_type: str = "body", return_distance: bool = False
    ) -> Any:
        """Way from a gripper, or from the nearest of several, to a target; or its length."""
        grippers = gripper.values() if isinstance(gripper, dict) else (gripper,)
        ways = [place(target, target_type) - grip_site(each) for each in grippers]
        way = ways[0] if len(ways) == 1 else min(ways, key=np.linalg.norm)
        return np.sqrt(way.dot(way)) if return_distance else way  # as NumPy's norm does it

    env.check_contact, env._check_grasp, env._gripper_to_target = (
        check_contact,
        check_grasp,
        gripper_to_target,
    )


class _Asked(dict[str, Any]):
    """A dict that notes the names whose values it was asked for."""

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
        of_objects = {n: o for n, o in observables.items() if o.modality == "object"}
        hands = [f"robot{i}_eef_{what}" for i in range(len(env.robots)) for what in ("pos", "quat")]
        # Never shown, but others compute from them.
        hidden = [n for n in of_objects if n.startswith("world_pose_in")]
        chosen = task.name in _CHOSEN
        inputs = [observables[n] for n in (*hands, *hidden) if n in observables]
        self._observables = [
            o for n, o in of_objects.items() if n not in hidden and (chosen or o.is_active())
        ]
        sizes = [int(np.prod(o._data_shape)) or 1 for o in self._observables]
        self.channels = tuple(
            Channel(o.name, size, "1", 0.0, "object")
            for o, size in zip(self._observables, sizes, strict=True)
        )
        self._rest = [np.zeros(size) for size in sizes]
        # Relative poses are computed from absolute ones, which robosuite lists after them.
        self._in_order = sorted(self._observables, key=lambda o: "_to_" in o.name)
        seen = _Asked()
        for observable in (*inputs, *self._in_order):
            seen[observable.name] = observable._sensor(seen)
        self._inputs = [o for o in inputs if o.name in seen.names]

    def read(self) -> list[NDArray[np.float64]]:
        """One array for each of ``channels``."""
        seen: dict[str, Any] = {}
        for observable in self._inputs:
            seen[observable.name] = observable._sensor(seen)
        for observable in self._in_order:
            if observable.is_active():
                seen[observable.name] = observable._sensor(seen)
        return [
            np.asarray(seen[o.name], np.float64).reshape(-1) if o.name in seen else rest
            for o, rest in zip(self._observables, self._rest, strict=True)
        ]
