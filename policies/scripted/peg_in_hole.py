"""Puts the peg through the hole with two arms: one turns the plate to face the other, which points the peg at it.

Peg and plate meet half-way between upright and level, because a Panda's wrist turns up no further than that down there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import ARMS, State, TwoArmExpert, move_arm
from asm_gym.policies.scripted.geometry import UP, Pose, Vector, grasping, matrix

TURN, ALIGN, INSERT = range(3)

_CENTRE = 0.105  # from the plate's origin to the middle of its hole, which is 10 cm wide [m]
_BEFORE = 0.26  # from the hole to the peg's middle, a whole peg away, where neither hits the other in turning [m]
_THROUGH = 0.04  # the same when it is in [m]
_BELOW = 0.17  # from the hand down its plate to the middle of the hole [m]
_STEEP = np.pi / 4  # how far down the peg points [rad]


class _Plan(NamedTuple):
    plate: Vector  # (3,) where to hold the hand with the plate [m]
    through: float  # from the hole to the peg's middle at the end [m]
    course: Vector  # (3,) unit vector along which the peg goes in
    side: Vector  # (3,) unit vector across it, level


class _Scene(NamedTuple):
    hands: tuple[Pose, Pose]
    middle: Vector  # (3,) of the peg [m]
    axis: Vector  # (3,) along the peg
    centre: Vector  # (3,) of the hole [m]
    normal: Vector  # (3,) of the plate


class PegInHoleExpert(TwoArmExpert):
    """A scripted expert for TwoArmPegInHole."""

    pace = 0.4

    def begin(self, observation: Any) -> State:
        style, rng = self.style, self.np_random
        first, second = self.places()
        forth = (second - first) / np.linalg.norm(second - first)  # level
        side = np.cross(forth, UP)
        course = np.cos(_STEEP) * forth - np.sin(_STEEP) * UP
        centre = (first + second) / 2 + 0.05 * forth + 0.15 * UP
        plate = centre + _BELOW * np.cross(side, course)
        speed = style.pace(self.pace, rng)
        plate = plate + 2 * style.spread * np.clip(rng.standard_normal(3), -2, 2)
        through = _THROUGH + float(np.clip(style.spread * rng.standard_normal(), -0.03, 0.03))
        return self.start(speed, plan=_Plan(plate, through, course, side), noises=6 * ARMS)

    def look(self, observation: Any) -> _Scene:
        hole = self.read.pose(observation, "hole")
        middle = hole.at - self.read(observation, "peg_to_hole")
        axis = matrix(self.read(observation, "peg_quat"))[:, 2]
        return _Scene(self.hands(observation), middle, axis, hole.at + _CENTRE * hole.turned[:, 0], hole.turned[:, 2])

    def next_phase(self, state: State, scene: _Scene) -> int:
        phase, course = state.phase, state.plan.course
        along, astray = _off(state, scene)
        turned = abs(float(scene.normal @ course)) > 0.98
        aligned = turned and float(scene.axis @ course) > 0.98
        if phase == TURN and turned:
            return ALIGN
        if phase == ALIGN and aligned and astray < 0.015 and abs(along - _BEFORE) < 0.03:
            return INSERT
        # Short of the plate or stuck on its rim, out again: half a peg is 0.13 m long.
        if phase == INSERT and along > 0.14 and (astray > 0.04 or state.since > 80):
            return ALIGN
        return phase

    def command(self, state: State, scene: _Scene) -> Vector:
        (peg, plate), plan, speed, bases = scene.hands, state.plan, state.speed, self.bases()
        along, astray = _off(state, scene)
        if state.phase == TURN:  # out of the plate's way
            goal, pointing = scene.middle - 0.02 * plan.course, peg.turned
        else:
            # The further it is astray, the less it advances.
            advanced = max(plan.through, along - 0.03 * float(np.clip(1.5 - astray / 0.02, 0.0, 1.0)))
            goal = scene.centre - (_BEFORE if state.phase == ALIGN else advanced) * plan.course
            pointing = np.stack([np.cross(plan.side, plan.course), plan.side, plan.course], axis=1)
        # The plate's normal is its hand's y axis.
        facing = grasping(plate.turned, np.cross(plan.course, plan.side), plan.course)
        return np.concatenate(
            [
                move_arm(bases[0], peg, peg.at + goal - scene.middle, pointing, speed, gain=1.5),
                move_arm(bases[1], plate, plan.plate, facing, speed, gain=1.5),
            ]
        )


def _off(state: State, scene: _Scene) -> tuple[float, float]:
    """Return how far the peg's middle is before the hole, along its course and across [m]."""
    off = scene.centre - scene.middle
    along = float(off @ state.plan.course)
    return along, float(np.linalg.norm(off - along * state.plan.course))
