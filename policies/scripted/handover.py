"""Hands a hammer from one arm to the other: the first holds it level, leaning to the second, which takes its free end.

Each leans by 45° out of the upright and their fingers close on different pairs of the handle's four sides, so that
neither palm is in the other's way.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, PhasedExpert, Style, Vector, grasping, gripping, matrix
from asm_gym.policies.scripted.two_arms import ARMS, Hand, Hands, move_arm

REACH, DESCEND, GRASP, RAISE, OFFER, MEET, TAKE, LET_GO, PART = range(9)

_APART = 0.09  # between the two grips: a palm is 6 cm thick [m]
_DRAWN_IN = 0.025  # how far to move the head inwards while it is raised [m]
_FINGER = 0.014  # how near to an end of the handle a grip may be [m]
_BEFORE = 0.1  # from where the second hand comes to the handle [m]
_HELD = 0.02  # how wide the fingers stay open around a handle, at least [m]; it is 3 to 4 cm thick
_MEETING = 1.15  # height of the hammer where it changes hands [m]
_LEAN = np.pi / 4
_UP = np.array([0.0, 0.0, 1.0])


class Hammer(NamedTuple):
    """A hammer, and where to hold it."""

    at: Vector  # (3,) the middle of its handle [m]
    along: Vector  # (3,) unit vector from the handle's free end to the head
    across: Vector  # (3,) unit vector of the side that the first hand's fingers close on
    giving: float  # where the first hand holds it, from the middle towards the head [m]
    taking: float  # the same of the second

    def grips(self) -> Vector:
        """(2, 3) where the two hands hold it [m]."""
        return self.at + np.outer([self.giving, self.taking], self.along)

    @classmethod
    def seen(cls, at: Vector, turned: Vector, length: float) -> Hammer:
        """One with a handle of ``length`` [m] whose frame is ``turned`` (3, 3)."""
        free = length / 2 - _FINGER
        giving = min(free, _APART + 0.006 - free)
        return cls(at, turned[:, 2], turned[:, 0], giving, max(-free, giving - _APART))


class Meeting(NamedTuple):
    """Where and how a hammer changes hands."""

    at: Vector  # (3,) where the middle between both grips is held [m]
    forth: Vector  # (3,) level unit vector from the first arm to the second

    @classmethod
    def between(cls, first: Vector, second: Vector, height: float) -> Meeting:
        """Half-way between two arms that stand at ``first`` and ``second`` (3,) [m]."""
        forth = (second - first) * [1.0, 1.0, 0.0]
        middle = (first + second) / 2
        return cls(np.array([middle[0], middle[1], height]), forth / np.linalg.norm(forth))

    def giving(self, hand: Vector) -> Vector:
        """(3, 3) how the first hand offers the hammer."""
        approach = np.sin(_LEAN) * self.forth - np.cos(_LEAN) * _UP
        return grasping(hand, approach, np.cos(_LEAN) * self.forth + np.sin(_LEAN) * _UP)

    def taking(self, along: Vector) -> Vector:
        """(3, 3) how the second hand takes a hammer that lies ``along`` (3,), with its wrist far from its limit."""
        approach = -np.sin(_LEAN) * self.forth - np.cos(_LEAN) * _UP
        approach = approach - (approach @ along) * along
        approach /= np.linalg.norm(approach)
        across = np.cross(approach, along)
        across *= -np.sign(across @ self.forth)
        return np.stack([np.cross(across, approach), across, approach], axis=1)


class HandoverState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    spread: Vector  # (3,) how this episode's way-points differ from the plan [m]
    over: float  # how far above the handle the first hand comes from [m]
    meeting: Meeting
    bases: Vector  # (2, 3, 3) how the arms stand in the room
    anchors: Vector  # (2, 3) where the hands were when the phase began [m]
    drift: Vector  # (14,) correlated action noise


class HandoverExpert(PhasedExpert):
    """A scripted expert for TwoArmHandover.

    Args:
        env, seed, style: as for ``PhasedExpert``.
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
        self._hands = Hands(env)
        self._name, self._over, self._pace = name, over, pace

    def _act(self, observation: Any, state: HandoverState, noise: Vector) -> tuple[Vector, HandoverState]:
        hands = self._hands.look(observation)
        hammer = self.hammer(observation)
        holds = float(np.abs(self._read(observation, "robot1_gripper_opening")).sum()) > _HELD
        state = _advance(state, hands, hammer, holds)
        command = np.zeros((ARMS, 7))
        for i, (at, turn, grip) in enumerate((_give(state, hands[0], hammer), _take(state, hammer))):
            command[i, :6] = move_arm(state.bases[i], hands[i], at, turn, state.speed, gain=2.0)
            command[i, 6] = grip
        command[:, :6] += noise.reshape(ARMS, 7)[:, :6]
        return command.reshape(-1), state

    def hammer(self, observation: Any) -> Hammer:
        """The hammer as it is observed; its length is the model's."""
        env = self.env.unwrapped.robosuite_env  # type: ignore[attr-defined]
        (model,) = (thing for thing in env.model.mujoco_objects if thing.name == self._name)
        turned = matrix(self._read(observation, f"{self._name}_quat"))
        return Hammer.seen(self._read(observation, f"{self._name}_pos"), turned, model.handle_length)

    def _begin(self, observation: Any) -> HandoverState:
        style, rng = self.style, self.np_random
        speed = style.pace(self._pace, rng)
        spread = style.spread * np.clip(rng.standard_normal(3), -2, 2)
        first, second = self._hands.places()
        meeting = Meeting.between(first, second, _MEETING)
        return HandoverState(
            phase=REACH,
            since=0,
            speed=speed,
            spread=spread,
            over=self._over,
            meeting=meeting._replace(at=meeting.at + spread),
            bases=self._hands.bases(),
            anchors=np.zeros((ARMS, 3)),
            drift=np.zeros(7 * ARMS),
        )


def _advance(state: HandoverState, hands: tuple[Hand, Hand], hammer: Hammer, holds: bool) -> HandoverState:
    """The phase that comes next; ``holds``: the second hand has something between its fingers."""
    at = np.stack([hand.at for hand in hands])  # (2, 3)

    def to(phase: int) -> HandoverState:
        return state._replace(phase=phase, since=0, anchors=at)

    off = at - hammer.grips()  # (2, 3)
    far = np.linalg.norm(off, axis=1)  # (2,)
    phase, since = state.phase, state.since
    if phase == REACH:
        aligned = abs(hands[0].turned[:, 1] @ hammer.across) > np.cos(0.15)
        above = np.linalg.norm(off[0] - _above(state)) < 0.025
        return to(DESCEND) if aligned and above else state
    if phase == DESCEND:
        if far[0] < 0.009 or (since > 30 and far[0] < 0.015):
            return to(GRASP)
        return to(REACH) if since > 60 else state
    if phase == GRASP:
        return to(RAISE) if since >= 8 else state
    if phase in (RAISE, OFFER, MEET) and far[0] > 0.06:  # lost it
        return to(REACH)
    if phase == RAISE:
        return to(OFFER) if at[0, 2] - state.anchors[0, 2] > state.over + 0.05 or since > 60 else state
    if phase == OFFER:
        offered = abs(hammer.along @ np.cross(state.meeting.forth, _UP)) > np.cos(0.8)
        there = np.linalg.norm(hammer.grips().mean(axis=0) - state.meeting.at) < 0.02
        before = np.linalg.norm(at[1] - _before(state, hammer)) < 0.025
        return to(MEET) if offered and there and before else state
    if phase == MEET:
        if far[1] < 0.01 or (since > 30 and far[1] < 0.02):
            return to(TAKE)
        return to(OFFER) if since > 60 else state
    if phase == TAKE and since >= 8:
        return to(LET_GO) if holds else to(OFFER)
    if phase == LET_GO and since >= 6:
        return to(PART)
    return state


def _above(state: HandoverState) -> Vector:
    """(3,) from the grip to where the first hand comes down from [m]."""
    above: Vector = state.over * _UP + 0.3 * state.spread
    return above


def _before(state: HandoverState, hammer: Hammer) -> Vector:
    """(3,) from where the second hand comes to the free end, once the hammer is where they meet [m]."""
    end = state.meeting.at + (hammer.taking - hammer.giving) / 2 * hammer.along
    before: Vector = end - _BEFORE * state.meeting.taking(hammer.along)[:, 2]
    return before


def _give(state: HandoverState, hand: Hand, hammer: Hammer) -> tuple[Vector, Vector, float]:
    """(3,) where the first hand is to go, (3, 3) how it is to be held, and its grip."""
    grip, anchor = hammer.grips()[0], state.anchors[0]
    down = gripping(hand.turned, hammer.across)
    if state.phase == REACH:
        return grip + _above(state), down, OPEN
    if state.phase == DESCEND:
        return grip, down, OPEN
    if state.phase == GRASP:
        return anchor, gripping(hand.turned, None), CLOSE
    if state.phase == RAISE:
        # Little by little, and with the head drawn in: a bin's wall would turn the hammer between its fingers.
        in_ = anchor - _DRAWN_IN * hammer.along
        return np.array([*in_[:2], hand.at[2] + 0.02]), gripping(hand.turned, hammer.across), CLOSE
    offering = state.meeting.giving(hand.turned)
    if state.phase in (OFFER, MEET):
        return hand.at + state.meeting.at - hammer.grips().mean(axis=0), offering, CLOSE
    if state.phase == TAKE:
        return anchor, offering, CLOSE
    return anchor - (0.15 if state.phase == PART else 0.0) * hand.turned[:, 2], offering, OPEN


def _take(state: HandoverState, hammer: Hammer) -> tuple[Vector, Vector, float]:
    """(3,) where the second hand is to go, (3, 3) how it is to be held, and its grip."""
    if state.phase <= RAISE:
        waiting = state.meeting.taking(np.cross(state.meeting.forth, _UP))
        return state.meeting.at - 0.2 * waiting[:, 2], waiting, OPEN
    taking = state.meeting.taking(hammer.along)
    if state.phase == OFFER:
        return _before(state, hammer), taking, OPEN
    if state.phase == MEET:
        return hammer.grips()[1], taking, OPEN
    # Alone with it, the hand stays as it is: the hammer may turn between its fingers.
    alone = state.meeting.taking(np.cross(state.meeting.forth, _UP))
    return state.anchors[1], alone if state.phase == PART else taking, CLOSE
