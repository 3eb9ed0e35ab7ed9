"""The channels of an arm, where in the simulation each is read, and the errors of its sensor; and rows of readings.

A contact can come and go inside one control step, so torques, wrenches and contacts are sampled after every physics
substep and summarised (mean, and signed peak: the value of largest magnitude), while positions and velocities are read
at the end of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.detection.channel_columns import columns_where
from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.arms import Part, joint_ranges, prefix_of
from asm_gym.envs.mujoco_views import Floats, Ints, Views
from asm_gym.spec import HANDLED, MOTOR, Channel, StreamSpec

if TYPE_CHECKING:
    from asm_gym.envs.robosuite_backend import ObjectSensors
    from asm_gym.envs.simulated_tracker import HandledObjects

Corruption = Callable[[NDArray[np.float64]], None]  # a sensor fault: edits a measured row in place
GROUPS = ("joint", "torque", "hand", "wrench", "gripper", HANDLED, MOTOR)
"""The channel groups of a stream by default, in the order of a row."""

EXTRA_GROUPS = ("contact", "object")  # what no real robot measures


class _Sensor(NamedTuple):
    """One channel of an arm."""

    name: str
    group: str
    unit: str  # of fingers that slide; see ``_TURNING``
    source: str  # an array of ``Proprioception.__init__``
    part: slice | str  # of a sample, or a key of ``_indices_by_part``
    noise: float = 0.0  # standard deviation [unit]
    # step between readings [unit]; 0 for what is computed from several sensors
    resolution: float = 0.0
    commanded: bool = False  # put out by a controller: it predicts, and is not judged


# 15 bits of a turn [rad]: the link-side encoders of DLR's light-weight arm, the iiwa's ancestor.
_COUNT = np.deg2rad(0.01)

_FORCE = slice(kernels.WRENCH.start, kernels.WRENCH.start + 3)
_TORQUE = slice(kernels.WRENCH.start + 3, kernels.WRENCH.stop)
_LINEAR = slice(kernels.VELOCITY.start, kernels.VELOCITY.start + 3)
_ANGULAR = slice(kernels.VELOCITY.start + 3, kernels.VELOCITY.stop)

# About what a research arm's own sensors have. Resolutions: DLR, "Joint sensors of the light-weight
# robot" (0.01°); Franka Emika, Panda data sheet (0.02 N m, 13 bits of ±87 N m); ATI Industrial
# Automation, Gamma SI-130-10 (±130 N in steps of 1/20 N, ±10 N m in steps of 1/800 N m). A velocity
# is the difference of two counts, 50 ms apart. Mean and peak come out of the sensor's own filter,
# in its steps. The rest is computed in floating point from several of these.
_SENSORS = (
    _Sensor("joint_position", "joint", "rad", "qpos", "joints", noise=2e-4, resolution=_COUNT),
    _Sensor(
        "joint_velocity", "joint", "rad/s", "qvel", "dofs", noise=3e-3, resolution=_COUNT / 0.05
    ),
    _Sensor("commanded_torque", "torque", "N m", "ctrl", "motors", commanded=True),
    _Sensor("measured_torque", "torque", "N m", "mean", kernels.MOTOR, noise=0.1, resolution=0.02),
    _Sensor("external_torque", "torque", "N m", "mean", kernels.EXTERNAL, noise=0.15),
    _Sensor("external_torque_peak", "torque", "N m", "peak", kernels.EXTERNAL, noise=0.3),
    _Sensor("hand_position", "hand", "m", "site", "hand", noise=3e-4),
    _Sensor("hand_orientation", "hand", "1", "body", "turn", noise=5e-4),
    _Sensor("hand_velocity", "hand", "m/s", "last", _LINEAR, noise=3e-3),
    _Sensor("hand_angular_velocity", "hand", "rad/s", "last", _ANGULAR, noise=1e-2),
    _Sensor("wrist_force", "wrench", "N", "mean", _FORCE, noise=0.2, resolution=1 / 20),
    _Sensor("wrist_torque", "wrench", "N m", "mean", _TORQUE, noise=0.01, resolution=1 / 800),
    _Sensor("wrist_force_peak", "wrench", "N", "peak", _FORCE, noise=0.4, resolution=1 / 20),
    _Sensor("wrist_torque_peak", "wrench", "N m", "peak", _TORQUE, noise=0.02, resolution=1 / 800),
    _Sensor("gripper_opening", "gripper", "m", "qpos", "fingers", noise=2e-4),
    _Sensor("gripper_velocity", "gripper", "m/s", "qvel", "finger_dofs", noise=2e-3),
    _Sensor("gripper_force", "gripper", "N", "force", "finger_dofs", noise=0.2),
    _Sensor("contact_force", "contact", "N", "mean", kernels.CONTACT),
    _Sensor("contact_force_peak", "contact", "N", "peak", kernels.CONTACT),
)
_TURNING = {"m": "rad", "m/s": "rad/s", "N": "N m"}  # units of a gripper whose fingers turn


class Proprioception:
    """Everything that the arms of one loaded model measure."""

    def __init__(self, parts: list[Part], views: Views, data: mujoco.MjData) -> None:
        shape = (len(parts), kernels.SAMPLE)
        self.mean = np.zeros(shape)
        self.peak = np.zeros(shape)
        self.last = np.zeros(shape)
        sources = {
            "mean": self.mean.ravel(),
            "peak": self.peak.ravel(),
            "last": self.last.ravel(),
            "qpos": views.qpos,
            "qvel": views.qvel,
            "ctrl": views.ctrl,
            "force": views.qfrc_actuator,
            "site": views.site_xpos.ravel(),
            "body": data.xmat.ravel(),
        }
        self.sources = tuple(sources.values())  # arrays that the sensors read
        names = list(sources)
        channels: list[Channel] = []
        places: list[tuple[int, int]] = []
        for a, part in enumerate(parts):
            prefix = prefix_of(a, len(parts))
            indices_of = _indices_by_part(part)
            for sensor in _SENSORS:
                indices = _indices(sensor, a, indices_of)
                if len(indices) == 0:
                    continue
                channels.append(_channel(sensor, prefix, len(indices), part))
                source = names.index(sensor.source)
                places += [(source, int(i)) for i in indices]
        self.channels = tuple(channels)
        # (P, 2) of each number its source and its index there
        self.places = np.array(places, np.int64)


def _indices_by_part(part: Part) -> dict[str, Any]:
    """Return where in their sources an arm's sensors read, by ``_Sensor.part``."""
    robot, arm = part
    hand = robot.sim.model._model.body(robot.robot_model.eef_name[arm]).id
    indices = {
        "joints": robot._ref_joint_pos_indexes,
        "dofs": robot._ref_joint_vel_indexes,
        "motors": robot._ref_actuators_indexes_dict[arm],
        "hand": 3 * robot.eef_site_id[arm] + np.arange(3),
        # The first two columns of the rotation: six numbers that turn smoothly; a quaternion flips
        # its sign.
        "turn": 9 * hand + np.array([0, 3, 6, 1, 4, 7]),
        "fingers": (),
        "finger_dofs": (),
    }
    if robot.gripper[arm].joints:
        indices["fingers"] = robot._ref_gripper_joint_pos_indexes[arm]
        indices["finger_dofs"] = robot._ref_gripper_joint_vel_indexes[arm]
    return indices


def _indices(sensor: _Sensor, a: int, indices_of: dict[str, Any]) -> Any:
    """Return the indices in its source that a sensor of arm ``a`` reads; none where the arm has no such part."""
    if isinstance(sensor.part, str):
        return indices_of[sensor.part]
    in_sample = np.arange(sensor.part.start, sensor.part.stop)
    indices = a * kernels.SAMPLE + in_sample
    if sensor.group == "torque":
        return indices[: len(indices_of["joints"])]
    return indices


def _channel(sensor: _Sensor, prefix: str, size: int, part: Part) -> Channel:
    """Return the channel of a sensor."""
    unit = sensor.unit
    if sensor.group == "gripper" and not _fingers_slide(part):
        unit = _TURNING[unit]
    stops: tuple[tuple[float, float], ...] = ()
    if sensor.name == "joint_position":
        stops = _joint_stops(part)
    return Channel(
        name=prefix + sensor.name,
        size=size,
        unit=unit,
        noise=sensor.noise,
        group=sensor.group,
        resolution=sensor.resolution,
        stops=stops,
        commanded=sensor.commanded,
    )


def _fingers_slide(part: Part) -> bool:
    robot, arm = part
    model = robot.sim.model._model
    joints = model.dof_jntid[robot._ref_gripper_joint_vel_indexes[arm]]
    return bool((model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE).all())


def _joint_stops(part: Part) -> tuple[tuple[float, float], ...]:
    """Return the least and the most of each joint [rad]; none where no joint has stops."""
    robot, _ = part
    model = robot.sim.model._model
    ranges = joint_ranges(model, robot._ref_joint_indexes)
    if not np.isfinite(ranges).any():
        return ()
    return tuple((float(low), float(high)) for low, high in ranges)


# Channels of the robot that a policy observes: configuration and motion, no torques.
_OBSERVED = (
    "joint_position",
    "joint_velocity",
    "hand_position",
    "hand_orientation",
    "gripper_opening",
    "gripper_velocity",
)


class Reading(NamedTuple):
    """One row of measurements."""

    row: Floats  # (M,) everything
    stream: NDArray[np.float32]  # (D,) the part that the stream carries
    seen: NDArray[np.float32]  # (S,) the part that is observed; finite whatever the row holds
    row_finite: bool  # before faults
    stream_finite: bool


class Senses:
    """Reads the sensors of one environment.

    Args:
        spec: everything that is measured, whether or not the stream carries it.
        groups: of the channels that the stream carries.
        noise: scale of the sensors' noise; at 0 readings are exact, without resolution.
        flat: observations are one array, not a dict of named ones.
    """

    def __init__(
        self, spec: StreamSpec, groups: Sequence[str], noise: float, flat: bool = True
    ) -> None:
        self.measured_spec = spec
        chosen = tuple(c for c in spec.channels if c.group in groups)
        self.stream_spec: StreamSpec | None = None
        if chosen:
            self.stream_spec = replace(spec, channels=chosen)
        self._carried = _columns(spec, [c.name for c in chosen])
        self._tracked = columns_where(spec, lambda channel: channel.group == HANDLED)
        # The tracker's readings have their noise already.
        self._noise = np.delete(spec.noise, self._tracked) * noise
        self._resolution = spec.resolution
        if noise == 0:
            self._resolution = np.zeros(spec.size)
        self._needs_objects = "object" in groups

        names = [c.name for c in spec.channels if c.name.endswith(_OBSERVED) or c.group == "object"]
        self._observed = _columns(spec, names)
        self._flat = flat
        self.sizes: dict[str, int] = {}
        """The observation's parts in order, and how many numbers each has."""
        self._parts: dict[str, slice] = {}
        start = 0
        for name in names:
            size = spec.slices[name].stop - spec.slices[name].start
            self.sizes[name] = size
            self._parts[name] = slice(start, start + size)
            start += size

    def read(
        self,
        sense: Callable[[Floats, Floats, np.random.Generator], Floats],
        objects: ObjectSensors,
        action: NDArray[np.float32],
        faults: Sequence[Corruption],
        rng: np.random.Generator,
        within_step: bool = False,
        tracker: HandledObjects | None = None,
    ) -> Reading:
        """Read every sensor once, over the time since the last row of the stream: noise, faults, resolution.

        Within a step, objects keep their last pose if the stream does not carry them. ``tracker`` tells of handled
        objects, where there are channels of ``HANDLED``.
        """
        if faults or self._needs_objects or not within_step:
            self._object_poses = objects.read()
        other_values = np.concatenate([*self._object_poses, action], dtype=np.float64)
        row = sense(other_values, self._noise, rng)
        was_finite = True
        if faults or tracker is not None:
            was_finite = bool(np.isfinite(row).all())
        if tracker is not None:
            place = self._tracked[0]
            row = np.concatenate([row[:place], tracker.read(), row[place:]])
        for corrupt in faults:
            corrupt(row)

        stream = np.empty(len(self._carried), np.float32)
        observed = np.empty(len(self._observed), np.float32)
        row_finite, stream_finite = kernels.finish(
            row, self._resolution, self._carried, stream, self._observed, observed
        )
        # A fault that reads NaN, or a pose that is missing, is no fault of the simulation.
        if faults or tracker is not None:
            row_finite = was_finite
            stream_finite = was_finite
        return Reading(
            row=row,
            stream=stream,
            seen=observed,
            row_finite=row_finite,
            stream_finite=stream_finite,
        )

    def space(self) -> spaces.Space[Any]:
        """Return the space of observations."""
        if self._flat:
            return _box(len(self._observed))
        return spaces.Dict({name: _box(size) for name, size in self.sizes.items()})

    def observation(self, reading: Reading) -> Any:
        """Return the observation of a reading."""
        if self._flat:
            return reading.seen
        return {name: reading.seen[part] for name, part in self._parts.items()}


def _box(size: int) -> spaces.Space[Any]:
    # Clipped to these bounds, observations are within the Box.
    return spaces.Box(-kernels.OBSERVED_BOUND, kernels.OBSERVED_BOUND, (size,), np.float32)


def _columns(spec: StreamSpec, names: list[str]) -> Ints:
    numbers = np.arange(spec.size)
    columns = [numbers[:0], *(numbers[spec.slices[name]] for name in names)]
    return np.concatenate(columns)
