"""Robosuite tasks with Gymnasium's contract and a sensorimotor stream. The only module that imports robosuite."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, Literal

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.envs.rendering import OffscreenRenderer
from asm_gym.envs.sensors import GROUPS, ArmSensors, ContactForce
from asm_gym.stream import MOTOR, Channel, StreamSpec
from asm_gym.tasks import ROBOTS
from asm_gym.tasks import task as task_spec

PHYSICS_FREQ = 500
"""Robosuite's physics rate [Hz]."""

# What of the stream a policy sees: the robot's configuration and motion, not its torques.
_OBSERVED = (
    "joint_position",
    "joint_velocity",
    "hand_position",
    "hand_orientation",
    "gripper_opening",
    "gripper_velocity",
)
# Observations are clipped to this, which keeps the Box true; nothing a task does comes near it.
_BOUND = 100.0
_BAD = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


def _import_robosuite() -> Any:
    """Robosuite, without the warnings it prints at import about optional parts."""
    logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)
    with _opencv_or_none():
        import robosuite
    return robosuite


@contextmanager
def _opencv_or_none() -> Iterator[None]:
    """Lets robosuite be imported where opencv cannot be, for want of libGL: only its own viewer would use it."""
    try:
        import cv2  # noqa: F401
    except ImportError:
        sys.modules["cv2"] = ModuleType("cv2")
        try:
            yield
        finally:
            del sys.modules["cv2"]
    else:
        yield


class RobosuiteEnv(gym.Env[Any, NDArray[np.float32]]):
    """One robosuite task.

    The observation is what the robot's own sensors report of its configuration and motion, noise included, followed by
    the task's objects. ``info["stream"]`` (D,) float32 is one row of the sensorimotor stream that ``stream_spec``
    names; ``info["success"]`` says whether the task is solved now; ``info["contact_force"]`` is the largest net contact
    force on the robot within the step [N]; ``info["unstable"]`` is True when the simulation diverged, which ends the
    episode as truncated.

    Args:
        task: a name in ``asm_gym.tasks.TASKS``.
        robot: the arm, one of ``asm_gym.tasks.ROBOTS``.
        render_mode: ``None`` or ``"rgb_array"``.
        observation: ``"flat"`` for one Box, ``"dict"`` for named arrays.
        control_freq: actions a second [Hz]; must divide 500.
        horizon: control steps before truncation; the task's own where None.
        reward_shaping: dense reward where True, 1 for success where False.
        terminate_on_success: end the episode (``terminated``) when the task is solved.
        stream: channel groups that make up the stream, of ``joint torque hand wrench gripper object action``.
        sensor_noise: scales the noise of every channel; 0 for exact readings.
        camera, render_size: what ``render`` shows, and its (height, width) [pixels].

    Raises:
        ValueError: an unknown task, robot, render mode, channel group or camera, or a rate that does not divide 500.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "Lift",
        robot: str | None = None,
        render_mode: str | None = None,
        observation: Literal["flat", "dict"] = "flat",
        control_freq: int = 20,
        horizon: int | None = None,
        reward_shaping: bool = True,
        terminate_on_success: bool = False,
        stream: tuple[str, ...] = GROUPS,
        sensor_noise: float = 1.0,
        camera: str = "frontview",
        render_size: tuple[int, int] = (480, 480),
    ) -> None:
        self.task = task_spec(task)
        self.robot = robot or "Panda"
        _check_choice("robot", self.robot, ROBOTS)
        _check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        _check_choice("observation", observation, ("flat", "dict"))
        for group in stream:
            _check_choice("stream group", group, (*GROUPS, "object"))
        if control_freq <= 0 or PHYSICS_FREQ % control_freq:
            raise ValueError(f"control_freq must divide the physics rate of {PHYSICS_FREQ} Hz, got {control_freq}")
        if sensor_noise < 0:
            raise ValueError(f"sensor_noise must be >= 0, got {sensor_noise}")
        self.horizon = self.task.horizon if horizon is None else horizon
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1, got {horizon}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": control_freq}
        self.terminate_on_success = terminate_on_success
        self.sensor_noise = sensor_noise
        self.corruptions: list[Callable[[NDArray[np.float64]], None]] = []
        """Sensor faults: each edits the measured row (channels of ``measured_spec``) in place, after the noise."""
        self.substeps = PHYSICS_FREQ // control_freq
        self._groups = tuple(stream)
        self._flat = observation == "flat"
        self._renderer = OffscreenRenderer(camera, render_size[1], render_size[0])
        self._seeded = False
        self._ended = True
        self._steps = 0

        robosuite = _import_robosuite()
        self.robosuite_env: Any = robosuite.make(
            self.task.name,
            robots=self.robot,
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            control_freq=control_freq,
            reward_shaping=reward_shaping,
            ignore_done=True,
        )
        """The simulator underneath."""
        cameras = self.robosuite_env.sim.model.camera_names
        _check_choice("camera", camera, cameras)
        # Episodes are given their motion by the joints alone, so the initial noise is one number for every robot.
        self._qpos_noise = self.robosuite_env.robots[0].initialization_noise["magnitude"]
        self._bind()
        self._build_spaces()
        self.gripper_actions = _gripper_actions(self.robosuite_env.robots)
        """Which numbers of the action command grippers."""

    # ------------------------------------------------------------------ spaces

    def _bind(self) -> None:
        """Looks up everything that belongs to the present model, which a hard reset replaces."""
        env = self.robosuite_env
        self._arms = [ArmSensors(r, a, "", self.substeps) for r in env.robots for a in r.arms if a in r.gripper]
        self._contact = ContactForce(env.robots)
        self._objects = {n: o for n, o in env._observables.items() if o.modality == "object" and o.is_active()}
        # Object observables compute positions relative to the hand out of these.
        inputs = ("robot0_eef_pos", "robot0_eef_quat", "world_pose_in_gripper")
        self._object_inputs = [env._observables[n] for n in inputs if n in env._observables]
        self._data: mujoco.MjData = env.sim.data._data
        self._model: mujoco.MjModel = env.sim.model._model

    def _build_spaces(self) -> None:
        low, high = self.robosuite_env.action_spec
        self.action_space = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        objects = tuple(Channel(name, values.size, "1", 0.0, "object") for name, values in self._read_objects().items())
        action = Channel("action", low.size, "1", 0.0, MOTOR)
        source = f"{self.robot}"
        everything = (*(c for arm in self._arms for c in arm.channels), *objects, action)
        self.measured_spec = StreamSpec(everything, self.substeps / PHYSICS_FREQ, source)
        """Everything that is measured, whether or not the stream carries it."""
        self.stream_spec = StreamSpec(
            tuple(c for c in everything if c.group in self._groups), self.measured_spec.dt, source
        )
        """Names the numbers in ``info["stream"]``."""
        slices = self.measured_spec.slices
        self._to_stream = _indices(slices, [c.name for c in self.stream_spec.channels])
        observed = [c.name for c in everything if c.name in _OBSERVED or c.group == "object"]
        self._to_observation = _indices(slices, observed)
        self._named = {name: slices[name] for name in observed}
        self.observation_layout = {name: s.stop - s.start for name, s in self._named.items()}
        """The observation's parts in order, and how many numbers each has."""
        self._noise = self.measured_spec.noise * self.sensor_noise
        self.observation_space = (
            _box(len(self._to_observation))
            if self._flat
            else spaces.Dict({name: _box(s.stop - s.start) for name, s in self._named.items()})
        )

    # ------------------------------------------------------------------ episodes

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: makes the episode exact: same seed, same episode to the last bit, whatever ran before. Object shapes
                are then drawn anew, which means loading the model again (~0.2 s). An unseeded reset goes on with the
                same generator and keeps the model (a few ms).
            options: ``qpos_noise``: standard deviation of the initial joint positions [rad], 0.02 by default.

        Raises:
            ValueError: an unknown option.
        """
        super().reset(seed=seed)
        noise = self._qpos_noise
        for name, value in (options or {}).items():
            _check_choice("reset option", name, ("qpos_noise",))
            noise = float(value)
        env = self.robosuite_env
        # A hard reset makes the robots anew from their configurations, a soft one keeps them.
        for robot, configuration in zip(env.robots, env.robot_configs, strict=True):
            robot.initialization_noise["magnitude"] = noise
            configuration["initialization_noise"] = {"magnitude": noise, "type": "gaussian"}
        if seed is not None or not self._seeded:
            # In place: placement samplers hold the generator itself.
            env.rng.bit_generator.state = np.random.default_rng(self.np_random.integers(2**63)).bit_generator.state
            self._seeded = True
        env.hard_reset = seed is not None
        env.reset()
        self._bind()
        self._warnings = self._bad_count()
        self._steps, self._ended = 0, False
        self._contact.start()
        for arm in self._arms:
            arm.start()
        self._measure(np.zeros(self.action_space.shape[0], np.float32))  # type: ignore[index]
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Runs one control step.

        Args:
            action: (A,) in [-1, 1]; clipped to it.

        Raises:
            ValueError: a wrong shape, or an action that is not finite.
            gymnasium.error.ResetNeeded: the episode has ended, or none was begun.
        """
        action = self._checked(action)
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        env = self.robosuite_env
        env.timestep += 1
        self._simulate(action)
        env.cur_time += env.control_timestep
        reward = float(env.reward(action))
        self._steps += 1
        self._measure(action)
        info = self._info()
        info["unstable"] = self._bad_count() != self._warnings or not np.isfinite(self._row).all()
        terminated = self.terminate_on_success and info["success"] and not info["unstable"]
        truncated = self._steps >= self.horizon or info["unstable"]
        self._ended = terminated or truncated
        return self._observation(), reward if np.isfinite(reward) else 0.0, terminated, truncated, info

    def _simulate(self, action: NDArray[np.float32]) -> None:
        """The substeps of one control step, sensors sampled after each."""
        env, sim, contact, arms = self.robosuite_env, self.robosuite_env.sim, self._contact, self._arms
        contact.start()
        for arm in arms:
            arm.start()
        for k in range(self.substeps):
            sim.step1()
            env._pre_action(action, k == 0)
            sim.step2()
            contact.sample()
            for arm in arms:
                arm.sample()

    def _checked(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        action = np.asarray(action, dtype=np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"{self.task.name} takes an action of shape {self.action_space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"the action must be finite, got {action}")
        return np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]

    # ------------------------------------------------------------------ senses

    def _read_objects(self) -> dict[str, NDArray[np.float64]]:
        env = self.robosuite_env
        for observable in (*self._object_inputs, *self._objects.values()):
            observable.update(timestep=env.model_timestep, obs_cache=env._obs_cache, force=True)
        return {name: np.atleast_1d(o.obs) for name, o in self._objects.items()}

    def _measure(self, action: NDArray[np.float32]) -> None:
        """Reads every sensor once; noise, then faults."""
        objects = self._read_objects().values()
        row = np.concatenate([*(arm.read() for arm in self._arms), *objects, action])
        row += self._noise * self.np_random.standard_normal(row.size)
        for corrupt in self.corruptions:
            corrupt(row)
        self._row = row

    def _observation(self) -> Any:
        row = np.clip(np.nan_to_num(self._row), -_BOUND, _BOUND).astype(np.float32)
        return row[self._to_observation] if self._flat else {name: row[s] for name, s in self._named.items()}

    def _info(self) -> dict[str, Any]:
        return {
            "stream": self._row[self._to_stream].astype(np.float32),
            "success": bool(self.robosuite_env._check_success()),
            "contact_force": self._contact.peak,
            "unstable": False,
        }

    def _bad_count(self) -> int:
        """How often MuJoCo found the simulation unstable; it resets itself then, and says so nowhere else."""
        return sum(int(self._data.warning[w].number) for w in _BAD)

    @property
    def measured(self) -> NDArray[np.float64]:
        """The row measured last, laid out as ``measured_spec`` says; a copy."""
        return self._row.copy()

    @property
    def motors(self) -> NDArray[np.intp]:
        """The actuators of the arm's joints, from the base on."""
        return np.concatenate([arm.motors for arm in self._arms])

    # ------------------------------------------------------------------ pictures

    def render(self) -> NDArray[np.uint8] | None:
        """(height, width, 3) uint8, or None without a ``render_mode``."""
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode: gym.make(…, render_mode='rgb_array')")
            return None
        return self._renderer.render(self._model, self._data)

    def close(self) -> None:
        """Frees the renderer and the simulation; may be called more than once."""
        self._renderer.close()
        if self.robosuite_env is not None:
            self.robosuite_env.close()
            self.robosuite_env = None
        self._ended = True


def _gripper_actions(robots: list[Any]) -> tuple[int, ...]:
    found: list[int] = []
    start = 0
    for robot in robots:
        for part, (low, high) in robot._action_split_indexes.items():
            if "gripper" in part:
                found += range(start + low, start + high)
        start += robot.action_dim
    return tuple(found)


def _box(size: int) -> spaces.Box:
    return spaces.Box(-_BOUND, _BOUND, (size,), np.float32)


def _indices(slices: dict[str, slice], names: list[str]) -> NDArray[np.intp]:
    return np.concatenate([np.arange(slices[n].start, slices[n].stop) for n in names])


def _check_choice(what: str, got: Any, known: Any) -> None:
    if got not in known:
        raise ValueError(f"unknown {what} {got!r}; known: {', '.join(map(str, known))}")
