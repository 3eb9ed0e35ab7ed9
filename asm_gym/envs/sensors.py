"""Which channels an arm has, where in the simulation each is read, and what its sensor makes of it.

A contact can come and go inside one control step, so torques, wrenches and contacts are sampled after every physics
substep and summarised (mean, and signed peak: the value of largest magnitude), while positions and velocities are read
at the end of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.mujoco_views import Views
from asm_gym.spec import MOTOR, Channel, StreamSpec

Corruption = Callable[[NDArray[np.float64]], None]
"""A sensor fault: edits a measured row in place."""

GROUPS = ("joint", "torque", "hand", "wrench", "gripper", MOTOR)
"""The channel groups of a stream by default, in the order they stand in a row."""

EXTRA_GROUPS = ("contact", "object")
"""What no real robot measures about itself, for those who ask."""


class _Sensor(NamedTuple):
    """What one reading is worth."""

    noise: float  # standard deviation [unit of the channel]
    resolution: float = 0.0  # step between readings [unit of the channel]; 0 for what is computed from several sensors


_COUNT = np.deg2rad(0.01)
"""[rad]: 15 bits of a turn; the link-side encoders of DLR's light-weight arm, from which the iiwa descends."""

# About what a research arm's own sensors have. Resolutions: DLR, "Joint sensors of the light-weight robot" (0.01°);
# Franka Emika, Panda data sheet (0.02 N m, 13 bits of ±87 N m); ATI Industrial Automation, Gamma SI-130-10 (±130 N in
# steps of 1/20 N, ±10 N m in steps of 1/800 N m). A velocity is the difference of two counts, 50 ms apart. Mean and
# peak come out of the sensor's own filter, in its steps. The rest is computed in floating point from several of these.
_SENSORS = {
    "joint_position": _Sensor(2e-4, _COUNT),
    "joint_velocity": _Sensor(3e-3, _COUNT / 0.05),
    "measured_torque": _Sensor(0.1, 0.02),
    "external_torque": _Sensor(0.15),
    "external_torque_peak": _Sensor(0.3),
    "hand_position": _Sensor(3e-4),
    "hand_orientation": _Sensor(5e-4),
    "hand_velocity": _Sensor(3e-3),
    "hand_angular_velocity": _Sensor(1e-2),
    "wrist_force": _Sensor(0.2, 1 / 20),
    "wrist_force_peak": _Sensor(0.4, 1 / 20),
    "wrist_torque": _Sensor(0.01, 1 / 800),
    "wrist_torque_peak": _Sensor(0.02, 1 / 800),
    "gripper_opening": _Sensor(2e-4),
    "gripper_velocity": _Sensor(2e-3),
    "gripper_force": _Sensor(0.2),
}
_EXACT = _Sensor(0.0)


Stops = tuple[tuple[float, float], ...]


@dataclass
class _Table:
    """Channels, and the index of each of their numbers in what ``Proprioception.sources`` lays end to end."""

    starts: dict[str, int]
    prefix: str
    channels: list[Channel] = field(default_factory=list)
    indices: list[NDArray[np.intp]] = field(default_factory=list)

    def add(self, group: str, name: str, unit: str, source: str, where: Any, stops: Stops = ()) -> None:
        index = np.atleast_1d(np.asarray(where, dtype=np.intp)) + self.starts[source]
        if index.size:
            noise, resolution = _SENSORS.get(name, _EXACT)
            self.channels.append(
                Channel(self.prefix + name, index.size, unit, noise, group, resolution=resolution, stops=stops)
            )
            self.indices.append(index)


class Proprioception:
    """Everything that the arms of one loaded model measure.

    Args:
        parts: robosuite's robots, and which arm of each.
        views: of the model and its data.
    """

    def __init__(self, parts: list[tuple[Any, str]], views: Views, data: mujoco.MjData) -> None:
        shape = (len(parts), kernels.SAMPLE)
        self.mean, self.peak, self.last = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._sources = {
            "mean": self.mean.ravel(),
            "peak": self.peak.ravel(),
            "last": self.last.ravel(),
            "qpos": views.qpos,
            "qvel": views.qvel,
            "ctrl": views.ctrl,
            "force": views.actuator,
            "site": views.site_xpos.ravel(),
            "body": data.xmat.ravel(),
        }
        ends = np.cumsum([a.size for a in self._sources.values()])
        starts = {n: int(e) - a.size for (n, a), e in zip(self._sources.items(), ends, strict=True)}
        tables = [_Table(starts, f"robot{i}_" if len(parts) > 1 else "") for i in range(len(parts))]
        for i, ((robot, arm), table) in enumerate(zip(parts, tables, strict=True)):
            _fill(table, robot, arm, i * kernels.SAMPLE)
        self.channels = tuple(c for t in tables for c in t.channels)
        self._index = np.concatenate([index for t in tables for index in t.indices])
        begins = np.array(list(starts.values()))
        which = np.searchsorted(begins, self._index, side="right") - 1
        self.where = np.stack([which, self._index - begins[which]], axis=1)
        """(P, 2) of each of their numbers the source, and its place there."""
        self.sources = [self.mean, self.peak, self.last, *list(self._sources.values())[3:]]
        """What they are read from."""

    def read(self) -> NDArray[np.float64]:
        """One number for every element of ``channels``; noiseless."""
        values: NDArray[np.float64] = np.concatenate(list(self._sources.values()))[self._index]
        return values


class SensorErrors:
    """What sensors make of the truth: noise, then whatever a fault does, then steps of their resolution.

    Args:
        spec: of the row that is read.
        scale: of the noise; at 0 readings are exact, and in no steps.
    """

    def __init__(self, spec: StreamSpec, scale: float) -> None:
        self.noise = spec.noise * scale
        """(M,) standard deviations."""
        self.steps = spec.resolution if scale else np.zeros(spec.size)
        """(M,) of resolution; 0 for none."""
        self._stepped = np.flatnonzero(self.steps)

    def added(
        self, row: NDArray[np.float64], faults: Sequence[Corruption], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """(M,) the row as it is read; it is changed in place."""
        row += self.noise * rng.standard_normal(row.size)
        for corrupt in faults:
            corrupt(row)
        with np.errstate(over="ignore"):  # of a simulation that diverges
            steps = self.steps[self._stepped]
            row[self._stepped] = np.rint(row[self._stepped] / steps) * steps
        return row


def _fill(table: _Table, robot: Any, arm: str, sample: int) -> None:
    """Adds one arm's channels; ``sample`` is where its samples begin."""
    model = robot.sim.model._model
    site = 3 * robot.eef_site_id[arm]
    body = 9 * mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, robot.robot_model.eef_name[arm])
    gripper = robot.gripper[arm]
    fingers = robot._ref_gripper_joint_pos_indexes[arm] if gripper.joints else []
    finger_velocity = robot._ref_gripper_joint_vel_indexes[arm] if gripper.joints else []
    dofs = np.asarray(robot._ref_joint_vel_indexes)
    n = len(dofs)

    def sampled(part: slice, count: int | None = None, skip: int = 0) -> NDArray[np.intp]:
        return np.arange(part.start + skip, part.stop)[:count] + sample

    joints = robot._ref_joint_indexes
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], (-np.inf, np.inf))
    stops = tuple((float(low), float(high)) for low, high in ranges) if model.jnt_limited[joints].any() else ()
    table.add("joint", "joint_position", "rad", "qpos", robot._ref_joint_pos_indexes, stops)
    table.add("joint", "joint_velocity", "rad/s", "qvel", dofs)
    table.add("torque", "commanded_torque", "N m", "ctrl", robot._ref_actuators_indexes_dict[arm])
    table.add("torque", "measured_torque", "N m", "mean", sampled(kernels.MOTOR, n))
    table.add("torque", "external_torque", "N m", "mean", sampled(kernels.EXTERNAL, n))
    table.add("torque", "external_torque_peak", "N m", "peak", sampled(kernels.EXTERNAL, n))
    table.add("hand", "hand_position", "m", "site", site + np.arange(3))
    # The first two columns of the rotation: six numbers that turn smoothly, where a quaternion flips its sign.
    table.add("hand", "hand_orientation", "1", "body", body + np.array([0, 3, 6, 1, 4, 7]))
    table.add("hand", "hand_velocity", "m/s", "last", sampled(kernels.VELOCITY, 3))
    table.add("hand", "hand_angular_velocity", "rad/s", "last", sampled(kernels.VELOCITY, 3, 3))
    table.add("wrench", "wrist_force", "N", "mean", sampled(kernels.WRENCH, 3))
    table.add("wrench", "wrist_torque", "N m", "mean", sampled(kernels.WRENCH, 3, 3))
    table.add("wrench", "wrist_force_peak", "N", "peak", sampled(kernels.WRENCH, 3))
    table.add("wrench", "wrist_torque_peak", "N m", "peak", sampled(kernels.WRENCH, 3, 3))
    # Fingers slide or turn, by the gripper.
    slides = [model.jnt_type[model.dof_jntid[d]] == mujoco.mjtJoint.mjJNT_SLIDE for d in finger_velocity]
    length, force = ("m", "N") if all(slides) else ("rad", "N m")
    table.add("gripper", "gripper_opening", length, "qpos", fingers)
    table.add("gripper", "gripper_velocity", f"{length}/s", "qvel", finger_velocity)
    table.add("gripper", "gripper_force", force, "force", finger_velocity)
    table.add("contact", "contact_force", "N", "mean", sampled(kernels.CONTACT))
    table.add("contact", "contact_force_peak", "N", "peak", sampled(kernels.CONTACT))
