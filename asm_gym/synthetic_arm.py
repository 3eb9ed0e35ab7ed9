"""Simulate a synthetic arm at 100 Hz without a simulator: seven coupled joints that follow commanded velocities.

    M v̇ = τ - g(q) - f(3 D v + D tanh(20 v)/2)   D: the diagonal of M;  g with a load that is drawn for each episode
    τ   = 60 D (u - v) + ĝ(q)                     the drive: a velocity loop, with gravity compensated for a load of 1

A payload of m kg at the hand adds m g times the horizontal distance from each joint that bears gravity to the hand.
Masses and gains resemble those of a seven-joint arm of 20 kg.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.spec import MOTOR, Channel, StreamSpec

Floats = NDArray[np.float64]
JOINTS = 7
SUBSTEPS = 10  # of the simulation in a control step
CONTROL_PERIOD_S = 0.01  # control period [s]
FASTEST_COMMAND = 3.0  # command [rad/s]
MASS = np.array([2.5, 2.5, 1.5, 1.5, 0.5, 0.5, 0.2])  # [kg m²]
GRAVITY_TORQUE = np.array([0.0, 30.0, 10.0, 12.0, 2.0, 1.5, 0.0])  # [N m]
LINK_LENGTHS = np.array([0.3, 0.3, 0.25, 0.2, 0.1, 0.08, 0.05])  # [m]
STANDARD_GRAVITY = 9.81  # [m/s²]
COUPLING = 0.15  # between neighbouring joints, as a share of the geometric mean of their masses


@compiled
def _gravity(position: Floats) -> Floats:
    """Return the torques (7,) that hold the arm with a load of 1."""
    return GRAVITY_TORQUE * np.sin(np.cumsum(position) + 0.5)


@compiled
def _payload_torque(position: Floats) -> Floats:
    """Return the torques (7,) by which a payload of 1 kg at the hand loads the joints that bear gravity."""
    lever = LINK_LENGTHS * np.sin(np.cumsum(position) + 0.5)  # horizontal extent of each link [m]
    torque = np.zeros(JOINTS)
    beyond = 0.0
    for joint in range(JOINTS - 1, -1, -1):
        beyond += lever[joint]
        if GRAVITY_TORQUE[joint] > 0:
            torque[joint] = STANDARD_GRAVITY * beyond
    return torque


@compiled
def _advance(
    q: Floats, v: Floats, command: Floats, loads: tuple[float, float, float], inverse: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return position, velocity and torque (7,) after a control step.

    Args:
        q: positions (7,) [rad].
        v: velocities (7,) [rad/s].
        command: commanded velocities (7,) [rad/s].
        loads: of the links, 1 where the drive compensates for all; the payload [kg]; friction, 1 that of a new arm.
        inverse: of M.
    """
    load, payload, friction = loads
    dt = CONTROL_PERIOD_S / SUBSTEPS
    torque = command
    for _ in range(SUBSTEPS):
        compensated = _gravity(q)
        torque = 60 * MASS * (command - v) + compensated
        rubbing = friction * (3 * MASS * v + 0.5 * MASS * np.tanh(20 * v))
        weight = load * compensated + payload * _payload_torque(q)
        accelerating = torque - weight - rubbing
        v = v + dt * (inverse @ accelerating)
        q = q + dt * v
    return q, v, torque


class SyntheticArm(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Observe noisy positions [rad], velocities [rad/s] and torques [N m] of the joints; actions are velocities.

    Args:
        horizon: steps of an episode.
        payload: at the hand [kg]; may be changed at any time.
        friction: f, 1 that of a new arm; likewise.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)
    stream_spec = StreamSpec(
        (
            Channel("joint_position", JOINTS, "rad", noise=1e-4, group="position"),
            Channel("joint_velocity", JOINTS, "rad/s", noise=2e-3, group="velocity"),
            Channel("joint_torque", JOINTS, "N m", noise=0.05, group="torque"),
            Channel("command", JOINTS, "rad/s", group=MOTOR),
        ),
        dt=CONTROL_PERIOD_S,
        source="SyntheticArm",
    )
    dt = CONTROL_PERIOD_S
    action_means = "velocity"

    def __init__(self, horizon: int = 400, payload: float = 0.0, friction: float = 1.0) -> None:
        self.horizon = horizon
        self.payload = payload
        self.friction = friction
        sensed = 3 * JOINTS
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (sensed,), np.float32)
        self.action_space = gym.spaces.Box(-FASTEST_COMMAND, FASTEST_COMMAND, (JOINTS,), np.float32)
        neighbours = np.diag(np.full(JOINTS - 1, COUPLING), 1)
        coupling = (neighbours + neighbours.T) * np.sqrt(np.outer(MASS, MASS))
        mass_matrix = np.diag(MASS) + coupling  # M (7, 7)
        self._inverse = np.linalg.inv(mass_matrix)
        self._noise = self.stream_spec.noise[:sensed]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._q = np.zeros(JOINTS)  # [rad]
        self._v = np.zeros(JOINTS)  # [rad/s]
        self._steps = 0
        self._load = 0.7 + 0.3 * self.np_random.uniform(0.5, 1.5)
        observation = self._sense(_gravity(self._q))
        stream = np.concatenate([observation, np.zeros(JOINTS, np.float32)])
        return observation, {"stream": stream}

    def begin_at(self, position: Floats) -> None:
        """Place the arm at rest, at positions (7,) [rad]."""
        self._q = np.array(position, np.float64)
        self._v = np.zeros(JOINTS)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move one step by the commanded velocities [rad/s]."""
        command = np.clip(np.asarray(action, np.float64), -FASTEST_COMMAND, FASTEST_COMMAND)
        loads = (self._load, self.payload, self.friction)
        self._q, self._v, torque = _advance(self._q, self._v, command, loads, self._inverse)
        self._steps += 1
        truncated = self._steps >= self.horizon
        observation = self._sense(torque)
        stream = np.concatenate([observation, np.asarray(action, np.float32)])
        return observation, 0.0, False, truncated, {"stream": stream}

    def _sense(self, torque: Floats) -> NDArray[np.float32]:
        """Return the observation (21,) of the state and the torques (7,)."""
        exact = np.concatenate([self._q, self._v, torque])
        noise = self._noise * self.np_random.standard_normal(len(exact))
        return np.asarray(exact + noise, np.float32)
