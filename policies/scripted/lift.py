"""Lifts the cube: over it, down, grasp, up, stay."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import (
    CLOSE,
    OPEN,
    PhasedExpert,
    Vector,
    has_settled,
    matrix,
    move,
    over_first,
    pointing_down,
    rotation,
)

REACH, DESCEND, GRASP, LIFT = range(4)


class _State(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    hover: Vector  # (3,) way-point above the cube, relative to it [m]
    goal: Vector  # (3,) where to carry it, relative to where it was grasped [m]
    depth: float  # how far below the cube's centre to grasp [m]
    grasped_at: Vector  # (3,) [m]
    drift: Vector  # (7,) correlated action noise


class LiftExpert(PhasedExpert):
    """A scripted expert for Lift."""

    def _act(self, observation: Any, state: _State, noise: Vector) -> tuple[Vector, _State]:
        hand_at = self._read(observation, "hand_position")
        hand = rotation(self._read(observation, "hand_orientation"))
        cube_at = self._read(observation, "cube_pos")
        cube = matrix(self._read(observation, "cube_quat"))

        state = self._advance(state, hand_at, cube_at, self._read(observation, "gripper_velocity"))
        target, grip = self._target(state, cube_at)
        if self._careful and state.phase == DESCEND:
            target = target + over_first(hand_at, cube_at)
        aligned = pointing_down(hand, cube if state.phase <= DESCEND else None)
        command = np.append(move(hand_at, target, hand, aligned, state.speed), grip)
        command[:6] += noise[:6]
        return command, state

    def _begin(self, observation: Any) -> _State:
        style, rng = self.style, self.np_random
        deep = 0.0 if self._careful else 0.005  # fingers of other arms are longer, and come down on the table
        return _State(
            phase=REACH,
            since=0,
            speed=style.pace(0.45, rng),
            hover=np.array([0.0, 0.0, 0.07]) + style.spread * rng.standard_normal(3),
            goal=np.array([0.0, 0.0, 0.13]) + style.spread * rng.standard_normal(3),
            depth=float(np.clip(deep + 0.3 * style.spread * rng.standard_normal(), 0.0, 2 * deep)),
            grasped_at=np.zeros(3),
            drift=np.zeros(7),
        )

    def _advance(self, state: _State, hand_at: Vector, cube_at: Vector, fingers: Vector) -> _State:
        offset = hand_at - cube_at
        if state.phase == REACH and np.linalg.norm(offset - state.hover) < 0.02:
            return state._replace(phase=DESCEND, since=0)
        if state.phase == DESCEND and abs(offset[2] + state.depth) < 0.008 and np.linalg.norm(offset[:2]) < 0.015:
            return state._replace(phase=GRASP, since=0, grasped_at=hand_at)
        if state.phase == GRASP and has_settled(fingers, state.since, 6):
            return state._replace(phase=LIFT, since=0)
        if state.phase == LIFT and np.linalg.norm(offset) > 0.05:  # lost it
            return state._replace(phase=REACH, since=0)
        return state

    def _target(self, state: _State, cube_at: Vector) -> tuple[Vector, float]:
        if state.phase == REACH:
            return cube_at + state.hover, OPEN
        if state.phase == DESCEND:
            return cube_at - [0.0, 0.0, state.depth], OPEN
        if state.phase == GRASP:
            return state.grasped_at, CLOSE
        return state.grasped_at + state.goal, CLOSE
