"""Opens the door: in front of the handle, grasp it, press it down, pull."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from asm_gym.policies.scripted.expert import CLOSE, OPEN, Expert, Phase, Scene, State
from asm_gym.policies.scripted.geometry import UP, Vector, angle_between, length, rotation_about

REACH, APPROACH, GRASP, TURN, PULL, REST = range(6)
UNLATCHED = 1.4  # how far the handle is pressed before the latch is out of its hole for sure [rad]
ASKED_PRESS = 1.55  # how far to ask for; its spring and the hand's give take some of it [rad]
DISTANCE_IN_FRONT = 0.09  # how far in front of the handle to come from [m]
ROLL_AT_ONCE = 0.8  # how far to roll the hand at once [rad]
OPENED = 0.36  # how far to open the door; the task asks for 0.3 [rad]
GAIN = 2.0  # of the hand's commands
SLIPPED_OFF = 0.07  # so far from the handle a hand does not hold it [m]


class Hardware(NamedTuple):
    """The door as it stood closed: what the observation does not say."""

    hinge: Vector  # (3,) a point on the hinge's axis, which is vertical
    pivot: Vector  # (3,) a point on the latch's axis
    axis: Vector  # (3,) the latch's axis, so that the handle goes down at positive angles
    grip: Vector  # (3,) where to hold the handle
    normal: Vector  # (3,) out of the door, towards the robot
    sign: float  # of the latch's joint, where the handle goes down

    def grip_at(self, pressed: float, opened: float) -> Vector:
        """Return where (3,) to hold the handle, when it is pressed and the door is open by these angles [rad]."""
        press = rotation_about(self.axis, pressed)
        held = self.pivot + press @ (self.grip - self.pivot)
        swing = rotation_about(UP, opened)
        return self.hinge + swing @ (held - self.hinge)

    def held(self, pressed: float) -> Vector:
        """Return the hand (3, 3) on the handle of the closed door, its y axis down: else a joint meets its stop."""
        y = np.array([0.0, 0.0, -1.0])
        z = -self.normal
        before_door = np.column_stack([np.cross(y, z), y, z])
        return rotation_about(self.axis, pressed) @ before_door


@dataclass(frozen=True)
class DoorScene(Scene):
    """What is observed; its plan is the door's hardware."""

    pressed: float  # how far the handle is pressed [rad]
    opened: float  # how far the door is open [rad]

    @property
    def grip(self) -> Vector:
        """Where (3,) to hold the handle as it stands now [m]."""
        return self.plan.grip_at(self.pressed, self.opened)

    @property
    def offset(self) -> Vector:
        """The way (3,) from the handle to the hand [m]."""
        return self.hand.position - self.grip

    @property
    def distance(self) -> float:
        """Of the hand from where to hold the handle [m]."""
        return length(self.offset)

    def facing(self, pressed: float = 0.0) -> Vector:
        """Return the hand (3, 3) before the door, fingers above and below a handle ``pressed`` so far [rad]."""
        return rotation_about(UP, self.opened) @ self.plan.held(pressed)

    def reach(self) -> Vector:
        facing = _rolling(self.plan, self.hand.orientation, self.facing())
        in_front = self.grip + DISTANCE_IN_FRONT * self.plan.normal
        return self.move(in_front, facing, GAIN)

    def is_before_handle(self) -> bool:
        distance = length(self.offset - DISTANCE_IN_FRONT * self.plan.normal)
        askew = angle_between(self.hand.orientation, self.facing())
        return distance < 0.02 and askew < 0.15

    def approach(self) -> Vector:
        return self.move(self.grip, self.facing(), GAIN)

    def is_around(self) -> bool:
        is_late = self.state.steps_in_phase > 25
        return self.distance < 0.012 or (is_late and self.distance < 0.025)

    def is_late(self) -> bool:
        return self.state.steps_in_phase > 60

    def grasp(self) -> Vector:
        return self.move(self.state.anchor, self.facing(), GAIN)

    def has_gripped(self) -> bool:
        return self.state.steps_in_phase >= 7

    def turn(self) -> Vector:
        ahead = min(self.pressed + 0.4, ASKED_PRESS)
        return self._hold(self.plan.grip_at(ahead, self.opened))

    def has_slipped_off(self) -> bool:
        return self.distance > SLIPPED_OFF

    def is_unlatched(self) -> bool:
        return self.pressed > UNLATCHED - 0.1

    def pull(self) -> Vector:
        ahead = min(self.opened + 0.12, OPENED + 0.04)
        return self._hold(self.plan.grip_at(ASKED_PRESS, ahead))

    def is_open(self) -> bool:
        return self.opened > OPENED - 0.02

    def rest(self) -> Vector:
        return self._hold(self.state.anchor)

    def _hold(self, target: Vector) -> Vector:
        """Return the command (6,) of a hand that turns with the handle that it holds."""
        return self.move(target, self.facing(self.pressed), GAIN)

    phases: ClassVar = {
        REACH: Phase(reach, OPEN, {APPROACH: is_before_handle}),
        APPROACH: Phase(approach, OPEN, {GRASP: is_around, REACH: is_late}),
        GRASP: Phase(grasp, CLOSE, {TURN: has_gripped}),
        TURN: Phase(turn, CLOSE, {REACH: has_slipped_off, PULL: is_unlatched}),
        PULL: Phase(pull, CLOSE, {REACH: has_slipped_off, REST: is_open}),
        REST: Phase(rest, CLOSE),
    }


class DoorExpert(Expert):
    """A scripted expert for Door; the plan of its state is the door's hardware."""

    pace = 0.4

    def begin(self, observation: Any) -> State:
        speed = self.draw_speed()
        along = 0.3 * self.style.spread * self.np_random.standard_normal(3)[0]
        return State(speed, self._hardware(along))

    def _hardware(self, along: float) -> Hardware:
        """Return the door as it stands at the beginning, closed; the grip is moved ``along`` the handle [m]."""
        model = self.inner.simulation.model
        data = self.inner.simulation.data
        hinge = model.joint("Door_hinge").id
        latch = model.joint("Door_latch_joint").id
        handle = model.geom("Door_handle").id

        pivot = data.xanchor[latch]
        axis = data.xaxis[latch]
        middle = data.geom_xpos[handle]
        outwards, normal, _ = data.geom_xmat[handle].reshape(3, 3).T
        from_pivot = middle - pivot
        outwards = outwards * np.sign(outwards @ from_pivot)
        sign = -float(np.sign(np.cross(axis, from_pivot)[2]))
        return Hardware(
            hinge=data.xanchor[hinge].copy(),
            pivot=pivot.copy(),
            axis=sign * axis,
            grip=middle + (0.025 + along) * outwards,
            normal=normal * np.sign(normal @ from_pivot),
            sign=sign,
        )

    def observe(self, observation: Any, state: State) -> DoorScene:
        return DoorScene(
            state,
            hand=self.read.hand(observation),
            pressed=state.plan.sign * float(self.read(observation, "handle_qpos")[0]),
            opened=float(self.read(observation, "hinge_qpos")[0]),
        )


def _rolling(hardware: Hardware, hand: Vector, facing: Vector) -> Vector:
    """Return how (3, 3) to turn the hand first on its way to ``facing``: by way of its pose on the pressed handle."""
    on_handle = hardware.held(UNLATCHED)
    left = _roll(hand, on_handle) + _roll(on_handle, facing)
    at_once = np.clip(left, -ROLL_AT_ONCE, ROLL_AT_ONCE)
    return facing @ rotation_about(UP, left - at_once)


def _roll(hand: Vector, other: Vector) -> float:
    """Return the hand's roll from another orientation about its z axis, once that points the same way [rad]."""
    ahead = hand[:, 2]
    other_ahead = other[:, 2]
    axis = np.cross(ahead, other_ahead)
    sine = length(axis)
    tilt = np.eye(3)
    if sine > 1e-9:
        angle = float(np.arctan2(sine, ahead @ other_ahead))
        tilt = rotation_about(axis / sine, angle)
    across = other.T @ tilt @ hand[:, 1]
    return float(np.arctan2(-across[0], across[1]))
