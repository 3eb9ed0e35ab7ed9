"""Hands a hammer from one arm to the other: the first holds it level, leaning to the second, which takes its free end.

Each leans by 45° out of the upright and their fingers close on different pairs of the handle's four sides, so that
neither palm is in the other's way.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import ARMS, CLOSE, OPEN, State, Style, TwoArmExpert, move_arm
from asm_gym.policies.scripted.geometry import UP, Pose, Vector, grasping, gripping

REACH, DESCEND, GRASP, RAISE, OFFER, MEET, TAKE, LET_GO, PART = range(9)

_APART = 0.09  # between the two grips: a palm is 6 cm thick [m]
_DRAWN_IN = 0.025  # how far to move the head inwards while it is raised [m]
_FINGER = 0.014  # how near to an end of the handle a grip may be [m]
_BEFORE = 0.1  # from where the second hand comes to the handle [m]
_HELD = 0.02  # how wide the fingers stay open around a handle, at least [m]; it is 3 to 4 cm thick
_MEETING = 1.15  # height of the hammer where it changes hands [m]
_LEAN = np.pi / 4


class Hammer(NamedTuple):
    """A hammer, and where to hold it."""

    at: Vector  # (3,) the middle of its handle [m]
    along: Vector  # (3,) unit vector from the handle's free end to the head
    across: Vector  # (3,) unit vector of the side that the first hand's fingers close on
    giving: float  # where the first hand holds it, from the middle towards the head [m]
    taking: float  # the same of the second

    def grips(self) -> Vector:
        """Return (2, 3) where the two hands hold it [m]."""
        return self.at + np.outer([self.giving, self.taking], self.along)

    @classmethod
    def seen(cls, pose: Pose, length: float) -> Hammer:
        """Return a hammer with a handle of ``length`` [m]."""
        free = length / 2 - _FINGER
        giving = min(free, _APART + 0.006 - free)
        return cls(pose.at, pose.turned[:, 2], pose.turned[:, 0], giving, max(-free, giving - _APART))


class Meeting(NamedTuple):
    """Where and how a hammer changes hands."""

    at: Vector  # (3,) where the middle between both grips is held [m]
    forth: Vector  # (3,) level unit vector from the first arm to the second

    @classmethod
    def between(cls, first: Vector, second: Vector, height: float) -> Meeting:
        """Return the place half-way between two arms that stand at ``first`` and ``second`` (3,) [m]."""
        forth = (second - first) * [1.0, 1.0, 0.0]
        middle = (first + second) / 2
        return cls(np.array([middle[0], middle[1], height]), forth / np.linalg.norm(forth))

    @property
    def side(self) -> Vector:
        """(3,) level unit vector across, along which the hammer is held."""
        return np.cross(self.forth, UP)

    def giving(self, hand: Vector) -> Vector:
        """Return how (3, 3) the first hand offers the hammer."""
        approach = np.sin(_LEAN) * self.forth - np.cos(_LEAN) * UP
        return grasping(hand, approach, np.cos(_LEAN) * self.forth + np.sin(_LEAN) * UP)

    def taking(self, along: Vector) -> Vector:
        """Return how (3, 3) the second hand takes a hammer that lies ``along`` (3,), its wrist far from its limit."""
        approach = -np.sin(_LEAN) * self.forth - np.cos(_LEAN) * UP
        approach = approach - (approach @ along) * along
        approach /= np.linalg.norm(approach)
        across = np.cross(approach, along)
        across *= -np.sign(across @ self.forth)
        return np.stack([np.cross(across, approach), across, approach], axis=1)


class _Scene(NamedTuple):
    hands: tuple[Pose, Pose]
    hammer: Hammer
    held: bool  # the second hand has something between its fingers


class HandoverExpert(TwoArmExpert):
    """A scripted expert for TwoArmHandover; the plan of its state is the meeting.

    Args:
        env, seed, style: as for ``Expert``.
        name: of the hammer, as observations call it.
        over: how far above the handle to come from [m].
        pace: hand speed in action units.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        seed: int | None = None,
        style: Style | None = None,
        name: str = "hammer",
        over: float = 0.1,
        pace: float = 0.5,
    ) -> None:
        super().__init__(env, seed, style)
        self._name, self._over, self._pace = name, over, pace

    def begin(self, observation: Any) -> State:
        speed = self.style.pace(self._pace, self.np_random)
        spread = self.style.spread * np.clip(self.np_random.standard_normal(3), -2, 2)
        first, second = self.places()
        meeting = Meeting.between(first, second, _MEETING)
        meeting = meeting._replace(at=meeting.at + spread)
        return self.start(speed, spread, meeting, noises=7 * ARMS, anchor=np.zeros((ARMS, 3)))

    def look(self, observation: Any) -> _Scene:
        held = float(np.abs(self.read(observation, "robot1_gripper_opening")).sum()) > _HELD
        return _Scene(self.hands(observation), self.hammer(observation), held)

    def hammer(self, observation: Any) -> Hammer:
        """Return the hammer as it is observed; its length is the model's."""
        (model,) = (thing for thing in self.robosuite.model.mujoco_objects if thing.name == self._name)
        return Hammer.seen(self.read.pose(observation, self._name), model.handle_length)

    def next_phase(self, state: State, scene: _Scene) -> int:
        phase, since, hammer, meeting = state.phase, state.since, scene.hammer, state.plan
        at = np.stack([hand.at for hand in scene.hands])  # (2, 3)
        off = at - hammer.grips()  # (2, 3)
        far = np.linalg.norm(off, axis=1)  # (2,)
        if phase == REACH:
            aligned = abs(scene.hands[0].turned[:, 1] @ hammer.across) > np.cos(0.15)
            return DESCEND if aligned and np.linalg.norm(off[0] - self._above(state)) < 0.025 else REACH
        if phase == DESCEND:
            if far[0] < 0.009 or (since > 30 and far[0] < 0.015):
                return GRASP
            return REACH if since > 60 else DESCEND
        if phase == GRASP:
            return RAISE if since >= 8 else GRASP
        if phase in (RAISE, OFFER, MEET) and far[0] > 0.06:  # lost it
            return REACH
        if phase == RAISE:
            return OFFER if at[0, 2] - state.anchor[0, 2] > self._over + 0.05 or since > 60 else RAISE
        if phase == OFFER:
            offered = abs(hammer.along @ meeting.side) > np.cos(0.8)
            there = np.linalg.norm(hammer.grips().mean(axis=0) - meeting.at) < 0.02
            before = np.linalg.norm(at[1] - _before(meeting, hammer)) < 0.025
            return MEET if offered and there and before else OFFER
        if phase == MEET:
            if far[1] < 0.01 or (since > 30 and far[1] < 0.02):
                return TAKE
            return OFFER if since > 60 else MEET
        if phase == TAKE and since >= 8:
            return LET_GO if scene.held else OFFER
        return PART if phase == LET_GO and since >= 6 else phase

    def command(self, state: State, scene: _Scene) -> Vector:
        command = np.zeros((ARMS, 7))
        goals = self._give(state, scene), self._take(state, scene)
        for i, (base, hand, (at, turned, grip)) in enumerate(zip(self.bases(), scene.hands, goals, strict=True)):
            command[i, :6] = move_arm(base, hand, at, turned, state.speed, gain=2.0)
            command[i, 6] = grip
        return command.reshape(-1)

    def _above(self, state: State) -> Vector:
        """Return (3,) from the grip to where the first hand comes down from [m]."""
        above: Vector = self._over * UP + 0.3 * state.spread
        return above

    def _give(self, state: State, scene: _Scene) -> tuple[Vector, Vector, float]:
        """Return position (3,), orientation (3, 3) and grip that the first hand is to have."""
        phase, hammer, hand, meeting = state.phase, scene.hammer, scene.hands[0], state.plan
        grip, anchor = hammer.grips()[0], state.anchor[0]
        down = gripping(hand.turned, hammer.across)
        if phase == REACH:
            return grip + self._above(state), down, OPEN
        if phase == DESCEND:
            return grip, down, OPEN
        if phase == GRASP:
            return anchor, gripping(hand.turned, None), CLOSE
        if phase == RAISE:
            # Little by little, and with the head drawn in: a bin's wall would turn the hammer between its fingers.
            drawn = anchor - _DRAWN_IN * hammer.along
            return np.array([*drawn[:2], hand.at[2] + 0.02]), down, CLOSE
        offering = meeting.giving(hand.turned)
        if phase in (OFFER, MEET):
            return hand.at + meeting.at - hammer.grips().mean(axis=0), offering, CLOSE
        if phase == TAKE:
            return anchor, offering, CLOSE
        return anchor - (0.15 if phase == PART else 0.0) * hand.turned[:, 2], offering, OPEN

    def _take(self, state: State, scene: _Scene) -> tuple[Vector, Vector, float]:
        """Return position (3,), orientation (3, 3) and grip that the second hand is to have."""
        phase, hammer, meeting = state.phase, scene.hammer, state.plan
        if phase <= RAISE:
            waiting = meeting.taking(meeting.side)
            return meeting.at - 0.2 * waiting[:, 2], waiting, OPEN
        taking = meeting.taking(hammer.along)
        if phase == OFFER:
            return _before(meeting, hammer), taking, OPEN
        if phase == MEET:
            return hammer.grips()[1], taking, OPEN
        # Alone with it, the hand stays as it is: the hammer may turn between its fingers.
        return state.anchor[1], meeting.taking(meeting.side) if phase == PART else taking, CLOSE


def _before(meeting: Meeting, hammer: Hammer) -> Vector:
    """Return (3,) from where the second hand comes to the free end, once the hammer is where they meet [m]."""
    end = meeting.at + (hammer.taking - hammer.giving) / 2 * hammer.along
    before: Vector = end - _BEFORE * meeting.taking(hammer.along)[:, 2]
    return before
