r"""Proprioception: reads a robot arm's sensors from the simulator, at every physics substep where it matters.

A contact can come and go inside one control step, so torques and wrenches are summarised over its substeps (mean, and
signed peak: the value of largest magnitude) while positions and velocities are read at its end.

External joint torque is what the motors and the nominal dynamics do not explain,

    τ_ext = M(q) q̈ + h(q, q̇) - τ_passive - τ_motor,

the quantity a momentum observer estimates (Haddadin, De Luca, Albu-Schäffer 2017, Eq. 15 at infinite gain).
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.stream import MOTOR, Channel

GROUPS = ("joint", "torque", "hand", "wrench", "gripper", MOTOR)
"""Channel groups in the order they stand in a row; ``object`` can be asked for besides."""

# Standard deviations of the noise, about what a research arm's own sensors have (Franka, Robotiq and ATI data sheets).
_NOISE = {
    "joint_position": 2e-4,
    "joint_velocity": 3e-3,
    "commanded_torque": 0.0,
    "measured_torque": 0.1,
    "external_torque": 0.15,
    "external_torque_peak": 0.3,
    "hand_position": 3e-4,
    "hand_orientation": 5e-4,
    "hand_velocity": 3e-3,
    "hand_angular_velocity": 1e-2,
    "wrist_force": 0.2,
    "wrist_force_peak": 0.4,
    "wrist_torque": 0.01,
    "wrist_torque_peak": 0.02,
    "gripper_opening": 2e-4,
    "gripper_velocity": 2e-3,
    "gripper_force": 0.2,
}


class ArmSensors:
    """The sensors of one arm with its gripper.

    Args:
        robot: robosuite's robot.
        arm: ``right`` or ``left``.
        prefix: stands before each channel's name, empty for a lone arm.
    """

    def __init__(self, robot: Any, arm: str, prefix: str, substeps: int) -> None:
        sim = robot.sim
        self.model: mujoco.MjModel = sim.model._model
        self.data: mujoco.MjData = sim.data._data
        per_arm = slice(None)
        if len(robot.arms) > 1:
            half = len(robot._ref_joint_pos_indexes) // 2
            per_arm = slice(0, half) if arm == "right" else slice(half, None)
        self._qpos = np.asarray(robot._ref_joint_pos_indexes)[per_arm]
        self._qvel = np.asarray(robot._ref_joint_vel_indexes)[per_arm]
        self.motors = np.asarray(robot._ref_actuators_indexes_dict[arm])
        self._site = robot.eef_site_id[arm]
        self._hand = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, robot.robot_model.eef_name[arm])
        gripper = robot.gripper[arm]
        self._fingers = np.asarray(robot._ref_gripper_joint_pos_indexes[arm] if gripper.joints else [], dtype=int)
        self._finger_vel = np.asarray(robot._ref_gripper_joint_vel_indexes[arm] if gripper.joints else [], dtype=int)
        self._wrench = self._sensor_slice(gripper)
        self.joint_names = tuple(str(name) for name in np.asarray(robot.robot_joints)[per_arm])
        n = len(self._qpos)
        self._n = n
        self.channels = self._channels(prefix, n)
        # Per substep: external torque, measured torque, wrist force and torque, gripper force.
        self._fast = np.zeros((substeps, 2 * n + 6))
        self._ma = np.zeros(self.model.nv)
        self._k = 0
        self._velocity = np.zeros(6)

    def _sensor_slice(self, gripper: Any) -> slice:
        sensors = gripper.important_sensors
        adr = self.model.sensor_adr
        ids = [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SENSOR, sensors[k]) for k in ("force_ee", "torque_ee")]
        if adr[ids[1]] != adr[ids[0]] + 3:
            raise RuntimeError("the wrist's force and torque sensors are expected side by side")
        return slice(int(adr[ids[0]]), int(adr[ids[0]]) + 6)

    def _channels(self, prefix: str, n: int) -> tuple[Channel, ...]:
        rows: list[tuple[str, str, int, str]] = [
            ("joint", "joint_position", n, "rad"),
            ("joint", "joint_velocity", n, "rad/s"),
            ("torque", "commanded_torque", n, "N m"),
            ("torque", "measured_torque", n, "N m"),
            ("torque", "external_torque", n, "N m"),
            ("torque", "external_torque_peak", n, "N m"),
            ("hand", "hand_position", 3, "m"),
            ("hand", "hand_orientation", 6, "1"),
            ("hand", "hand_velocity", 3, "m/s"),
            ("hand", "hand_angular_velocity", 3, "rad/s"),
            ("wrench", "wrist_force", 3, "N"),
            ("wrench", "wrist_torque", 3, "N m"),
            ("wrench", "wrist_force_peak", 3, "N"),
            ("wrench", "wrist_torque_peak", 3, "N m"),
        ]
        if len(self._fingers):
            rows += [
                ("gripper", "gripper_opening", len(self._fingers), "m"),
                ("gripper", "gripper_velocity", len(self._fingers), "m/s"),
                ("gripper", "gripper_force", len(self._fingers), "N"),
            ]
        return tuple(Channel(prefix + name, size, unit, _NOISE[name], group) for group, name, size, unit in rows)

    def start(self) -> None:
        """Before a control step."""
        self._k = 0

    def sample(self) -> None:
        """After a physics substep."""
        model, data, n = self.model, self.data, self._n
        row = self._fast[self._k]
        mujoco.mj_mulM(model, data, self._ma, data.qacc)
        motor = data.qfrc_actuator[self._qvel]
        row[:n] = self._ma[self._qvel] + data.qfrc_bias[self._qvel] - data.qfrc_passive[self._qvel] - motor
        row[n : 2 * n] = motor
        row[2 * n :] = data.sensordata[self._wrench]
        self._k += 1

    def read(self) -> NDArray[np.float64]:
        """One value for every element of ``channels``, over the substeps sampled since ``start``; noiseless."""
        data, n = self.data, self._n
        fast = self._fast[: self._k] if self._k else np.zeros((1, self._fast.shape[1]))
        mean = fast.mean(axis=0)
        peak = np.take_along_axis(fast, np.abs(fast).argmax(axis=0)[None], axis=0)[0]
        mujoco.mj_objectVelocity(
            self.model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, self._velocity, 0
        )  # angular first, in the world's axes
        rotation = data.xmat[self._hand].reshape(3, 3)
        parts = [
            data.qpos[self._qpos],
            data.qvel[self._qvel],
            data.ctrl[self.motors],
            mean[n : 2 * n],
            mean[:n],
            peak[:n],
            data.site_xpos[self._site],
            rotation[:, 0],
            rotation[:, 1],
            self._velocity[3:],
            self._velocity[:3],
            mean[2 * n :],
            peak[2 * n :],
        ]
        if len(self._fingers):
            parts += [data.qpos[self._fingers], data.qvel[self._finger_vel], data.qfrc_actuator[self._finger_vel]]
        return np.concatenate(parts)


class ContactForce:
    """Net contact force on the robot: the norm of the summed contact forces on all its bodies [N].

    A grasp's own squeeze cancels in the sum; what the world does to the robot stays. Loads that a fault applies are
    not contacts and are left out.
    """

    def __init__(self, robots: list[Any]) -> None:
        sim = robots[0].sim
        self.data: mujoco.MjData = sim.data._data
        model: mujoco.MjModel = sim.model._model
        roots = {r.robot_model.root_body for r in robots}
        root_ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in roots]
        self._bodies = np.flatnonzero(np.isin(model.body_rootid, root_ids))
        self.peak = 0.0

    def start(self) -> None:
        self.peak = 0.0

    def sample(self) -> None:
        force = self.data.cfrc_ext[self._bodies, 3:].sum(axis=0) - self.data.xfrc_applied[self._bodies, :3].sum(axis=0)
        norm = float(np.sqrt(force @ force))
        # NaN compares false, so an unstable simulation cannot hide behind an old peak.
        if not norm <= self.peak:
            self.peak = norm
