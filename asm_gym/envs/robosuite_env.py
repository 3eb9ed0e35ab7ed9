"""Robosuite tasks with Gymnasium's contract and a sensorimotor stream."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NoReturn

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs import backend, shapes
from asm_gym.envs.actions import Actions
from asm_gym.envs.edits import SimulatorEdits
from asm_gym.envs.rendering import RENDER_MODES, OffscreenRenderer, Window
from asm_gym.envs.robots import PHYSICS_FREQ, chains_of, force_behind, free_first_joints, robots_for
from asm_gym.envs.senses import Reading, Senses
from asm_gym.envs.sensors import EXTRA_GROUPS, GROUPS, Corruption
from asm_gym.envs.simulation import Simulation
from asm_gym.spec import StreamSpec
from asm_gym.tasks import TASKS
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice, check_flag, check_number, check_numbers, check_text, short_repr

_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]

LARGEST_PICTURE = 4096
"""Height or width [pixels]."""


class RobosuiteEnv(gym.Env[Any, NDArray[np.float32]]):
    """One robosuite task.

    The observation is what the robot's own sensors report of its configuration and motion, noise included, followed by
    the task's objects. ``info`` holds on reset and on every step:

    - ``stream`` (D,) float32: one row of the sensorimotor stream that ``stream_spec`` names;
    - ``success``: whether the task is solved now;
    - ``contact_force``: the largest net contact force on an arm within the step [N];
    - ``external_force``: the same of all that acts on it from outside, faults that push or pull included [N];
    - ``external_impulse``: that force's mean norm times the length of the step [N s];
    - ``streams`` (n, D) float32: where the stream runs faster than control, its rows since the last step; ``stream`` is
      the last of them (not on reset);
    - ``unstable``: the simulation diverged, which ends the episode as truncated. Its last stream is then NaN, its last
      observation 0.

    Args:
        task: a name in ``asm_gym.tasks.TASKS``.
        robot: the arm, one of ``asm_gym.tasks.ROBOTS``; for a task with two arms a pair, or one name for both.
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.
        observation: ``"flat"`` for one Box, ``"dict"`` for named arrays.
        control_freq: actions a second [Hz]; must divide 500.
        controller: one of ``asm_gym.envs.backend.CONTROLLERS``, or a robosuite controller configuration.
        horizon: control steps before truncation; the task's own where None.
        reward_shaping: dense reward where True, for success alone where False.
        terminate_on_success: end the episode (``terminated``) when the task is solved.
        stream: channel groups that make up the stream, of ``joint torque hand wrench gripper action contact object``;
            empty for none.
        stream_freq: rows of the stream a second [Hz]; a multiple of ``control_freq`` that divides 500. Means and peaks
            are then taken since the last row. None for one row a control step.
        sensor_noise: scales the noise of every channel; 0 for exact readings, in steps of no resolution.
        camera, render_size: what ``render`` shows, and its (height, width) [pixels].

    Raises:
        ValueError: an unknown task, robot, controller, render mode, channel group or camera, the wrong number of
            robots, or a rate that does not fit.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "Lift",
        robot: str | Sequence[str] | None = None,
        render_mode: str | None = None,
        observation: Literal["flat", "dict"] = "flat",
        control_freq: int = 20,
        controller: str | dict[str, Any] = "OSC_POSE",
        horizon: int | None = None,
        reward_shaping: bool = True,
        terminate_on_success: bool = False,
        stream: Sequence[str] = GROUPS,
        stream_freq: int | None = None,
        sensor_noise: float = 1.0,
        camera: str = "frontview",
        render_size: tuple[int, int] = (480, 480),
    ) -> None:
        self.task = task_spec(task)
        self.robots = robots_for(self.task, robot)
        check_choice("render_mode", render_mode, (None, *RENDER_MODES))
        check_choice("observation", observation, ("flat", "dict"))
        if isinstance(stream, str) or not isinstance(stream, Sequence):
            raise ValueError(f"stream must be a sequence of names, got {short_repr(stream)}")
        for group in stream:
            check_choice("stream group", check_text("stream group", group), (*GROUPS, *EXTRA_GROUPS))
        if check_number("control_freq", control_freq, low=1, whole=True) and PHYSICS_FREQ % control_freq:
            raise ValueError(f"control_freq must divide the physics rate of {PHYSICS_FREQ} Hz, got {control_freq}")
        if stream_freq is not None:
            check_number("stream_freq", stream_freq, low=1, whole=True)
        self._row_substeps = backend.row_substeps(control_freq if stream_freq is None else stream_freq, control_freq)
        self.horizon = self.task.horizon if horizon is None else check_number("horizon", horizon, low=1, whole=True)
        if (check_numbers("render_size", render_size, 2, low=1, high=LARGEST_PICTURE) % 1).any():
            raise ValueError(f"render_size must be two whole numbers, got {short_repr(render_size)}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": control_freq}
        self.terminate_on_success = check_flag("terminate_on_success", terminate_on_success)
        self.sensor_noise = check_number("sensor_noise", sensor_noise, low=0, high=1e3)
        self.corruptions: list[Corruption] = []
        """Sensor faults: each edits the measured row in place, after the noise."""
        self.deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]] = []
        """Action faults: each replaces the commanded action."""
        self.edits = SimulatorEdits()
        """Changes of the simulator's numbers that will be undone."""
        self.substep_hooks: list[Callable[[int], None]] = []
        """Called after every physics substep with its number in the control step; a hook may call ``measure()`` and
        ``command()``."""
        self.row_hooks: list[Callable[[NDArray[np.float32]], None]] = []
        """Called with every row of the stream within a control step but the last; a hook may call ``command()``."""
        self.holding = False
        """Set, the arms stay in the next control step, and the grippers keep their command, whatever action arrives;
        from within a hook, in the rest of the step. The step unsets it."""
        self.keeps_holding = False
        """Set, ``holding`` lasts until both are unset, however many steps a wrapper in between makes of one."""
        self.contact_limits: ContactLimits | None = None
        """Limits of load and hand speed in this episode; ``reset`` removes them. ``info`` then holds ``contact_load``,
        the largest share of a limit that was reached within the step, ``contact_left_s``, when in it a limit was passed
        [s], NaN where none was, and ``contact_felt``, the step's mean load."""
        self.substeps = PHYSICS_FREQ // control_freq
        self._groups = tuple(stream)
        self._flat = observation == "flat"
        self._seeded = False
        self._ended = True
        self._steps_taken = 0

        self.controller = controller if isinstance(controller, str) else "custom"
        """Name of the arms' controller."""
        self.robosuite_env: Any = backend.make(
            self.task, self.robots, controller, control_freq, check_flag("reward_shaping", reward_shaping)
        )
        """The simulator underneath."""
        check_choice("camera", check_text("camera", camera), self.robosuite_env.sim.model.camera_names)
        self._renderer = OffscreenRenderer(camera, render_size[1], render_size[0])
        self._window = Window(camera, 1.0 / control_freq)
        # Episodes are given their motion by the joints alone, so the initial noise is one number for every robot.
        self._qpos_noise = self.robosuite_env.robots[0].initialization_noise["magnitude"]
        self._bind()
        self.hand_chains = chains_of(self.simulation.parts, self.simulation.model, self.sensor_noise)
        """Kinematic chains of the arms, as they were made."""
        self._actions = Actions(self.robosuite_env, self.task.name, self.controller)
        self.action_space = self._actions.space
        self.gripper_actions = self._actions.grippers
        """Indices of the action that command grippers."""
        self._build_spaces()

    def __deepcopy__(self, memo: dict[int, Any]) -> NoReturn:
        """Refused: robosuite's own goes on reading the simulator that it was made from."""
        raise TypeError(f"{self} cannot be copied: make another, by gym.make(env.spec)")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refused: a simulator has no bytes of its own."""
        raise TypeError(f"{self} cannot be pickled: send a function that makes it, lambda: gym.make(...)")

    # ------------------------------------------------------------------ spaces

    def _bind(self) -> None:
        """Take up the present model, which a hard reset replaces."""
        free_first_joints(self.robosuite_env)
        self.simulation = Simulation(self.robosuite_env, self.substeps)
        """Physics, controllers and sensors of the loaded model."""
        self._warning_counts: Any = self.simulation.data.warning.number  # a view
        self._objects = backend.ObjectSensors(self.robosuite_env, self.task)
        backend.speed_up_contacts(self.robosuite_env)
        self.simulation.keeps_history = self.task.name == "Wipe"  # whose reward reads it

    def _build_spaces(self) -> None:
        channels = (*self.simulation.proprioception.channels, *self._objects.channels)
        dt, source = self._row_substeps / PHYSICS_FREQ, "+".join(self.robots)
        self._senses = Senses(
            channels, self._actions.size, dt, source, self._groups, self.sensor_noise, flat=self._flat
        )
        self.measured_spec = self._senses.measured_spec
        """Everything that is measured, whether or not the stream carries it."""
        self.felt_channels = tuple(c for c in channels if c.name.endswith(("external_torque", "wrist_force")))
        """Channels that contact limits apply to, of one arm after another."""
        self.observation_layout = self._senses.sizes
        """The observation's parts in order, and how many numbers each has."""
        self.observation_space = self.laid_out_space = self._senses.space()

    @property
    def stream_freq(self) -> int:
        """Rows of the stream a second [Hz]; may be set between episodes.

        Raises:
            ValueError: a rate that does not fit physics or control; the message lists those that do.
        """
        return PHYSICS_FREQ // self._row_substeps

    @stream_freq.setter
    def stream_freq(self, rate: int) -> None:
        self._row_substeps = backend.row_substeps(rate, PHYSICS_FREQ // self.substeps)
        self._build_spaces()

    def stream_spec_at(self, rate: int) -> StreamSpec:
        """Return ``stream_spec`` as it would be at another rate [Hz]; nothing is changed.

        Raises:
            ValueError: a rate that does not fit physics or control.
        """
        substeps = backend.row_substeps(rate, PHYSICS_FREQ // self.substeps)
        return replace(self.stream_spec, dt=substeps / PHYSICS_FREQ)

    # ------------------------------------------------------------------ episodes

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: makes the episode exact: same seed, same episode to the last bit, whatever ran before. Where a task
                draws the shapes of its objects, they are drawn anew, which an unseeded reset does not: it goes on with
                the same generator and keeps the shapes.
            options: ``qpos_noise``: standard deviation of the initial joint positions [rad], 0.02 by default.

        Raises:
            ValueError: an unknown option.
        """
        self._ended = True  # until it has worked
        if options is not None and not isinstance(options, dict):
            raise ValueError(f"options must be a dict, got {short_repr(options)}")
        super().reset(seed=seed)
        noise = self._qpos_noise
        for name, value in (options or {}).items():
            check_choice("reset option", name, ("qpos_noise",))
            noise = check_number(name, value, low=0, high=np.pi)
        env = self.robosuite_env
        # A hard reset makes the robots anew from their configurations, a soft one keeps them.
        for robot, configuration in zip(env.robots, env.robot_configs, strict=True):
            robot.initialization_noise["magnitude"] = noise
            configuration["initialization_noise"] = {"magnitude": noise, "type": "gaussian"}
        if seed is not None or not self._seeded:
            backend.reseed(env, self.np_random)
            self._seeded = True
        backend.choose_object(env, self.task)
        draws = seed is not None and self.task.draws_shapes
        env.hard_reset = draws and (self._is_edited() or not shapes.draw(env))
        env.reset()
        if draws:
            self._bind()
        else:
            self.simulation.begin_episode()
        self._warnings = self._bad_count()
        self._steps_taken, self.holding = 0, False
        self.contact_limits = None
        self._action = np.zeros(self._actions.size, np.float32)
        self._reading = self._read()
        self._ended = False
        if self.render_mode == "human":
            self.render()
        return self._senses.observation(self._reading.row), self._info(bool(env._check_success()))

    def _is_edited(self) -> bool:
        """Whether numbers of the model are edited, which would be mixed up with those that are drawn."""
        nominal = self.simulation.nominal
        return len(self.edits) > 0 or nominal.now() is not nominal.unedited

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one control step.

        Args:
            action: (A,) in [-1, 1]; clipped to it.

        Raises:
            ValueError: a wrong shape, or an action that is not finite.
            gymnasium.error.ResetNeeded: the episode has ended, or none was begun.
        """
        action = self._actions.checked(action)
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        env = self.robosuite_env
        env.timestep += 1
        limits = self.contact_limits
        self.simulation.begin(limits, self.felt_channels)
        self._command(action)
        self._rows: list[NDArray[np.float32]] = []
        self._finite = True
        self._advance()
        if limits is not None and limits.stays and self.simulation.passed_limit is not None:
            # What was done last is what the stream says was commanded.
            self._action = self._actions.resting(self.simulation, self._action)
        env.cur_time += env.control_timestep
        self._steps_taken += 1
        reward, success = float(env._post_action(self._action)[0]), bool(env._check_success())
        self._reading = self._read()
        if unstable := self._bad_count() != self._warnings or not (self._finite and self._reading.row_finite):
            # The simulation then holds MuJoCo's initial state as a rule, which no sensor of the robot could read.
            self._reading.row[:] = self._reading.stream[:] = np.nan
            reward, success = 0.0, False
        info = self._info(success, unstable)
        if self._row_substeps < self.substeps and "stream" in info:
            info["streams"] = np.stack([*self._rows, info["stream"]])
        terminated = self.terminate_on_success and success
        truncated = self._steps_taken >= self.horizon or unstable
        self._ended = terminated or truncated
        if self.render_mode == "human":
            self.render()
        return self._senses.observation(self._reading.row), reward, terminated, truncated, info

    def _advance(self) -> None:
        """Run the substeps of a control step, and read the rows of the stream before its end."""
        stride = 1 if self.substep_hooks else self._row_substeps
        for done in range(stride, self.substeps + 1, stride):
            self.simulation.advance(stride)
            for hook in self.substep_hooks:
                hook(done - 1)
            if done % self._row_substeps == 0 and done < self.substeps:
                reading = self._read(within_step=True)
                self._finite &= reading.stream_finite
                self.simulation.begin_row()
                self._rows.append(reading.stream)
                for row_hook in self.row_hooks:
                    row_hook(reading.stream)

    def command(self, action: NDArray[np.float32]) -> None:
        """From within a hook: command another action for the rest of the control step, efference copy included.

        Raises:
            ValueError: a wrong shape, or an action that is not finite.
        """
        self._command(self._actions.checked(action))

    def _command(self, action: NDArray[np.float32]) -> None:
        held, self.holding = self.holding, self.holding and self.keeps_holding
        self._action = self._actions.resting(self.simulation, self._action) if held else self.slowed(action)
        self.simulation.command(self._delivered(self._action), held)

    def slowed(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action (A,) at the hand speed that the contact limits allow."""
        limits = self.contact_limits
        if limits is None or not limits.limits_speed:
            return action
        return self._actions.slowed(self.simulation, action, limits.hand_speed)

    @property
    def felt(self) -> NDArray[np.float64]:
        """(K, N) noiseless loads in each physics substep since the row began; see ``felt_channels``."""
        return self.simulation.felt

    def action_for(self, turns: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return the action that moves the arms' joints by ``turns`` from where they are, as nearly as one step can.

        Args:
            turns: [rad] for every joint of every arm, from the base on.

        Returns:
            (A,) in [-1, 1]; 0 for grippers.

        Raises:
            ValueError: the controller is neither OSC_POSE nor JOINT_POSITION.
        """
        return self._actions.turning(self.simulation, np.asarray(turns, np.float64))

    def _delivered(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the action that arrives, in robosuite's units."""
        for deliver in self.deliveries:
            action = np.clip(deliver(action), -1.0, 1.0)
        return self._actions.scaled(action)

    # ------------------------------------------------------------------ senses

    def measure(self) -> NDArray[np.float64]:
        """Read every sensor once, over the time since the last row of the stream: noise, faults, resolution.

        Returns:
            (M,) as ``measured_spec`` names it.
        """
        return self._read().row

    def _read(self, within_step: bool = False) -> Reading:
        rest = self._action, self.corruptions, self.np_random
        return self._senses.read(self.simulation, self._objects, *rest, within_step=within_step)

    def _info(self, success: bool, unstable: bool = False) -> dict[str, Any]:
        info: dict[str, Any] = {"stream": self._reading.stream} if self._senses.stream_spec else {}
        sim = self.simulation
        felt = sim.contact_force, sim.external_force, sim.mean_external_force / self.metadata["render_fps"]
        names = "contact_force", "external_force", "external_impulse"
        forces = dict(zip(names, (np.nan,) * 3 if unstable else felt, strict=True))
        if self.contact_limits is not None:
            passed = sim.passed_limit
            info["contact_load"] = np.inf if unstable else sim.load
            info["contact_left_s"] = np.nan if passed is None else (passed + 1) / PHYSICS_FREQ
            info["contact_felt"] = sim.mean_felt
        return info | {"success": success, **forces, "unstable": unstable}

    def _bad_count(self) -> int:
        """Return how often MuJoCo found the simulation unstable; it resets itself then, and says so nowhere else."""
        return sum(int(self._warning_counts[w]) for w in _BAD)

    @property
    def stream_spec(self) -> StreamSpec:
        """Names the numbers in ``info["stream"]``.

        Raises:
            AttributeError: there is no stream.
        """
        if self._senses.stream_spec is None:
            raise AttributeError("this environment was made with stream=(), so it has no stream")
        return self._senses.stream_spec

    @property
    def measured(self) -> NDArray[np.float64]:
        """The row measured last, laid out as ``measured_spec`` says; a copy."""
        return self._reading.row.copy()

    def force_behind(self, torques: NDArray[np.floating[Any]]) -> tuple[str, NDArray[np.float64]]:
        """Return the link on which a force explains external torques (J,) [N m] best, and that force (3,) [N]."""
        sim = self.simulation
        return force_behind(sim.model, sim.data, sim.motors, sim.dofs, np.asarray(torques, np.float64))

    @property
    def motors(self) -> NDArray[np.intp]:
        """The actuators of the arms' joints, from the base on."""
        return self.simulation.motors

    # ------------------------------------------------------------------ pictures

    def render(self) -> NDArray[Any] | None:
        """Return a picture (height, width, 3) uint8; show it in a window where the ``render_mode`` is ``human``.

        Raises:
            RuntimeError: this machine has nothing to draw with.
        """
        state = self.simulation.model, self.simulation.data
        if self.render_mode == "rgb_array":
            return self._renderer.render(*state)
        if self.render_mode == "human":
            self._window.show(*state)
        else:
            gym.logger.warn("render() does nothing without a render_mode: gym.make(…, render_mode='rgb_array')")
        return None

    def close(self) -> None:
        """Free the renderer and the simulation; may be called more than once."""
        self._renderer.close()
        self._window.close()
        if self.robosuite_env is not None:
            self.robosuite_env.close()
            self.robosuite_env = None
        self._ended = True


def _make(registered: str, task: str, **arguments: Any) -> RobosuiteEnv:
    """Make the task of a Gymnasium id, and no other."""
    identifier = task_spec(registered).id
    if task != registered:
        raise ValueError(f"{identifier} makes {registered}, got task={short_repr(task)}: leave it out")
    if "robots" in arguments:
        raise TypeError(f"{identifier} takes robot=, got robots={short_repr(arguments['robots'])}")
    return RobosuiteEnv(task, **arguments)


def __getattr__(name: str) -> Callable[..., RobosuiteEnv]:
    """Return what Gymnasium calls for the id of a task."""
    if name not in TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    make: Any = partial(_make, name)
    make.metadata = RobosuiteEnv.metadata
    return make  # type: ignore[no-any-return]
