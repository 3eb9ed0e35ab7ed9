"""Picks an object up and puts it somewhere: what stacking, sorting and fitting nuts have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import (
    CLOSE,
    OPEN,
    PhasedExpert,
    Style,
    Vector,
    gripping,
    has_settled,
    matrix,
    move,
    over_first,
    rotation,
    turn_left,
)

REACH, DESCEND, GRASP, RAISE, CARRY, LOWER, RELEASE, RETREAT = range(8)

_AHEAD = 1.0  # how far to turn the hand at once [rad]
_ROOM = 0.9  # how far from its stops the last joint is to stay [rad]
_EXACT = 0.005  # what has to fit as exactly as this is not lowered beside its place [m]


class CarryTask(NamedTuple):
    """What to carry where.

    Args:
        name: of the object, as observations call it.
        grip: (3,) where to hold it, in its own frame [m].
        closing: (3,) along which of its own axes the fingers close; None where every direction does.
        turns: after how much of a turn about the vertical the grasp is the same again [rad].
        clearance: how far above its grip to come from [m].
        place: (3,) where its origin is to go [m].
        over: how far above ``place`` to carry it [m].
        headings: those of its x axis that fit the place [rad]; empty where every one does.
        heading_fit: how exactly it must have one of them before it is lowered [rad].
        fit: how exactly it must stand over its place before it is lowered [m].
        haste: with which share of the usual speed the hand comes down.
    """

    name: str
    grip: Vector
    closing: Vector | None
    turns: float
    clearance: float
    place: Vector
    over: float
    headings: tuple[float, ...] = ()
    heading_fit: float = 0.06
    fit: float = 0.02
    haste: float = 1.0


class CarryState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    spread: Vector  # (3,) how this episode's way-points differ from the plan [m]
    task: CarryTask | None
    anchor: Vector  # (3,) where the hand was when the phase began [m]
    drift: Vector  # correlated action noise


class CarryExpert(PhasedExpert):
    """An expert that carries objects one after the other; the arguments are those of ``PhasedExpert``."""

    pace = 0.55
    """Hand speed in action units."""

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None) -> None:
        super().__init__(env, seed, style)
        self._gain = 3.0 if self._careful else 2.0

    @abstractmethod
    def next_task(self, observation: Any) -> CarryTask | None:
        """What to carry next; None where everything is done."""

    def _act(self, observation: Any, state: CarryState, noise: Vector) -> tuple[Vector, CarryState]:
        hand_at = self._read(observation, "hand_position")
        hand = rotation(self._read(observation, "hand_orientation"))
        state = self._advance(state, observation, hand_at, hand)
        command = self._command(state, observation, hand_at, hand)
        command[:6] += noise[:6]
        return command, state

    def _begin(self, observation: Any) -> CarryState:
        style, rng = self.style, self.np_random
        pace = style.pace(self.pace, rng)
        spread = style.spread * rng.standard_normal(3)
        return CarryState(REACH, 0, pace, spread, self.next_task(observation), np.zeros(3), np.zeros(7))

    def pose(self, observation: Any, name: str) -> tuple[Vector, Vector]:
        """(3,) position and (3, 3) rotation of an object."""
        return self._read(observation, f"{name}_pos"), matrix(self._read(observation, f"{name}_quat"))

    def _advance(self, state: CarryState, observation: Any, hand_at: Vector, hand: Vector) -> CarryState:
        """The phase that comes next, where this one has done its work."""

        def to(phase: int) -> CarryState:
            return state._replace(phase=phase, since=0, anchor=hand_at)

        task, phase = state.task, state.phase
        if task is None:
            return state
        at, turned = self.pose(observation, task.name)
        fingers = self._read(observation, "gripper_velocity")
        grip = at + turned @ task.grip
        off = hand_at - grip
        lost = np.linalg.norm(off) > 0.05
        if phase == REACH:
            aligned = turn_left(hand, self._grasp(task, hand, turned)) < 0.15
            above = np.linalg.norm(off[:2] - state.spread[:2] * 0.3) < 0.02 and abs(off[2] - task.clearance) < 0.03
            return to(DESCEND) if above and aligned else state
        if phase == DESCEND:
            if np.linalg.norm(off) < 0.011 or (state.since > 30 and np.linalg.norm(off) < 0.02):
                return to(GRASP)
            return to(REACH) if state.since > 60 or np.linalg.norm(off[:2]) > 0.06 else state
        if phase == GRASP:
            return to(RAISE) if has_settled(fingers, state.since, 7) else state
        if phase in (RAISE, CARRY, LOWER) and lost:
            return to(RETREAT)  # and see where it falls: it may be where it belongs
        place = task.place + np.array([0.0, 0.0, task.over])
        # Whoever cannot get nearer, at the end of his reach, makes do with less in time.
        fit = task.fit * (1 + state.since / 60) if self._careful else task.fit
        if phase == RAISE:
            return to(CARRY) if at[2] > place[2] - 0.03 or state.since > 60 else state
        if phase == CARRY:
            fits = abs(_to_fit(task.headings, turned)) < task.heading_fit
            there = np.linalg.norm(at[:2] - task.place[:2]) < fit
            return to(LOWER) if there and fits else state
        if phase == LOWER:
            if np.linalg.norm(at[:2] - task.place[:2]) > task.fit * (2.5 if self._careful else 1.0) + 0.02:
                return to(CARRY)
            if at[2] < task.place[2] + 0.006 or (state.since > 50 and at[2] < task.place[2] + 0.03):
                return to(RELEASE)
            return to(CARRY) if state.since > 60 else state  # it stands on something: up, and once more
        if phase == RELEASE:
            return to(RETREAT) if has_settled(fingers, state.since, 6) else state
        if state.since >= 14:
            task = self.next_task(observation)
            if task is not None:
                return to(REACH)._replace(task=task)
        return state

    def _command(self, state: CarryState, observation: Any, hand_at: Vector, hand: Vector) -> Vector:
        """(7,) towards what the phase asks for."""
        task, phase = state.task, state.phase
        if task is None:
            return np.append(np.zeros(6), OPEN)
        at, turned = self.pose(observation, task.name)
        grip = at + turned @ task.grip
        held = self._turning(observation, hand, self._held(task, hand, turned))
        if phase in (REACH, DESCEND):
            aligned = self._turning(observation, hand, self._grasp(task, hand, turned))
            above = np.array([0.0, 0.0, task.clearance]) + 0.3 * state.spread
            target = grip + above if phase == REACH else grip
            # From afar, first high: the way may lead over a wall or another object.
            if phase == REACH and np.linalg.norm((grip - hand_at)[:2]) > 0.1:
                target = np.array([target[0], target[1], max(target[2], min(hand_at[2], target[2] + 0.1))])
            if phase == DESCEND and self._careful:
                target = target + over_first(hand_at, grip)
            speed = state.speed * (task.haste if phase == DESCEND else 1.0)
            return np.append(move(hand_at, target, hand, aligned, speed, self._gain), OPEN)
        if phase == GRASP:
            gain = self._gain if self._careful else 1.0
            return np.append(move(hand_at, state.anchor, hand, gripping(hand, None), state.speed, gain), CLOSE)
        goal = task.place + np.array([0.0, 0.0, task.over])
        if phase == RAISE:
            wanted = np.array([at[0], at[1], goal[2] + 0.3 * state.spread[2]])
            return np.append(move(at, wanted, hand, gripping(hand, None), state.speed), CLOSE)
        if phase == CARRY:
            return np.append(move(at, goal, hand, held, state.speed, self._gain), CLOSE)
        if phase == LOWER:
            place = self._lower(task, at) if self._careful or task.fit <= _EXACT else task.place
            return np.append(move(at, place, hand, held, 0.6 * state.speed, self._gain), CLOSE)
        up = state.anchor + np.array([0.0, 0.0, 0.0 if phase == RELEASE else 0.12])
        return np.append(move(hand_at, up, hand, gripping(hand, None), state.speed), OPEN)

    @staticmethod
    def _lower(task: CarryTask, at: Vector) -> Vector:
        """(3,) where an object is to go next on its way down: the further from over its place, the less down."""
        astray = float(np.linalg.norm((at - task.place)[:2]))
        down = 0.025 * float(np.clip(1.5 - 0.5 * astray / task.fit, 0.0, 1.0))
        return np.array([*task.place[:2], max(task.place[2], at[2] - down)])

    def _at_ease(self, task: CarryTask, observation: Any) -> CarryTask:
        """The task with one of its two grasps and one of its headings: those that leave the last joint room.

        Of a hand that points down, the last joint turns back with the hand and onwards with the arm's bearing. Of
        grasps that leave room enough, the one is chosen that turns it least.
        """
        if task.closing is None:
            return task
        at, turned = self.pose(observation, task.name)
        hand = rotation(self._read(observation, "hand_orientation"))
        env = self.env.unwrapped
        robot = env.robosuite_env.robots[0]  # type: ignore[attr-defined]
        most = env.simulation.model.jnt_range[robot._ref_joint_indexes[-1], 1] - _ROOM  # type: ignore[attr-defined]
        now, base = self._wrist(observation), robot.base_pos
        along = now + _yaw(hand[:, 1]) - _yaw(self._read(observation, "hand_position") - base)
        heading = _yaw(turned[:, 0])

        def strain(choice: tuple[Vector, float]) -> tuple[float, float]:
            """How far the last joint comes beyond where it has room, and how far it turns in all [rad]."""
            closing, wanted = choice
            fitting = about_vertical(wanted - heading) @ turned
            grasp = _wrapped(along - _yaw(turned @ closing) + _yaw(at + turned @ task.grip - base))
            place = _wrapped(along - _yaw(fitting @ closing) + _yaw(task.place + fitting @ task.grip - base))
            return max(abs(grasp) - most, abs(place) - most, 0.0), abs(grasp - now) + abs(place - grasp)

        choices = [(c, h) for c in (task.closing, -task.closing) for h in task.headings or (heading,)]
        closing, wanted = min(choices, key=strain)
        return task._replace(closing=closing, turns=2 * np.pi, headings=(wanted,) if task.headings else ())

    def _turning(self, observation: Any, hand: Vector, target: Vector) -> Vector:
        """(3, 3) where to turn the hand first on its way to ``target``: not through the last joint's stops.

        The shortest turn may lead there where it is nearly half a one.
        """
        down = gripping(hand, None)
        left = _wrapped(_yaw(target[:, 1]) - _yaw(down[:, 1]))
        if abs(left) <= _AHEAD:
            return target
        wrist = self._wrist(observation)
        left = wrist - _wrapped(wrist - left)
        first: Vector = about_vertical(float(np.clip(left, -_AHEAD, _AHEAD))) @ down
        return first

    def _wrist(self, observation: Any) -> float:
        """Angle of the arm's last joint [rad]."""
        return float(self._read(observation, "joint_position")[-1])

    @staticmethod
    def _grasp(task: CarryTask, hand: Vector, turned: Vector) -> Vector:
        """(3, 3) how to hold the hand for grasping."""
        return gripping(hand, None if task.closing is None else turned @ task.closing, task.turns)

    def _held(self, task: CarryTask, hand: Vector, turned: Vector) -> Vector:
        """(3, 3) how to hold the hand so that the object in it comes to fit its place."""
        return about_vertical(_to_fit(task.headings, turned)) @ gripping(hand, None)


def _to_fit(headings: tuple[float, ...], turned: Vector) -> float:
    """The smallest turn about the vertical that gives an object one of the ``headings`` [rad]; 0 without any."""
    heading = _yaw(turned[:, 0])
    left = [_wrapped(h - heading) for h in headings]
    return float(min(left, key=abs, default=0.0))


def _yaw(direction: Vector) -> float:
    """Angle of a direction (3,) about the vertical [rad]."""
    return float(np.arctan2(direction[1], direction[0]))


def _wrapped(angle: float) -> float:
    """The same angle in [-π, π) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def about_vertical(angle: float) -> Vector:
    """(3, 3) rotation about the vertical [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
