"""Robosuite tasks with Gymnasium's contract and a sensorimotor stream."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NoReturn

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import LIMITED, ContactLimits
from asm_gym.envs import lift_cube, robosuite_backend
from asm_gym.envs.actions import Actions
from asm_gym.envs.arms import PHYSICS_FREQ, chains_of
from asm_gym.envs.rendering import OffscreenRenderer
from asm_gym.envs.robots import mend_robots, robot_named, robots_for
from asm_gym.envs.sensors import EXTRA_GROUPS, GROUPS, Senses
from asm_gym.envs.simulated_tracker import HandledObjects
from asm_gym.envs.simulation import Simulation
from asm_gym.envs.stepping import SteppedEnv
from asm_gym.spec import HANDLED, MOTOR, Channel, StreamSpec
from asm_gym.tasks import task as task_spec
from asm_gym.validation import (
    check_choice,
    check_flag,
    check_number,
    check_numbers,
    check_text,
    short_repr,
)

LARGEST_PICTURE = 4096  # height or width [pixels]


def _check_groups(groups: Sequence[str]) -> None:
    if isinstance(groups, str) or not isinstance(groups, Sequence):
        raise ValueError(f"stream must be a sequence of names, got {short_repr(groups)}")
    for group in groups:
        check_text("stream group", group)
        check_choice("stream group", group, (*GROUPS, *EXTRA_GROUPS))


def _substeps_at(control_freq: int) -> int:
    """Return the physics substeps of a control step; raise ValueError where that is no whole number."""
    check_number("control_freq", control_freq, low=1, whole=True)
    if PHYSICS_FREQ % control_freq:
        raise ValueError(
            f"control_freq must divide the physics rate of {PHYSICS_FREQ} Hz, got {control_freq}"
        )
    return PHYSICS_FREQ // control_freq


def _refuse_unknown(task: str, arguments: dict[str, Any]) -> None:
    """Raise TypeError where there are arguments that no environment takes."""
    if not arguments:
        return
    hint = ""
    if "robots" in arguments:
        hint = "; the arm is named by robot="
    raise TypeError(f"asm_gym/{task}-v0 takes no {', '.join(arguments)}{hint}")


def _check_picture(size: tuple[int, int]) -> None:
    pixels = check_numbers("render_size", size, 2, low=1, high=LARGEST_PICTURE)
    if (pixels % 1).any():
        raise ValueError(f"render_size must be two whole numbers, got {short_repr(size)}")


class RobosuiteEnv(SteppedEnv):
    """One robosuite task.

    The observation is what the robot's own sensors report of its configuration and motion, noise included, followed by
    the task's objects. ``info`` holds on reset and on every step:

    - ``stream`` (D,) float32: one row of the sensorimotor stream that ``stream_spec`` names; where the stream runs
      faster than control, a step's last row, and ``streams`` (n, D) all of them;
    - ``success``: whether the task is solved now; ``is_success``: whether it was in this episode, as
      Stable-Baselines3 reads it;
    - ``contact_force``: the largest net contact force on an arm within the step [N];
    - ``contact_impulse``: that force beyond 40 N, summed over the physics substeps of the step [N s];
    - ``joint_stops``, ``self_contacts``: joints at their stops at the end of the step, and contacts between parts of
      robots, without those within a gripper;
    - ``unstable``: the simulation diverged: the episode is truncated, its last stream NaN, its last observation 0.

    Args:
        task: a name in ``asm_gym.tasks.TASKS``.
        robot: the arm, one of ``asm_gym.tasks.ROBOTS``; for a task with two arms a pair, or one name for both.
        render_mode: ``None`` or ``"rgb_array"``.
        observation: ``"flat"`` for one Box, ``"dict"`` for named arrays.
        control_freq: actions a second [Hz]; must divide 500.
        controller: one of ``asm_gym.envs.robosuite_backend.CONTROLLERS``.
        horizon: control steps before truncation; the task's own where None.
        reward_shaping: dense reward where True, for success alone where False.
        terminate_on_success: end the episode (``terminated``) when the task is solved.
        stream: channel groups of ``joint torque hand wrench gripper handled action contact object``; the first seven by
            default, empty for no stream.
        stream_freq: rows of the stream a second [Hz], a multiple of ``control_freq`` that divides 500; None for one row
            a control step.
        sensor_noise: scales the noise of every channel; 0 for exact readings, in steps of no resolution.
        camera, render_size: what ``render`` shows, and its (height, width) [pixels].

    Raises:
        ValueError: an unknown name, the wrong number of robots, or a rate that does not fit.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "Lift",
        robot: str | Sequence[str] | None = None,
        render_mode: str | None = None,
        observation: Literal["flat", "dict"] = "flat",
        control_freq: int = 20,
        controller: str = "OSC_POSE",
        horizon: int | None = None,
        reward_shaping: bool = True,
        terminate_on_success: bool = False,
        stream: Sequence[str] = GROUPS,
        stream_freq: int | None = None,
        sensor_noise: float = 1.0,
        camera: str = "frontview",
        render_size: tuple[int, int] = (480, 480),
        **unknown: Any,
    ) -> None:
        _refuse_unknown(task, unknown)
        self.task = task_spec(task)
        self.robots = robots_for(self.task, robot)
        check_choice("render_mode", render_mode, (None, "rgb_array"))
        check_choice("observation", observation, ("flat", "dict"))
        _check_groups(stream)
        super().__init__(_substeps_at(control_freq))
        self._row_substeps = robosuite_backend.row_substeps(stream_freq, control_freq)
        if horizon is None:
            horizon = self.task.horizon
        self.horizon = check_number("horizon", horizon, low=1, whole=True)
        _check_picture(render_size)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": control_freq}
        self.dt = 1.0 / control_freq
        self.terminate_on_success = check_flag("terminate_on_success", terminate_on_success)
        self.sensor_noise = check_number("sensor_noise", sensor_noise, low=0, high=1e3)
        self._groups = tuple(stream)
        self._flat = observation == "flat"
        self._seeded = False
        self._ended = True
        self._steps_taken = 0

        self.controller = controller  # name of the arms' controller
        check_flag("reward_shaping", reward_shaping)
        self.robosuite_env: Any = robosuite_backend.make(
            self.task, self.robots, controller, control_freq, reward_shaping
        )
        """The simulator underneath."""
        self._make_renderer(camera, render_size)
        self._bind()
        self._build_actions()
        self._build_spaces()

    def _make_renderer(self, camera: str, render_size: tuple[int, int]) -> None:
        cameras = self.robosuite_env.sim.model.camera_names
        check_choice("camera", check_text("camera", camera), cameras)
        height, width = render_size
        self._renderer = OffscreenRenderer(camera, width, height)

    def _build_actions(self) -> None:
        arms = self.simulation.parts
        self.hand_chains = chains_of(arms, self.simulation.model, self.sensor_noise)
        """Kinematic chains of the arms, as they were made."""
        self._actions = Actions(self.robosuite_env, self.task.name, self.controller)
        self._actions.begin_episode(self.simulation)
        self.action_space = self._actions.space
        self.gripper_actions = self._actions.grippers  # indices of the action that command grippers

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuse to be copied or pickled: a simulator has no bytes of its own."""
        raise TypeError(f"{self} cannot be copied or pickled: make another, by gym.make(env.spec)")

    def _bind(self) -> None:
        """Take up the present model, which a hard reset replaces."""
        mend_robots(self.robosuite_env)
        self.simulation = Simulation(self.robosuite_env, self.substeps)
        self._objects = robosuite_backend.ObjectSensors(self.robosuite_env, self.task)
        robosuite_backend.speed_up_contacts(self.robosuite_env)
        self._tracker: HandledObjects | None = None
        if HANDLED in self._groups:
            self._tracker = HandledObjects(self.simulation, self.sensor_noise)
        self.simulation.keeps_history = self.task.name == "Wipe"  # whose reward reads it

    def _build_spaces(self) -> None:
        channels = (*self.simulation.proprioception.channels, *self._objects.channels)
        action = Channel("action", self._actions.size, group=MOTOR)
        tracked: tuple[Channel, ...] = ()
        if self._tracker is not None:
            tracked = self._tracker.channels
        spec = StreamSpec(
            channels=(*channels, *tracked, action),
            dt=self._row_substeps / PHYSICS_FREQ,
            source="+".join(self.robots),
        )
        self._senses = Senses(spec, self._groups, self.sensor_noise, self._flat)
        self.measured_spec = self._senses.measured_spec
        """Everything that is measured, whether or not the stream carries it."""
        self.felt_channels = tuple(c for c in channels if c.name.endswith(LIMITED))
        # the observation's parts in order, and how many numbers each has
        self.observation_layout = self._senses.sizes
        self.observation_space = self.laid_out_space = self._senses.space()

    @property
    def usual_contact_limits(self) -> ContactLimits:
        """The strictest contact limits of the arms, by ``asm_gym.envs.robots``."""
        strictest, *others = (robot_named(name).contact_limits for name in self.robots)
        for limits in others:
            strictest = strictest.strictest_with(limits, self.felt_channels)
        return strictest

    @property
    def stream_freq(self) -> int:
        """Rows of the stream a second [Hz]."""
        return PHYSICS_FREQ // self._row_substeps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; a ``seed`` makes it exact, to the last bit and whatever ran before.

        Without one the generator goes on, and objects keep the shapes that some tasks draw.

        Raises:
            ValueError: options are given.
            gymnasium.error.ClosedEnvironmentError: it was closed.
        """
        self._ended = True  # until it has worked
        if self.robosuite_env is None:
            raise gym.error.ClosedEnvironmentError("reset() after close(): make a new environment")
        if options:
            raise ValueError(f"reset takes no options, got {short_repr(options)}")
        super().reset(seed=seed)
        env = self.robosuite_env
        if seed is not None or not self._seeded:
            robosuite_backend.reseed(env, self.np_random)
            self._seeded = True
        robosuite_backend.choose_object(env, self.task)
        draws_shapes = seed is not None and self.task.draws_shapes
        env.hard_reset = draws_shapes and not self._draw_in_place()
        env.reset()
        if draws_shapes:
            self._bind()
        else:
            self.simulation.begin_episode()
        self._actions.begin_episode(self.simulation)
        if self._tracker is not None:
            (own_draws,) = self.np_random.spawn(1)  # no other draw differs by these
            self._tracker.begin_episode(own_draws)
        self._diverged = self._divergences()
        self._steps_taken = 0
        self.holding = False
        self.contact_limits = None
        self._limits_of_guards.clear()
        self._action = np.zeros(self._actions.size, np.float32)
        self._reading = self._read()
        self._ended = False
        self._solved = False
        return self._senses.observation(self._reading), self._info(bool(env._check_success()))

    def _draw_in_place(self) -> bool:
        """Draw the shapes of the loaded model anew; return False where the model must be loaded anew for that."""
        nominal = self.simulation.nominal
        is_edited = len(self.edits) > 0 or nominal.now() is not nominal.unedited
        if is_edited:  # the edits would be mixed up with what is drawn
            return False
        return lift_cube.draw(self.robosuite_env)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one control step by an action (A,), which is clipped to [-1, 1].

        Raises:
            ValueError: a wrong shape, or an action that is not finite.
            gymnasium.error.ResetNeeded: the episode has ended, or none was begun.
        """
        action = self._actions.checked(action)
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        env = self.robosuite_env
        env.timestep += 1
        self._run(action)
        env.cur_time += env.control_timestep
        self._steps_taken += 1
        reward = float(env._post_action(self._action)[0])
        success = bool(env._check_success())
        self._reading = self._read()
        is_finite = self._finite and self._reading.row_finite
        unstable = not is_finite or self._divergences() != self._diverged
        if unstable:
            # The simulation then usually holds MuJoCo's initial state, which no sensor could read.
            self._reading.row[:] = np.nan
            self._reading.stream[:] = np.nan
            self._reading.seen[:] = 0.0
            reward = 0.0
            success = False
        info = self._info(success, unstable)
        if "streams" in info:
            info["streams"] = np.stack([*self._rows, info["stream"]])
        terminated = self.terminate_on_success and success
        truncated = self._steps_taken >= self.horizon or unstable
        self._ended = terminated or truncated
        return self._senses.observation(self._reading), reward, terminated, truncated, info

    def _info(self, success: bool, unstable: bool = False) -> dict[str, Any]:
        """Return ``info`` after a step or a reset."""
        self._solved |= success
        info: dict[str, Any] = {}
        if self._senses.stream_spec is not None:
            info["stream"] = self._reading.stream
            rows = self.substeps // self._row_substeps
            if rows > 1:
                info["streams"] = np.repeat(info["stream"][None], rows, axis=0)
        info["success"] = success
        info["is_success"] = self._solved
        info |= self._forces(unstable)
        info["unstable"] = unstable
        return info

    @property
    def stream_spec(self) -> StreamSpec:
        """Names the numbers in ``info["stream"]``; raises AttributeError where there is none."""
        if self._senses.stream_spec is None:
            raise AttributeError("this environment was made with stream=(), so it has no stream")
        return self._senses.stream_spec

    @property
    def measured(self) -> NDArray[np.float64]:
        """The row measured last, laid out as ``measured_spec`` says; a copy."""
        return self._reading.row.copy()

    def render(self) -> NDArray[Any] | None:
        """Return a picture (height, width, 3) uint8; raise RuntimeError where this machine has nothing to draw with."""
        if self.render_mode == "rgb_array":
            return self._renderer.render(self.simulation.model, self.simulation.data)
        gym.logger.warn(
            "render() does nothing without a render_mode: gym.make(…, render_mode='rgb_array')"
        )
        return None

    def close(self) -> None:
        """Free the renderer and the simulation; may be called more than once."""
        self._renderer.close()
        if self.robosuite_env is not None:
            self.robosuite_env.close()
            self.robosuite_env = None
        self._ended = True
