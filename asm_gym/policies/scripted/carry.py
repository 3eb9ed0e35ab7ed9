"""Picks an object up and puts it somewhere: what stacking, fitting nuts and sorting have in common."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from itertools import product
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
    angle_between,
    command_towards,
    length,
    pointing_down,
    rotation_about_vertical,
    wrapped,
    yaw,
)

REACH, DESCEND, GRASP, RAISE, CARRY, LOWER, RELEASE, RETREAT = range(8)
RETREATED = 14  # steps after which a hand has gone up from what it put down
TURN_AT_ONCE = 1.0  # how far to turn the hand at once [rad]
ROOM = 0.9  # how far from its stops the last joint is to stay [rad]
EXACT = 0.005  # what has to fit as exactly as this is not lowered beside its place [m]
LOST = 0.05  # so far from the hand an object is not held [m]


class CarryTask(NamedTuple):
    """What to carry where."""

    name: str  # of the object, as observations call it
    grip: Vector  # (3,) where to hold it, in its own frame [m]
    closing: Vector  # (3,) along which of its own axes the fingers close
    turns: float  # after how much of a turn about the vertical the grasp is the same again [rad]
    clearance: float  # how far above its grip to come from [m]
    place: Vector  # (3,) where its origin is to go [m]
    over: float  # how far above ``place`` to carry it [m]
    # those of its x axis that fit the place [rad]; empty where every one does
    headings: tuple[float, ...] = ()
    heading_fit: float = 0.06  # how exactly it must have one of them before it is lowered [rad]
    fit: float = 0.02  # how exactly it must stand over its place before it is lowered [m]
    haste: float = 1.0  # with which share of the usual speed the hand comes down


@dataclass(frozen=True)
class CarryScene(Scene):
    """What is observed; its plan is the present task, None where nothing is left to carry."""

    thing: Any  # pose of the object; None without a task
    fingers: Vector  # velocities of the gripper's joints
    wrist: float  # angle of the arm's last joint [rad]
    is_careful: bool  # the arm is not a Panda, whose pace the plans are made for
    gain: float  # of the hand's commands

    @property
    def grip(self) -> Vector:
        """Where (3,) to hold the object [m]."""
        return self.thing.point(self.plan.grip)

    @property
    def offset(self) -> Vector:
        """The way (3,) from the grip to the hand [m]."""
        return self.hand.position - self.grip

    @property
    def over(self) -> Vector:
        """Where (3,) to carry the object before it is lowered [m]."""
        return self.plan.place + self.plan.over * UP

    @property
    def aside(self) -> float:
        """Horizontal distance of the object from its place [m]."""
        return length((self.thing.position - self.plan.place)[:2])

    @property
    def down(self) -> Vector:
        """Orientation (3, 3) of a hand that points down and keeps its direction."""
        return pointing_down(self.hand.orientation)

    @property
    def grasping(self) -> Vector:
        """How (3, 3) to hold the hand for grasping."""
        closing = self.thing.orientation @ self.plan.closing
        return pointing_down(self.hand.orientation, closing, self.plan.turns)

    @property
    def turn_to_fit(self) -> float:
        """The smallest turn about the vertical that gives the object a heading that fits [rad]."""
        now = yaw(self.thing.orientation[:, 0])
        turns = [wrapped(heading - now) for heading in self.plan.headings]
        return float(min(turns, key=abs, default=0.0))

    def reach(self) -> Vector:
        above = self.plan.clearance * UP + 0.3 * self.state.waypoint_offset
        target = self.grip + above
        # From afar, first high: the way may lead over a wall or another object.
        if length(self.offset[:2]) > 0.1:
            height = min(self.hand.position[2], target[2] + 0.1)
            target[2] = max(target[2], height)
        return self.move(target, self._turning(self.grasping), self.gain)

    def is_above(self) -> bool:
        waypoint = self.state.waypoint_offset[:2] * 0.3
        aside = length(self.offset[:2] - waypoint)
        too_high = self.offset[2] - self.plan.clearance
        askew = angle_between(self.hand.orientation, self.grasping)
        return aside < 0.02 and abs(too_high) < 0.03 and askew < 0.15

    def descend(self) -> Vector:
        target = self.grip
        if self.is_careful:
            target = target + height_while_aside(self.hand.position, target)
        speed = self.state.speed * self.plan.haste
        return command_towards(self.hand, target, self._turning(self.grasping), speed, self.gain)

    def is_around(self) -> bool:
        distance = length(self.offset)
        return distance < 0.011 or (self.state.steps_in_phase > 30 and distance < 0.02)

    def is_astray(self) -> bool:
        return self.state.steps_in_phase > 60 or length(self.offset[:2]) > 0.06

    def grasp(self) -> Vector:
        if self.is_careful:
            return self.move(self.state.anchor, self.down, self.gain)
        return self.move(self.state.anchor, self.down)

    def has_gripped(self) -> bool:
        return has_settled(self.fingers, self.state.steps_in_phase, usual=7)

    def lift(self) -> Vector:
        height = self.over[2] + 0.3 * self.state.waypoint_offset[2]
        target = np.array([*self.thing.position[:2], height])
        return command_towards(self._held, target, self.down, self.state.speed)

    def has_lost_it(self) -> bool:
        """Return whether the object fell; it may lie where it belongs."""
        return length(self.offset) > LOST

    def is_lifted(self) -> bool:
        height = self.thing.position[2]
        return height > self.over[2] - 0.03 or self.state.steps_in_phase > 60

    def carry(self) -> Vector:
        return self._move_held(self.over, self.state.speed)

    def is_over_place(self) -> bool:
        tolerance = self.plan.fit
        if self.is_careful:
            # An arm that cannot get nearer, at the end of its reach, makes do with less in time.
            tolerance = self.plan.fit * (1 + self.state.steps_in_phase / 60)
        return self.aside < tolerance and abs(self.turn_to_fit) < self.plan.heading_fit

    def lower(self) -> Vector:
        target = self.plan.place
        if self.is_careful or self.plan.fit <= EXACT:
            # The further aside of its place an object is, the less it goes down.
            share = 1.5 - 0.5 * self.aside / self.plan.fit
            down = 0.025 * np.clip(share, 0.0, 1.0)
            height = max(target[2], self.thing.position[2] - down)
            target = np.array([*target[:2], height])
        return self._move_held(target, 0.6 * self.state.speed)

    def has_slipped_aside(self) -> bool:
        tolerance = self.plan.fit
        if self.is_careful:
            tolerance = self.plan.fit * 2.5
        return self.aside > tolerance + 0.02

    def is_down(self) -> bool:
        height = self.thing.position[2]
        bottom = self.plan.place[2]
        is_late = self.state.steps_in_phase > 50
        return height < bottom + 0.006 or (is_late and height < bottom + 0.03)

    def release(self) -> Vector:
        return self.move(self.state.anchor, self.down)

    def has_let_go(self) -> bool:
        return has_settled(self.fingers, self.state.steps_in_phase, usual=6)

    def retreat(self) -> Vector:
        return self.move(self.state.anchor + 0.12 * UP, self.down)

    @property
    def _held(self) -> Pose:
        """The hand as if it were where the object is that it holds."""
        return self.hand._replace(position=self.thing.position)

    def _move_held(self, target: Vector, speed: float) -> Vector:
        """Return the command (6,) of a hand whose object is to come to ``target`` (3,) and to fit its place."""
        fitting = rotation_about_vertical(self.turn_to_fit) @ self.down
        return command_towards(self._held, target, self._turning(fitting), speed, self.gain)

    def _turning(self, target: Vector) -> Vector:
        """Return how (3, 3) to turn the hand first on its way to ``target``: not through the last joint's stops."""
        now = self.down
        left = wrapped(yaw(target[:, 1]) - yaw(now[:, 1]))
        if abs(left) <= TURN_AT_ONCE:
            return target
        left = self.wrist - wrapped(self.wrist - left)
        at_once = float(np.clip(left, -TURN_AT_ONCE, TURN_AT_ONCE))
        return rotation_about_vertical(at_once) @ now

    phases: ClassVar = {
        REACH: Phase(reach, OPEN, {DESCEND: is_above}),
        DESCEND: Phase(descend, OPEN, {GRASP: is_around, REACH: is_astray}),
        GRASP: Phase(grasp, CLOSE, {RAISE: has_gripped}),
        RAISE: Phase(lift, CLOSE, {RETREAT: has_lost_it, CARRY: is_lifted}),
        CARRY: Phase(carry, CLOSE, {RETREAT: has_lost_it, LOWER: is_over_place}),
        LOWER: Phase(
            lower, CLOSE, {RETREAT: has_lost_it, CARRY: has_slipped_aside, RELEASE: is_down}
        ),
        RELEASE: Phase(release, OPEN, {RETREAT: has_let_go}),
        RETREAT: Phase(retreat, OPEN),  # ``advance`` goes on with the next task
    }


class CarryExpert(Expert):
    """An expert that carries objects one after another; the plan of its state is the present task."""

    pace = 0.55

    @abstractmethod
    def next_task(self, observation: Any) -> CarryTask | None:
        """Return what to carry next; None where everything is done."""

    def begin(self, observation: Any) -> State:
        speed = self.draw_speed()
        waypoint_offset = self.draw_offset()
        task = self.next_task(observation)
        if task is None:
            anchor = self.read(observation, "hand_position")
            return State(speed, task, waypoint_offset, anchor=anchor, phase=RETREAT)
        return State(speed, task, waypoint_offset)

    def observe(self, observation: Any, state: State) -> CarryScene:
        thing = None
        if state.plan is not None:
            thing = self.read.pose(observation, state.plan.name)
        return CarryScene(
            state,
            hand=self.read.hand(observation),
            thing=thing,
            fingers=self.read(observation, "gripper_velocity"),
            wrist=self._wrist(observation),
            is_careful=self.is_careful,
            gain=self.gain,
        )

    def advance(self, scene: CarryScene, observation: Any) -> State:
        """Return the state in the next phase; once the hand has gone up, with the next task."""
        state = scene.state
        if state.phase != RETREAT:
            return super().advance(scene, observation)
        if state.steps_in_phase < RETREATED:
            return state
        task = self.next_task(observation)
        if task is None:
            return state
        return self.entered(scene, REACH)._replace(plan=task)

    def _wrist(self, observation: Any) -> float:
        """Return the angle of the arm's last joint [rad]."""
        return float(self.read(observation, "joint_position")[-1])

    def at_ease(self, task: CarryTask, observation: Any) -> CarryTask:
        """Return the task with one of its two grasps and headings: those with room for the arm's last joint.

        That joint turns back with a hand that points down, and onwards with the arm's bearing. Of several choices with
        room, the one that turns it least counts.
        """
        thing = self.read.pose(observation, task.name)
        hand = self.read.hand(observation)
        robot = self.robosuite.robots[0]
        base = robot.base_pos
        last_joint = robot._ref_joint_indexes[-1]
        stops = self.inner.simulation.model.jnt_range[last_joint]
        most = stops[1] - ROOM
        now = self._wrist(observation)
        bearing = yaw(hand.position - base)
        along = now + yaw(hand.orientation[:, 1]) - bearing
        heading = yaw(thing.orientation[:, 0])

        def strain(choice: tuple[Vector, float]) -> tuple[float, float]:
            """How far the last joint comes beyond where it has room, and how far it turns in all [rad]."""
            closing, wanted = choice
            fitting = rotation_about_vertical(wanted - heading) @ thing.orientation
            picked_at = yaw(thing.point(task.grip) - base)
            placed_at = yaw(task.place + fitting @ task.grip - base)
            grasp = wrapped(along - yaw(thing.orientation @ closing) + picked_at)
            place = wrapped(along - yaw(fitting @ closing) + placed_at)
            beyond = max(abs(grasp) - most, abs(place) - most, 0.0)
            return beyond, abs(grasp - now) + abs(place - grasp)

        choices = product((task.closing, -task.closing), task.headings or (heading,))
        closing, wanted = min(choices, key=strain)
        eased = task._replace(closing=closing, turns=2 * np.pi)
        if task.headings:
            return eased._replace(headings=(wanted,))
        return eased
