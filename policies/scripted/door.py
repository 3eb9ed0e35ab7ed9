"""Opens the door: in front of the handle, grasp it, press it down, pull."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import (
    CLOSE,
    OPEN,
    PhasedExpert,
    Vector,
    move,
    rotation,
)

REACH, APPROACH, GRASP, TURN, PULL, REST = range(6)

_TURNED = 1.4  # how far the handle is pressed before the latch is out of its hole for sure [rad]
_PRESSED = 1.55  # how far to ask for; its spring and the hand's give take some of it [rad]
_BEFORE = 0.09  # how far in front of the handle to come from [m]
_ROLL = 0.8  # how far to roll the hand at once [rad]
_OPENED = 0.36  # [rad]; the task asks for 0.3


class Hardware(NamedTuple):
    """The door as it stood closed: what the observation does not say."""

    hinge: Vector  # (3,) a point on the hinge's axis, which is vertical
    pivot: Vector  # (3,) a point on the latch's axis
    axis: Vector  # (3,) the latch's axis, so that the handle goes down at positive angles
    grip: Vector  # (3,) where to hold the handle
    normal: Vector  # (3,) out of the door, towards the robot
    sign: float  # of the latch's joint, where the handle goes down


class DoorState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    spread: Vector  # (3,) how this episode's way-points differ from the plan [m]
    hardware: Hardware
    anchor: Vector  # (3,) where the hand was when the phase began [m]
    drift: Vector  # (7,) correlated action noise


class DoorExpert(PhasedExpert):
    """A scripted expert for Door."""

    def _act(self, observation: Any, state: DoorState, noise: Vector) -> tuple[Vector, DoorState]:
        hand_at = self._read(observation, "hand_position")
        hand = rotation(self._read(observation, "hand_orientation"))
        turned = state.hardware.sign * float(self._read(observation, "handle_qpos")[0])
        opened = float(self._read(observation, "hinge_qpos")[0])
        left = _between(hand, self._facing(state, turned, opened))
        state = self._advance(state, hand_at, turned, opened, left)
        target, grip = self._target(state, turned, opened)
        facing = self._facing(state, turned, opened)
        if state.phase == REACH:
            facing = self._rolling(state, hand, facing)
        command = np.append(move(hand_at, target, hand, facing, state.speed, gain=2.0), grip)
        command[:6] += noise[:6]
        return command, state

    def _begin(self, observation: Any) -> DoorState:
        style, rng = self.style, self.np_random
        speed = style.pace(0.4, rng)
        spread = 0.3 * style.spread * rng.standard_normal(3)
        return DoorState(REACH, 0, speed, spread, self._look(spread[0]), np.zeros(3), np.zeros(7))

    def _look(self, along: float) -> Hardware:
        """The door as it stands at the beginning of an episode, closed; the grip is moved ``along`` the handle [m]."""
        simulation = self.env.unwrapped.simulation  # type: ignore[attr-defined]
        model, data = simulation.model, simulation.data
        hinge, latch = model.joint("Door_hinge").id, model.joint("Door_latch_joint").id
        handle = model.geom("Door_handle").id
        frame = data.geom_xmat[handle].reshape(3, 3)
        middle, pivot, axis = data.geom_xpos[handle], data.xanchor[latch], data.xaxis[latch]
        outwards = frame[:, 0] * np.sign(frame[:, 0] @ (middle - pivot))  # along the handle, away from the pivot
        sign = -float(np.sign(np.cross(axis, middle - pivot)[2]))
        grip = middle + (0.025 + along) * outwards
        normal = frame[:, 1] * np.sign(frame[:, 1] @ (middle - pivot))
        return Hardware(data.xanchor[hinge].copy(), pivot.copy(), sign * axis, grip, normal, sign)

    def _advance(self, state: DoorState, hand_at: Vector, turned: float, opened: float, left: float) -> DoorState:
        """The phase that comes next; ``left`` is how far the hand is from facing the door [rad]."""
        off = hand_at - self._grip(state.hardware, turned, opened)
        far = float(np.linalg.norm(off))

        def to(phase: int) -> DoorState:
            return state._replace(phase=phase, since=0, anchor=hand_at)

        before = off - _BEFORE * state.hardware.normal
        if state.phase == REACH and np.linalg.norm(before) < 0.02 and left < 0.15:
            return to(APPROACH)
        if state.phase == APPROACH and (far < 0.012 or (state.since > 25 and far < 0.025)):
            return to(GRASP)
        if state.phase == APPROACH and state.since > 60:
            return to(REACH)
        if state.phase == GRASP and state.since >= 7:
            return to(TURN)
        if state.phase in (TURN, PULL) and far > 0.07:  # slipped off
            return to(REACH)
        if state.phase == TURN and turned > _TURNED - 0.1:
            return to(PULL)
        if state.phase == PULL and opened > _OPENED - 0.02:
            return to(REST)
        return state

    def _target(self, state: DoorState, turned: float, opened: float) -> tuple[Vector, float]:
        hardware, phase = state.hardware, state.phase
        grip = self._grip(hardware, turned, opened)
        if phase == REACH:
            return grip + _BEFORE * hardware.normal, OPEN
        if phase == APPROACH:
            return grip, OPEN
        if phase == GRASP:
            return state.anchor, CLOSE
        if phase == TURN:
            return self._grip(hardware, min(turned + 0.4, _PRESSED), opened), CLOSE
        if phase == PULL:
            return self._grip(hardware, _PRESSED, min(opened + 0.12, _OPENED + 0.04)), CLOSE
        return state.anchor, CLOSE

    @classmethod
    def _facing(cls, state: DoorState, turned: float, opened: float) -> Vector:
        """(3, 3) the hand in front of the door, fingers above and below the handle; it turns with what it holds."""
        held = cls._held(state.hardware, turned if state.phase >= TURN else 0.0)
        facing: Vector = _about([0.0, 0.0, 1.0], opened) @ held
        return facing

    @staticmethod
    def _held(hardware: Hardware, turned: float) -> Vector:
        """(3, 3) the hand on the handle of a closed door. Its y axis points down: pressing the handle turns it back.

        The other way up it turns further, until the Panda's last joint meets its stop.
        """
        z = -hardware.normal
        y = np.array([0.0, 0.0, -1.0])
        held: Vector = _about(hardware.axis, turned) @ np.stack([np.cross(y, z), y, z], axis=1)
        return held

    @classmethod
    def _rolling(cls, state: DoorState, hand: Vector, facing: Vector) -> Vector:
        """(3, 3) where to turn first on the way to ``facing``: rolled a little, by the way back that pressing takes.

        The shortest turn is nearly half a one, and may lead any way round.
        """
        pressed = cls._held(state.hardware, _TURNED)
        left = _roll(hand, pressed) + _roll(pressed, facing)
        first: Vector = facing @ _about([0.0, 0.0, 1.0], left - np.clip(left, -_ROLL, _ROLL))
        return first

    @staticmethod
    def _grip(hardware: Hardware, turned: float, opened: float) -> Vector:
        """(3,) where to hold the handle, when it is pressed and the door is open by these angles [rad]."""
        held = hardware.pivot + _about(hardware.axis, turned) @ (hardware.grip - hardware.pivot)
        grip: Vector = hardware.hinge + _about([0.0, 0.0, 1.0], opened) @ (held - hardware.hinge)
        return grip


def _between(a: Vector, b: Vector) -> float:
    """The angle between two orientations [rad]."""
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1.0, 1.0)))


def _roll(hand: Vector, to: Vector) -> float:
    """How far the hand is rolled from another orientation, about its z axis, once that points the same way [rad]."""
    axis = np.cross(hand[:, 2], to[:, 2])
    sine = float(np.linalg.norm(axis))
    tilt = _about(axis / sine, float(np.arctan2(sine, hand[:, 2] @ to[:, 2]))) if sine > 1e-9 else np.eye(3)
    across = to.T @ tilt @ hand[:, 1]
    return float(np.arctan2(-across[0], across[1]))


def _about(axis: Any, angle: float) -> Vector:
    """(3, 3) rotation about a unit ``axis`` by ``angle`` [rad] (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Vector = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)
    return turn
