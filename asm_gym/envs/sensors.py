"""The channels of an arm, where in the simulation each is read, and the errors of its sensor; and rows of readings.

A contact can come and go inside one control step, so torques, wrenches and contacts are sampled after every physics
substep and summarised (mean, and signed peak: the value of largest magnitude), while positions and velocities are read
at the end of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.mujoco_views import Views
from asm_gym.spec import MOTOR, Channel, StreamSpec

if TYPE_CHECKING:
    from asm_gym.envs.backend import ObjectSensors

Corruption = Callable[[NDArray[np.float64]], None]  # a sensor fault: edits a measured row in place
GROUPS = ("joint", "torque", "hand", "wrench", "gripper", MOTOR)
"""The channel groups of a stream by default, in the order of a row."""

EXTRA_GROUPS = ("contact", "object")  # groups that no real robot measures about itself


class _Sensor(NamedTuple):
    """One channel of an arm."""

    name: str
    group: str
    unit: str  # of fingers that slide; see ``_TURNING``
    source: str  # a key of ``Proprioception._sources``
    part: slice | str  # of a sample, or a key of ``_indices``
    noise: float = 0.0  # standard deviation [unit]
    resolution: float = (
        0.0  # step between readings [unit]; 0 for what is computed from several sensors
    )


_COUNT = np.deg2rad(0.01)
"""[rad]: 15 bits of a turn; the link-side encoders of DLR's light-weight arm, from which the iiwa descends."""

_FORCE, _TORQUE = (slice(kernels.WRENCH.start + i, kernels.WRENCH.start + i + 3) for i in (0, 3))
_LINEAR, _ANGULAR = (
    slice(kernels.VELOCITY.start + i, kernels.VELOCITY.start + i + 3) for i in (0, 3)
)

# About what a research arm's own sensors have. Resolutions: DLR, "Joint sensors of the light-weight robot" (0.01°);
# Franka Emika, Panda data sheet (0.02 N m, 13 bits of ±87 N m); ATI Industrial Automation, Gamma SI-130-10 (±130 N in
# steps of 1/20 N, ±10 N m in steps of 1/800 N m). A velocity is the difference of two counts, 50 ms apart. Mean and
# peak come out of the sensor's own filter, in its steps. The rest is computed in floating point from several of these.
_SENSORS = (
    _Sensor("joint_position", "joint", "rad", "qpos", "joints", 2e-4, _COUNT),
    _Sensor("joint_velocity", "joint", "rad/s", "qvel", "dofs", 3e-3, _COUNT / 0.05),
    _Sensor("commanded_torque", "torque", "N m", "ctrl", "motors"),
    _Sensor("measured_torque", "torque", "N m", "mean", kernels.MOTOR, 0.1, 0.02),
    _Sensor("external_torque", "torque", "N m", "mean", kernels.EXTERNAL, 0.15),
    _Sensor("external_torque_peak", "torque", "N m", "peak", kernels.EXTERNAL, 0.3),
    _Sensor("hand_position", "hand", "m", "site", "hand", 3e-4),
    _Sensor("hand_orientation", "hand", "1", "body", "turn", 5e-4),
    _Sensor("hand_velocity", "hand", "m/s", "last", _LINEAR, 3e-3),
    _Sensor("hand_angular_velocity", "hand", "rad/s", "last", _ANGULAR, 1e-2),
    _Sensor("wrist_force", "wrench", "N", "mean", _FORCE, 0.2, 1 / 20),
    _Sensor("wrist_torque", "wrench", "N m", "mean", _TORQUE, 0.01, 1 / 800),
    _Sensor("wrist_force_peak", "wrench", "N", "peak", _FORCE, 0.4, 1 / 20),
    _Sensor("wrist_torque_peak", "wrench", "N m", "peak", _TORQUE, 0.02, 1 / 800),
    _Sensor("gripper_opening", "gripper", "m", "qpos", "fingers", 2e-4),
    _Sensor("gripper_velocity", "gripper", "m/s", "qvel", "finger_dofs", 2e-3),
    _Sensor("gripper_force", "gripper", "N", "force", "finger_dofs", 0.2),
    _Sensor("contact_force", "contact", "N", "mean", kernels.CONTACT),
    _Sensor("contact_force_peak", "contact", "N", "peak", kernels.CONTACT),
)
_TURNING = {"m": "rad", "m/s": "rad/s", "N": "N m"}  # units of a gripper whose fingers turn


class Proprioception:
    """Everything that the arms of one loaded model measure."""

    def __init__(self, parts: list[tuple[Any, str]], views: Views, data: mujoco.MjData) -> None:
        shape = (len(parts), kernels.SAMPLE)
        self.mean, self.peak, self.last = np.zeros(shape), np.zeros(shape), np.zeros(shape)
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
        channels, where, names = [], [], list(sources)
        for i, (robot, arm) in enumerate(parts):
            indices, slides, stops = _indices(robot, arm)
            joints = len(indices["joints"])
            for sensor in _SENSORS:
                if isinstance(sensor.part, str):
                    at = indices[sensor.part]
                else:
                    at = np.arange(sensor.part.start, sensor.part.stop) + i * kernels.SAMPLE
                    at = at[:joints] if sensor.group == "torque" else at
                if not len(at):
                    continue
                unit = (
                    _TURNING[sensor.unit]
                    if sensor.group == "gripper" and not slides
                    else sensor.unit
                )
                name = (f"robot{i}_" if len(parts) > 1 else "") + sensor.name
                ends = stops if sensor.name == "joint_position" else ()
                about = len(at), unit, sensor.noise, sensor.group
                channels.append(Channel(name, *about, resolution=sensor.resolution, stops=ends))
                where += [(names.index(sensor.source), int(k)) for k in at]
        self.channels = tuple(channels)
        # (P, 2) of each number its source and its index there
        self.where = np.array(where, np.int64)


def _indices(
    robot: Any, arm: str
) -> tuple[dict[str, NDArray[np.intp]], bool, tuple[tuple[float, float], ...]]:
    """Return where an arm's sensors read, whether its fingers slide, and the joints' stops where any has some [rad]."""
    model = robot.sim.model._model
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, robot.robot_model.eef_name[arm])
    fingers = robot.gripper[arm].joints
    finger_dofs = np.asarray(robot._ref_gripper_joint_vel_indexes[arm] if fingers else [], np.intp)
    indices = {
        "joints": robot._ref_joint_pos_indexes,
        "dofs": robot._ref_joint_vel_indexes,
        "motors": robot._ref_actuators_indexes_dict[arm],
        "hand": 3 * robot.eef_site_id[arm] + np.arange(3),
        # The first two columns of the rotation: six numbers that turn smoothly, where a quaternion flips its sign.
        "turn": 9 * body + np.array([0, 3, 6, 1, 4, 7]),
        "fingers": robot._ref_gripper_joint_pos_indexes[arm] if fingers else [],
        "finger_dofs": finger_dofs,
    }
    slides = all(
        model.jnt_type[model.dof_jntid[d]] == mujoco.mjtJoint.mjJNT_SLIDE for d in finger_dofs
    )
    joints = robot._ref_joint_indexes
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], (-np.inf, np.inf))
    stops = (
        tuple((float(low), float(high)) for low, high in ranges)
        if model.jnt_limited[joints].any()
        else ()
    )
    return {name: np.asarray(at, np.intp) for name, at in indices.items()}, slides, stops


# Channels of the robot that a policy observes: configuration and motion, no torques.
_OBSERVED = (
    *("joint_position", "joint_velocity", "hand_position", "hand_orientation"),
    *("gripper_opening", "gripper_velocity"),
)
_BOUND = (
    kernels.OBSERVED_BOUND
)  # observations are clipped to this, which keeps the Box true; nothing a task does comes near it


class Reading(NamedTuple):
    """One row of measurements."""

    row: NDArray[np.float64]  # (M,) everything
    stream: NDArray[np.float32]  # (D,) the part that the stream carries
    seen: NDArray[np.float32]  # (S,) the part that is observed; finite whatever the row holds
    row_finite: bool  # before faults
    stream_finite: bool


class Senses:
    """Reads the sensors of one environment."""

    def __init__(
        self,
        channels: Sequence[Channel],  # of the arms and objects
        actions: int,  # size of an action
        dt: float,
        source: str,
        groups: Sequence[str],  # of the channels that the stream carries
        noise: float,  # scale of the sensors' noise; at 0 readings are exact, without resolution
        flat: bool,  # observations are one array, not a dict of named ones
    ) -> None:
        spec = self.measured_spec = StreamSpec(
            (*channels, Channel("action", actions, "1", 0.0, MOTOR)), dt, source
        )
        """Everything that is measured, whether or not the stream carries it."""
        chosen = tuple(c for c in spec.channels if c.group in groups)
        self.stream_spec = StreamSpec(chosen, dt, source) if chosen else None
        self._carried = _columns(spec, [c.name for c in chosen])
        self._noise = spec.noise * noise
        self._steps = spec.resolution if noise else np.zeros(spec.size)
        self._needs_objects = "object" in groups
        names = [c.name for c in spec.channels if c.name.endswith(_OBSERVED) or c.group == "object"]
        self._observed = _columns(spec, names)
        self._flat = flat
        self.sizes = {name: spec.slices[name].stop - spec.slices[name].start for name in names}
        """The observation's parts in order, and how many numbers each has."""
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        self._parts = dict(zip(names, map(slice, ends, ends[1:]), strict=False))

    def read(
        self,
        sense: Callable[
            [NDArray[np.float64], NDArray[np.float64], np.random.Generator], NDArray[np.float64]
        ],
        objects: ObjectSensors,
        action: NDArray[np.float32],
        faults: Sequence[Corruption],
        rng: np.random.Generator,
        within_step: bool = False,
    ) -> Reading:
        """Read every sensor once, over the time since the last row of the stream: noise, faults, resolution.

        Within a step, objects keep their last pose if the stream does not carry them.
        """
        if faults or self._needs_objects or not within_step:
            self._object_poses = objects.read()
        row = sense(
            np.concatenate([*self._object_poses, action], dtype=np.float64), self._noise, rng
        )
        # a fault that reads NaN is no fault of the simulation
        sound = bool(np.isfinite(row).all()) if faults else None
        for corrupt in faults:
            corrupt(row)
        stream, seen = (
            np.empty(len(self._carried), np.float32),
            np.empty(len(self._observed), np.float32),
        )
        finite = kernels.finish(row, self._steps, self._carried, stream, self._observed, seen)
        return Reading(row, stream, seen, *(finite if sound is None else (sound, sound)))

    def space(self) -> spaces.Space[Any]:
        """Return the space of observations."""
        if self._flat:
            return _box(len(self._observed))
        return spaces.Dict({name: _box(size) for name, size in self.sizes.items()})

    def observation(self, reading: Reading) -> Any:
        """Return the observation of a reading."""
        return (
            reading.seen
            if self._flat
            else {name: reading.seen[part] for name, part in self._parts.items()}
        )


def _box(size: int) -> spaces.Space[Any]:
    return spaces.Box(-_BOUND, _BOUND, (size,), np.float32)


def _columns(spec: StreamSpec, names: list[str]) -> NDArray[np.intp]:
    return np.array([i for n in names for i in range(spec.size)[spec.slices[n]]], dtype=np.intp)
