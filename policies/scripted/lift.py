"""Lifts the cube: over it, down, grasp, up, stay."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, Expert, State, has_settled, over_first
from asm_gym.policies.scripted.geometry import Pose, Vector, flattest_side, gripping, move

REACH, DESCEND, GRASP, LIFT = range(4)


class _Plan(NamedTuple):
    hover: Vector  # (3,) way-point above the cube, relative to it [m]
    goal: Vector  # (3,) where to carry it, relative to where it was grasped [m]
    depth: float  # how far below the cube's centre to grasp [m]


class _Scene(NamedTuple):
    hand: Pose
    cube: Pose
    fingers: Vector  # velocities of the gripper's joints


class LiftExpert(Expert):
    """A scripted expert for Lift."""

    pace = 0.45

    def begin(self, observation: Any) -> State:
        style, rng = self.style, self.np_random
        # fingers of other arms are longer, and come down on the table
        deep = 0.0 if self._careful else 0.005
        speed = style.pace(self.pace, rng)
        plan = _Plan(
            hover=np.array([0.0, 0.0, 0.07]) + style.spread * rng.standard_normal(3),
            goal=np.array([0.0, 0.0, 0.13]) + style.spread * rng.standard_normal(3),
            depth=float(np.clip(deep + 0.3 * style.spread * rng.standard_normal(), 0.0, 2 * deep)),
        )
        return self.start(speed, plan=plan)

    def look(self, observation: Any) -> _Scene:
        fingers = self.read(observation, "gripper_velocity")
        return _Scene(self.read.hand(observation), self.read.pose(observation, "cube"), fingers)

    def next_phase(self, state: State, scene: _Scene) -> int:
        phase, offset = state.phase, scene.hand.at - scene.cube.at
        aside = np.linalg.norm(offset[:2])
        if phase == REACH and np.linalg.norm(offset - state.plan.hover) < 0.02:
            return DESCEND
        if phase == DESCEND and abs(offset[2] + state.plan.depth) < 0.008 and aside < 0.015:
            return GRASP
        if phase == GRASP and has_settled(scene.fingers, state.since, 6):
            return LIFT
        if phase == LIFT and np.linalg.norm(offset) > 0.05:  # lost it
            return REACH
        return phase

    def entered(self, state: State, scene: _Scene, phase: int) -> State:
        # While it lifts, the anchor stays where the cube was grasped.
        return (
            super()
            .entered(state, scene, phase)
            ._replace(anchor=state.anchor if phase == LIFT else scene.hand.at)
        )

    def command(self, state: State, scene: _Scene) -> Vector:
        phase, plan, cube = state.phase, state.plan, scene.cube
        if phase == REACH:
            target = cube.at + plan.hover
        elif phase == DESCEND:
            target = cube.at - [0.0, 0.0, plan.depth]
            if self._careful:
                target = target + over_first(scene.hand.at, cube.at)
        else:
            target = state.anchor + (plan.goal if phase == LIFT else 0.0)
        # a cube looks the same every quarter turn
        side = flattest_side(cube.turned) if phase <= DESCEND else None
        aligned = gripping(scene.hand.turned, side, np.pi / 2)
        return np.append(
            move(scene.hand, target, aligned, state.speed), OPEN if phase <= DESCEND else CLOSE
        )
