"""Picks an object up and puts it somewhere: what stacking, fitting nuts and sorting have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, Expert, State, has_settled, over_first
from asm_gym.policies.scripted.geometry import (
    UP,
    Pose,
    Vector,
    about_vertical,
    angle_between,
    flattest_side,
    gripping,
    move,
    wrapped,
    yaw,
)

REACH, DESCEND, GRASP, RAISE, CARRY, LOWER, RELEASE, RETREAT = range(8)
_AHEAD = 1.0  # how far to turn the hand at once [rad]
_ROOM = 0.9  # how far from its stops the last joint is to stay [rad]
_EXACT = 0.005  # what has to fit as exactly as this is not lowered beside its place [m]
_SMALL, _LARGE = 0.02, 0.025  # half the edges of the two cubes of Stack [m]
_HANDLE = {"SquareNut": 0.054, "RoundNut": 0.06}  # from a nut's middle to that of its handle [m]


class CarryTask(NamedTuple):
    """What to carry where."""

    name: str  # of the object, as observations call it
    grip: Vector  # (3,) where to hold it, in its own frame [m]
    # (3,) along which of its own axes the fingers close; None where every direction does
    closing: Vector | None
    turns: float  # after how much of a turn about the vertical the grasp is the same again [rad]
    clearance: float  # how far above its grip to come from [m]
    place: Vector  # (3,) where its origin is to go [m]
    over: float  # how far above ``place`` to carry it [m]
    # those of its x axis that fit the place [rad]; empty where every one does
    headings: tuple[float, ...] = ()
    heading_fit: float = 0.06  # how exactly it must have one of them before it is lowered [rad]
    fit: float = 0.02  # how exactly it must stand over its place before it is lowered [m]
    haste: float = 1.0  # with which share of the usual speed the hand comes down


class CarryScene(NamedTuple):
    """What is observed."""

    observation: Any
    hand: Pose
    fingers: Vector  # velocities of the gripper's joints


class CarryExpert(Expert):
    """An expert that carries objects one after another; the plan of its state is the present task, None at the end."""

    pace = 0.55

    @abstractmethod
    def next_task(self, observation: Any) -> CarryTask | None:
        """Return what to carry next; None where everything is done."""

    def begin(self, observation: Any) -> State:
        speed = self.style.pace(self.pace, self.np_random)
        spread = self.style.spread * self.np_random.standard_normal(3)
        return self.start(speed, spread, self.next_task(observation))

    def look(self, observation: Any) -> CarryScene:
        return CarryScene(
            observation, self.read.hand(observation), self.read(observation, "gripper_velocity")
        )

    def advance(self, state: State, scene: CarryScene) -> State:
        if state.plan is None:
            return state
        if state.phase == RETREAT:
            task = self.next_task(scene.observation) if state.since >= 14 else None
            return state if task is None else self.entered(state, scene, REACH)._replace(plan=task)
        return super().advance(state, scene)

    def next_phase(self, state: State, scene: CarryScene) -> int:
        task, phase, since = state.plan, state.phase, state.since
        at, turned = thing = self.read.pose(scene.observation, task.name)
        off = scene.hand.at - thing.point(task.grip)
        far, beside = np.linalg.norm(off), np.linalg.norm(at[:2] - task.place[:2])
        if phase == REACH:
            aligned = (
                angle_between(scene.hand.turned, self._grasp(task, scene.hand.turned, turned))
                < 0.15
            )
            above = (
                np.linalg.norm(off[:2] - state.spread[:2] * 0.3) < 0.02
                and abs(off[2] - task.clearance) < 0.03
            )
            return DESCEND if above and aligned else REACH
        if phase == DESCEND:
            if far < 0.011 or (since > 30 and far < 0.02):
                return GRASP
            return REACH if since > 60 or np.linalg.norm(off[:2]) > 0.06 else DESCEND
        if phase == GRASP:
            return RAISE if has_settled(scene.fingers, since, 7) else GRASP
        if phase in (RAISE, CARRY, LOWER) and far > 0.05:
            return RETREAT  # and see where it falls: it may be where it belongs
        if phase == RAISE:
            return CARRY if at[2] > task.place[2] + task.over - 0.03 or since > 60 else RAISE
        if phase == CARRY:
            # An arm that cannot get nearer, at the end of its reach, makes do with less in time.
            fit = task.fit * (1 + since / 60) if self._careful else task.fit
            fits = abs(_turn_to_fit(task.headings, turned)) < task.heading_fit
            return LOWER if beside < fit and fits else CARRY
        if phase == LOWER:
            if beside > task.fit * (2.5 if self._careful else 1.0) + 0.02:
                return CARRY
            if at[2] < task.place[2] + 0.006 or (since > 50 and at[2] < task.place[2] + 0.03):
                return RELEASE
            return CARRY if since > 60 else LOWER  # it stands on something: up, and once more
        return RETREAT if has_settled(scene.fingers, since, 6) else RELEASE

    def command(self, state: State, scene: CarryScene) -> Vector:
        task, phase, hand, speed = state.plan, state.phase, scene.hand, state.speed
        if task is None:
            return np.append(np.zeros(6), OPEN)
        at, turned = thing = self.read.pose(scene.observation, task.name)
        down = gripping(hand.turned, None)
        if phase in (REACH, DESCEND):
            grip = thing.point(task.grip)
            aligned = self._turning(
                scene.observation, hand.turned, self._grasp(task, hand.turned, turned)
            )
            target = (
                grip + (np.array([0.0, 0.0, task.clearance]) + 0.3 * state.spread)
                if phase == REACH
                else grip
            )
            # From afar, first high: the way may lead over a wall or another object.
            if phase == REACH and np.linalg.norm((grip - hand.at)[:2]) > 0.1:
                target = np.array(
                    [target[0], target[1], max(target[2], min(hand.at[2], target[2] + 0.1))]
                )
            if phase == DESCEND and self._careful:
                target = target + over_first(hand.at, grip)
            haste = task.haste if phase == DESCEND else 1.0
            return np.append(move(hand, target, aligned, speed * haste, self._gain), OPEN)
        if phase == GRASP:
            return np.append(
                move(hand, state.anchor, down, speed, self._gain if self._careful else 1.0), CLOSE
            )
        # From here on the object is moved, and the hand with it.
        held = hand._replace(at=at)
        goal = task.place + np.array([0.0, 0.0, task.over])
        if phase == RAISE:
            wanted = np.array([at[0], at[1], goal[2] + 0.3 * state.spread[2]])
            return np.append(move(held, wanted, down, speed), CLOSE)
        if phase in (CARRY, LOWER):
            fitting = self._turning(
                scene.observation, hand.turned, self._held(task, hand.turned, turned)
            )
            if phase == LOWER:
                goal = self._lower(task, at) if self._careful or task.fit <= _EXACT else task.place
            share = 1.0 if phase == CARRY else 0.6
            return np.append(move(held, goal, fitting, share * speed, self._gain), CLOSE)
        up = state.anchor + np.array([0.0, 0.0, 0.0 if phase == RELEASE else 0.12])
        return np.append(move(hand, up, down, speed), OPEN)

    @staticmethod
    def _lower(task: CarryTask, at: Vector) -> Vector:
        """Return where (3,) an object is to go next on its way down: the further from over its place, the less down."""
        astray = float(np.linalg.norm((at - task.place)[:2]))
        down = 0.025 * float(np.clip(1.5 - 0.5 * astray / task.fit, 0.0, 1.0))
        return np.array([*task.place[:2], max(task.place[2], at[2] - down)])

    def at_ease(self, task: CarryTask, observation: Any) -> CarryTask:
        """Return the task with one of its two grasps and headings: those with room for the last joint, which turns back
        with a hand that points down and onwards with the arm's bearing; of several, those that turn it least."""
        if task.closing is None:
            return task
        thing = self.read.pose(observation, task.name)
        turned = thing.turned
        hand = self.read.hand(observation)
        robot, model = self.robosuite.robots[0], self.inner.simulation.model
        most = model.jnt_range[robot._ref_joint_indexes[-1], 1] - _ROOM
        now, base = self._wrist(observation), robot.base_pos
        along = now + yaw(hand.turned[:, 1]) - yaw(hand.at - base)
        heading = yaw(turned[:, 0])

        def strain(choice: tuple[Vector, float]) -> tuple[float, float]:
            """How far the last joint comes beyond where it has room, and how far it turns in all [rad]."""
            closing, wanted = choice
            fitting = about_vertical(wanted - heading) @ turned
            grasp = wrapped(along - yaw(turned @ closing) + yaw(thing.point(task.grip) - base))
            place = wrapped(
                along - yaw(fitting @ closing) + yaw(task.place + fitting @ task.grip - base)
            )
            return max(abs(grasp) - most, abs(place) - most, 0.0), abs(grasp - now) + abs(
                place - grasp
            )

        choices = [
            (c, h) for c in (task.closing, -task.closing) for h in task.headings or (heading,)
        ]
        closing, wanted = min(choices, key=strain)
        return task._replace(
            closing=closing, turns=2 * np.pi, headings=(wanted,) if task.headings else ()
        )

    def _turning(self, observation: Any, hand: Vector, target: Vector) -> Vector:
        """Return how (3, 3) to turn the hand first on its way to ``target``: not through the last joint's stops."""
        down = gripping(hand, None)
        left = wrapped(yaw(target[:, 1]) - yaw(down[:, 1]))
        if abs(left) <= _AHEAD:
            return target
        wrist = self._wrist(observation)
        left = wrist - wrapped(wrist - left)
        return about_vertical(float(np.clip(left, -_AHEAD, _AHEAD))) @ down

    def _wrist(self, observation: Any) -> float:
        """Return the angle of the arm's last joint [rad]."""
        return float(self.read(observation, "joint_position")[-1])

    @staticmethod
    def _grasp(task: CarryTask, hand: Vector, turned: Vector) -> Vector:
        """Return how (3, 3) to hold the hand for grasping."""
        return gripping(hand, None if task.closing is None else turned @ task.closing, task.turns)

    def _held(self, task: CarryTask, hand: Vector, turned: Vector) -> Vector:
        """Return how (3, 3) to hold the hand so that the object in it comes to fit its place."""
        return about_vertical(_turn_to_fit(task.headings, turned)) @ gripping(hand, None)


class StackExpert(CarryExpert):
    """A scripted expert for Stack."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the red cube, until it lies on the green one."""
        red, green = (self.read.pose(observation, name) for name in ("cubeA", "cubeB"))
        place = green.at + np.array([0.0, 0.0, _SMALL + _LARGE])
        if np.linalg.norm(red.at - place) < (0.025 if self._careful else 0.02):
            return None
        side, turns = flattest_side(red.turned), np.pi / 2
        if self._careful:  # a wide gripper would stand on the green cube with one finger
            sides = (side, np.cross(UP, side))
            side, turns = min(sides, key=lambda s: abs(s @ (green.at - red.at))), np.pi
        return CarryTask(
            name="cubeA",
            grip=np.zeros(3),
            closing=red.turned.T @ side,
            turns=turns,
            clearance=0.08,
            place=place,
            over=0.06,
            fit=0.006,
        )


class NutAssemblyExpert(CarryExpert):
    """A scripted expert for NutAssembly, with one nut or with both."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return a nut that is not around its peg; None where all are."""
        env = self.robosuite
        # a Panda's elbow reaches its stop sooner than others'
        aside = np.pi / 2 if self._careful else 0.5
        for i, nut in enumerate(env.nuts):
            if env.single_object_mode and i != env.nut_id:
                continue
            at, _ = self.read.pose(observation, nut.name)
            if not env.on_peg(at, i):
                peg = env.sim.data.body_xpos[(env.peg1_body_id, env.peg2_body_id)[i]]
                square = nut.name == "SquareNut"
                task = CarryTask(
                    name=nut.name,
                    grip=np.array([_HANDLE[nut.name], 0.0, 0.0]),
                    closing=np.array([0.0, 1.0, 0.0]),
                    turns=np.pi,
                    clearance=0.1,
                    # Lower, and the palm would stand on the peg.
                    place=np.array([peg[0], peg[1], env.table_offset[2] + 0.05]),
                    over=0.14,
                    # The handle points towards the robot, which could not reach further.
                    headings=(np.pi,) if square else (np.pi - aside, np.pi, np.pi + aside),
                    heading_fit=0.06 if square else 0.2,
                    fit=0.005,
                )
                return self.at_ease(task, observation)
        return None


def _turn_to_fit(headings: tuple[float, ...], turned: Vector) -> float:
    """Return the smallest turn about the vertical that gives an object one of the ``headings`` [rad]; 0 without any."""
    left = [wrapped(h - yaw(turned[:, 0])) for h in headings]
    return float(min(left, key=abs, default=0.0))
