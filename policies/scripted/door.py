"""Opens the door: in front of the handle, grasp it, press it down, pull."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, Expert, State
from asm_gym.policies.scripted.geometry import UP, Pose, Vector, about, angle_between, move

REACH, APPROACH, GRASP, TURN, PULL, REST = range(6)
_TURNED = 1.4  # how far the handle is pressed before the latch is out of its hole for sure [rad]
_PRESSED = 1.55  # how far to ask for; its spring and the hand's give take some of it [rad]
_BEFORE = 0.09  # how far in front of the handle to come from [m]
_ROLL = 0.8  # how far to roll the hand at once [rad]
_OPENED = 0.36  # [rad]; the task asks for 0.3


class _Hardware(NamedTuple):
    """The door as it stood closed: what the observation does not say."""

    hinge: Vector  # (3,) a point on the hinge's axis, which is vertical
    pivot: Vector  # (3,) a point on the latch's axis
    axis: Vector  # (3,) the latch's axis, so that the handle goes down at positive angles
    grip: Vector  # (3,) where to hold the handle
    normal: Vector  # (3,) out of the door, towards the robot
    sign: float  # of the latch's joint, where the handle goes down

    def grip_at(self, turned: float, opened: float) -> Vector:
        """Return where (3,) to hold the handle, when it is pressed and the door is open by these angles [rad]."""
        held = self.pivot + about(self.axis, turned) @ (self.grip - self.pivot)
        return self.hinge + about(UP, opened) @ (held - self.hinge)

    def held(self, turned: float) -> Vector:
        """Return the hand (3, 3) on the handle of the closed door, its y axis down: else a joint meets its stop."""
        z, y = -self.normal, np.array([0.0, 0.0, -1.0])
        return about(self.axis, turned) @ np.stack([np.cross(y, z), y, z], axis=1)


class _Scene(NamedTuple):
    hand: Pose
    turned: float  # how far the handle is pressed [rad]
    opened: float  # how far the door is open [rad]


class DoorExpert(Expert):
    """A scripted expert for Door; the plan of its state is the door's hardware."""

    pace = 0.4

    def begin(self, observation: Any) -> State:
        style, rng = self.style, self.np_random
        speed = style.pace(self.pace, rng)
        spread = 0.3 * style.spread * rng.standard_normal(3)
        return self.start(speed, spread, self._hardware(spread[0]))

    def _hardware(self, along: float) -> _Hardware:
        """Return the door as it stands at the beginning, closed; the grip is moved ``along`` the handle [m]."""
        simulation = self.inner.simulation
        model, data = simulation.model, simulation.data
        hinge, latch = model.joint("Door_hinge").id, model.joint("Door_latch_joint").id
        handle = model.geom("Door_handle").id
        frame = data.geom_xmat[handle].reshape(3, 3)
        middle, pivot, axis = data.geom_xpos[handle], data.xanchor[latch], data.xaxis[latch]
        # along the handle, away from the pivot
        outwards = frame[:, 0] * np.sign(frame[:, 0] @ (middle - pivot))
        sign = -float(np.sign(np.cross(axis, middle - pivot)[2]))
        grip = middle + (0.025 + along) * outwards
        normal = frame[:, 1] * np.sign(frame[:, 1] @ (middle - pivot))
        return _Hardware(data.xanchor[hinge].copy(), pivot.copy(), sign * axis, grip, normal, sign)

    def look(self, observation: Any) -> _Scene:
        turned, opened = (
            float(self.read(observation, name)[0]) for name in ("handle_qpos", "hinge_qpos")
        )
        return _Scene(self.read.hand(observation), turned, opened)

    def next_phase(self, state: State, scene: _Scene) -> int:
        hardware, phase, since = state.plan, state.phase, state.since
        turned, opened = hardware.sign * scene.turned, scene.opened
        off = scene.hand.at - hardware.grip_at(turned, opened)
        far = float(np.linalg.norm(off))
        if phase == REACH:
            left = angle_between(scene.hand.turned, self._facing(state, scene))
            return (
                APPROACH
                if np.linalg.norm(off - _BEFORE * hardware.normal) < 0.02 and left < 0.15
                else REACH
            )
        if phase == APPROACH:
            if far < 0.012 or (since > 25 and far < 0.025):
                return GRASP
            return REACH if since > 60 else APPROACH
        if phase == GRASP:
            return TURN if since >= 7 else GRASP
        if phase in (TURN, PULL) and far > 0.07:  # slipped off
            return REACH
        if phase == TURN and turned > _TURNED - 0.1:
            return PULL
        if phase == PULL and opened > _OPENED - 0.02:
            return REST
        return phase

    def command(self, state: State, scene: _Scene) -> Vector:
        hardware, phase, facing = state.plan, state.phase, self._facing(state, scene)
        turned, opened = hardware.sign * scene.turned, scene.opened
        if phase == REACH:
            target = hardware.grip_at(turned, opened) + _BEFORE * hardware.normal
            facing = self._rolling(hardware, scene.hand.turned, facing)
        elif phase == APPROACH:
            target = hardware.grip_at(turned, opened)
        elif phase == TURN:
            target = hardware.grip_at(min(turned + 0.4, _PRESSED), opened)
        elif phase == PULL:
            target = hardware.grip_at(_PRESSED, min(opened + 0.12, _OPENED + 0.04))
        else:
            target = state.anchor
        return np.append(
            move(scene.hand, target, facing, state.speed, gain=2.0),
            OPEN if phase < GRASP else CLOSE,
        )

    @staticmethod
    def _facing(state: State, scene: _Scene) -> Vector:
        """Return the hand (3, 3) before the door, fingers above and below the handle; it turns with what it holds."""
        held = state.plan.held(state.plan.sign * scene.turned if state.phase >= TURN else 0.0)
        return about(UP, scene.opened) @ held

    @staticmethod
    def _rolling(hardware: _Hardware, hand: Vector, facing: Vector) -> Vector:
        """Return where (3, 3) to turn first on the way to ``facing``, whose shortest way may lead any way round."""
        pressed = hardware.held(_TURNED)
        left = _roll(hand, pressed) + _roll(pressed, facing)
        return facing @ about(UP, left - np.clip(left, -_ROLL, _ROLL))


def _roll(hand: Vector, to: Vector) -> float:
    """Return the hand's roll from another orientation about its z axis, once that points the same way [rad]."""
    axis = np.cross(hand[:, 2], to[:, 2])
    sine = float(np.linalg.norm(axis))
    tilt = (
        about(axis / sine, float(np.arctan2(sine, hand[:, 2] @ to[:, 2])))
        if sine > 1e-9
        else np.eye(3)
    )
    across = to.T @ tilt @ hand[:, 1]
    return float(np.arctan2(-across[0], across[1]))
