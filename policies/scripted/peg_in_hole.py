"""Puts the peg through the hole with two arms: one turns the plate to face the other, which points the peg at it.

Peg and plate meet half-way between upright and level, because a Panda's wrist turns up no further than that down there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import PhasedExpert, Style, Vector, grasping, matrix
from asm_gym.policies.scripted.two_arms import ARMS, Hands, move_arm

TURN, ALIGN, INSERT = range(3)

_CENTRE = 0.105  # from the plate's origin to the middle of its hole, which is 10 cm wide [m]
_BEFORE = 0.26  # from the hole to the peg's middle, a whole peg away, where neither hits the other in turning [m]
_THROUGH = 0.04  # the same when it is in [m]
_BELOW = 0.17  # from the hand down its plate to the middle of the hole [m]
_STEEP = np.pi / 4  # how far down the peg points [rad]
_UP = np.array([0.0, 0.0, 1.0])


class PegInHoleState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    plate: Vector  # (3,) where to hold the hand with the plate [m]
    through: float  # from the hole to the peg's middle at the end [m]
    bases: Vector  # (2, 3, 3) how the arms stand in the room
    course: Vector  # (3,) unit vector along which the peg goes in
    side: Vector  # (3,) unit vector across it, level
    drift: Vector  # (12,) correlated action noise


class PegInHoleExpert(PhasedExpert):
    """A scripted expert for TwoArmPegInHole."""

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None) -> None:
        super().__init__(env, seed, style)
        self._hands = Hands(env)

    def _act(self, observation: Any, state: PegInHoleState, noise: Vector) -> tuple[Vector, PegInHoleState]:
        peg, plate = self._hands.look(observation)
        hole_at, hole = self._read(observation, "hole_pos"), matrix(self._read(observation, "hole_quat"))
        middle = hole_at - self._read(observation, "peg_to_hole")  # (3,) of the peg
        axis = matrix(self._read(observation, "peg_quat"))[:, 2]
        centre = hole_at + _CENTRE * hole[:, 0]

        off = centre - middle
        along = float(off @ state.course)
        astray = float(np.linalg.norm(off - along * state.course))
        turned = abs(float(hole[:, 2] @ state.course)) > 0.98
        aligned = turned and float(axis @ state.course) > 0.98
        state = _advance(state, along, astray, turned, aligned)

        goal = centre - _ahead(state, along, astray) * state.course
        pointing = np.stack([np.cross(state.side, state.course), state.side, state.course], axis=1)
        if state.phase == TURN:  # out of the plate's way
            goal, pointing = middle - 0.02 * state.course, peg.turned
        command = np.concatenate(
            [
                move_arm(state.bases[0], peg, peg.at + goal - middle, pointing, state.speed, gain=1.5),
                move_arm(state.bases[1], plate, state.plate, _facing(plate.turned, state), state.speed, gain=1.5),
            ]
        )
        command += noise
        return command, state

    def _begin(self, observation: Any) -> PegInHoleState:
        style, rng = self.style, self.np_random
        first, second = self._hands.places()
        forth = (second - first) / np.linalg.norm(second - first)  # level
        side = np.cross(forth, _UP)
        course = np.cos(_STEEP) * forth - np.sin(_STEEP) * _UP
        centre = (first + second) / 2 + 0.05 * forth + 0.15 * _UP
        plate = centre + _BELOW * np.cross(side, course)
        return PegInHoleState(
            phase=TURN,
            since=0,
            speed=style.pace(0.4, rng),
            plate=plate + 2 * style.spread * np.clip(rng.standard_normal(3), -2, 2),
            through=_THROUGH + float(np.clip(style.spread * rng.standard_normal(), -0.03, 0.03)),
            bases=self._hands.bases(),
            course=course,
            side=side,
            drift=np.zeros(6 * ARMS),
        )


def _advance(state: PegInHoleState, along: float, astray: float, turned: bool, aligned: bool) -> PegInHoleState:
    """The phase that comes next: in once both face each other, and out again where the peg missed the hole."""
    if state.phase == TURN and turned:
        return state._replace(phase=ALIGN, since=0)
    if state.phase == ALIGN and aligned and astray < 0.015 and abs(along - _BEFORE) < 0.03:
        return state._replace(phase=INSERT, since=0)
    # Short of the plate or stuck on its rim: half a peg is 0.13 m long.
    if state.phase == INSERT and along > 0.14 and (astray > 0.04 or state.since > 80):
        return state._replace(phase=ALIGN, since=0)
    return state


def _ahead(state: PegInHoleState, along: float, astray: float) -> float:
    """How far before the hole the peg's middle should be now [m]: the further it is astray, the less it advances."""
    if state.phase == ALIGN:
        return _BEFORE
    return max(state.through, along - 0.03 * float(np.clip(1.5 - astray / 0.02, 0.0, 1.0)))


def _facing(hand: Vector, state: PegInHoleState) -> Vector:
    """(3, 3) the rotation nearest ``hand`` that turns the plate, whose normal is the hand's y axis, to face the peg."""
    return grasping(hand, np.cross(state.course, state.side), state.course)
