"""Lifts the cube: over it, down, grasp, up, stay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from asm_gym.policies.scripted.expert import (
    CLOSE,
    OPEN,
    Expert,
    Phase,
    Scene,
    State,
    has_settled,
    height_while_aside,
)
from asm_gym.policies.scripted.geometry import (
    UP,
    Pose,
    Vector,
    flattest_side,
    length,
    pointing_down,
)

REACH, DESCEND, GRASP, LIFT = range(4)
QUARTER_TURN = np.pi / 2  # after which a cube looks the same [rad]


class LiftPlan(NamedTuple):
    """What is drawn for an episode."""

    hover: Vector  # (3,) way-point above the cube, relative to it [m]
    goal: Vector  # (3,) where to carry it, relative to where it was grasped [m]
    depth: float  # how far below the cube's centre to grasp [m]


@dataclass(frozen=True)
class LiftScene(Scene):
    """What is observed."""

    cube: Pose
    fingers: Vector  # velocities of the gripper's joints
    is_careful: bool

    @property
    def offset(self) -> Vector:
        """(3,) of the hand from the cube [m]."""
        return self.hand.position - self.cube.position

    def reach(self) -> Vector:
        return self._fit_sides(self.cube.position + self.plan.hover)

    def is_above(self) -> bool:
        return length(self.offset - self.plan.hover) < 0.02

    def descend(self) -> Vector:
        target = self.cube.position - self.plan.depth * UP
        if self.is_careful:
            target = target + height_while_aside(self.hand.position, self.cube.position)
        return self._fit_sides(target)

    def is_around(self) -> bool:
        height = self.offset[2] + self.plan.depth
        return abs(height) < 0.008 and length(self.offset[:2]) < 0.015

    def grasp(self) -> Vector:
        return self.move(self.state.anchor, pointing_down(self.hand.orientation))

    def has_gripped(self) -> bool:
        return has_settled(self.fingers, self.state.steps_in_phase, usual=6)

    def lift(self) -> Vector:
        return self.move(self.state.anchor + self.plan.goal, pointing_down(self.hand.orientation))

    def has_lost_it(self) -> bool:
        return length(self.offset) > 0.05

    def _fit_sides(self, target: Vector) -> Vector:
        """Return the command (6,) of a hand whose fingers are to fit the sides of the cube."""
        side = flattest_side(self.cube.orientation)
        return self.move(target, pointing_down(self.hand.orientation, side, QUARTER_TURN))

    phases: ClassVar = {
        REACH: Phase(reach, OPEN, {DESCEND: is_above}),
        DESCEND: Phase(descend, OPEN, {GRASP: is_around}),
        GRASP: Phase(grasp, CLOSE, {LIFT: has_gripped}),
        LIFT: Phase(lift, CLOSE, {REACH: has_lost_it}),
    }


class LiftExpert(Expert):
    """A scripted expert for Lift."""

    pace = 0.45

    def begin(self, observation: Any) -> State:
        # Fingers of other arms are longer, and come down on the table.
        deep = 0.0 if self.is_careful else 0.005
        speed = self.draw_speed()
        hover = 0.07 * UP + self.draw_offset()
        goal = 0.13 * UP + self.draw_offset()
        depth = deep + 0.3 * self.style.spread * self.np_random.standard_normal()
        plan = LiftPlan(hover, goal, depth=float(np.clip(depth, 0.0, 2 * deep)))
        return State(speed, plan)

    def observe(self, observation: Any, state: State) -> LiftScene:
        return LiftScene(
            state,
            hand=self.read.hand(observation),
            cube=self.read.pose(observation, "cube"),
            fingers=self.read(observation, "gripper_velocity"),
            is_careful=self.is_careful,
        )

    def entered(self, scene: LiftScene, phase: int) -> State:
        entered = super().entered(scene, phase)
        if phase == LIFT:  # the anchor stays where the cube was grasped
            return entered._replace(anchor=scene.state.anchor)
        return entered
