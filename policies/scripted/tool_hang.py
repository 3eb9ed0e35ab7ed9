"""Stands the frame in its base and hangs the tool on it.

The frame is an L: a rod with a tip, which goes down into the stand's square tube, and a bar with a hook at its end. It
lies on the table, so the hand takes it leaning: taken from straight above, it would leave the hand level once the rod
is upright; taken along the rod, as an upright one is held best, it would have the palm in the table. The tool is a
wrench whose ring is no wider than the hook is high: it does not go straight on to the bar, but lies down over the hook
and is then turned about the bar's end until it hangs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, Expert, State, has_settled
from asm_gym.policies.scripted.geometry import Pose, Vector, angle_between, carried, grasping, move
from asm_gym.policies.scripted.hanging import (
    FRAME_GRIP,
    HOLE,
    HOOK_TOP,
    IN,
    RING,
    ROD,
    STANDS,
    STEEP,
    TILTED,
    TIP,
    TOOL_GRIP,
    TUBE,
    UPRIGHT,
    Scene,
    astray,
    course,
    hangs,
    is_round,
    steepness,
    tilt,
)

REACH, DESCEND, GRASP, RAISE, CARRY, LOWER, TURN, RELEASE, RETREAT = range(9)
FRAME, TOOL = range(2)

_LEAN = np.radians(55.0)  # how far down the hand points at the lying frame; less, and its palm meets the table
_CLEAR = 1.1  # height at which the hand passes over stand and frame [m]
_RAISED = 1.0  # height of the hand at which what it holds may be turned [m]
_BEFORE = 0.1  # from where the hand comes to what it grasps [m]
_BACK = 0.08  # how far it withdraws: further, and the arm would be stretched out [m]
_LOST = 0.05  # from the grip, where the hand no longer holds the thing [m]
_TURNING = 0.5  # while more is left to turn, the frame is turned where the arm has room [rad]
_OUT = -0.02  # no nearer to the arm's base than that, along x [m]
_AHEAD = 0.33  # how much further to turn it than it is, so that the hand keeps up at its speed of 1 [rad]


class Goal(NamedTuple):
    """What the hand is to do."""

    hand: Pose
    grip: float
    pace: float = 1.0  # of the episode's speed
    gain: float = 2.0


class ToolHangExpert(Expert):
    """A scripted expert for ToolHang, on the Panda; the plan of its state is the thing at hand, ``FRAME`` or ``TOOL``.

    Its anchor is the hand's pose when the phase began.
    """

    pace = 0.6

    def begin(self, observation: Any) -> State:
        style, rng = self.style, self.np_random
        speed, spread = style.pace(self.pace, rng), style.spread * np.clip(rng.standard_normal(3), -2, 2)
        return self.start(speed, spread, FRAME, noises=6, anchor=self.read.hand(observation))

    def look(self, observation: Any) -> Scene:
        frame, tool, base = (self.read.pose(observation, name) for name in ("frame", "tool", "base"))
        fingers = self.read(observation, "gripper_velocity")
        return Scene(self.read.hand(observation), frame, tool, base.point(HOLE), fingers)

    def next_phase(self, state: State, scene: Scene) -> int:
        settled = has_settled(scene.fingers, state.since, 10)
        return (_grasped if state.phase <= RAISE else _placed)(state, scene, settled)

    def advance(self, state: State, scene: Scene) -> State:
        after = super().advance(state, scene)
        if state.phase == RETREAT and state.plan == FRAME and (_left(state, scene)[0] < 0.02 or state.since > 40):
            return self.entered(state, scene, REACH)._replace(plan=TOOL)
        return after

    def entered(self, state: State, scene: Scene, phase: int) -> State:
        return state._replace(phase=phase, since=0, anchor=scene.hand)

    def command(self, state: State, scene: Scene) -> Vector:
        goal = _goal(state, scene)
        command = move(scene.hand, goal.hand.at, goal.hand.turned, goal.pace * state.speed, goal.gain)
        return np.append(command, goal.grip)

    def act(self, state: State, scene: Scene, noise: Vector) -> Vector:
        # A hand that goes slowly is steadier: its noise grows with the command (Harris and Wolpert 1998).
        return super().act(state, scene, _goal(state, scene).pace * noise)


def _grasped(state: State, scene: Scene, settled: bool) -> int:
    """Return the phase that follows one of those up to ``RAISE``."""
    phase = state.phase
    if state.plan == TOOL and hangs(scene):
        return RETREAT  # by itself: whoever takes hold of it again would knock it off
    far = float(np.linalg.norm(scene.hand.at - _grasp(state.plan, scene).at))
    if phase == REACH:
        left, turn = _left(state, scene)
        return DESCEND if left < 0.015 and turn < 0.1 else REACH
    if phase == DESCEND:
        if far < 0.006 or (state.since > 30 and far < 0.015):
            return GRASP
        return REACH if state.since > 60 else DESCEND
    if phase == GRASP:
        return RAISE if settled else GRASP
    if far > _LOST:
        return REACH
    return CARRY if scene.hand.at[2] > _RAISED else RAISE


def _placed(state: State, scene: Scene, settled: bool) -> int:
    """Return the phase that follows one of those from ``CARRY`` on."""
    phase, since = state.phase, state.since
    if phase == RELEASE:
        return RETREAT if settled else RELEASE
    if phase == RETREAT:
        return RETREAT if state.plan == FRAME or since < 20 or hangs(scene) else REACH
    if np.linalg.norm(scene.hand.at - _grasp(state.plan, scene).at) > _LOST:
        return REACH
    left, turn = _left(state, scene)
    if phase == CARRY:
        return LOWER if left < 0.003 and turn < 0.03 else CARRY
    if phase == TURN:
        steep = steepness(scene)
        jams = tilt(scene) > TILTED or since > 80
        if is_round(scene):
            if jams:
                return RELEASE  # there is no way back over the hook but the whole turn
        elif jams or astray(scene) > 0.012:
            return CARRY  # it slipped off the hook
        enough = STEEP[-1] - 0.06 if since < 30 else STEEP[-2]  # a tool that slips in the hand turns no further
        return RELEASE if steep > enough else TURN
    if state.plan == TOOL:
        if tilt(scene) > TILTED:
            return CARRY
        if left < 0.002 or (since > 40 and astray(scene) < 0.005):
            return TURN
        return CARRY if since > 60 else LOWER
    if scene.frame.point(TIP)[2] - scene.hole[2] < STANDS:
        return RELEASE
    return CARRY if since > 120 else LOWER


def _left(state: State, scene: Scene) -> tuple[float, float]:
    """Return how far the hand is from its goal: [m], [rad]."""
    goal = _goal(state, scene).hand
    return float(np.linalg.norm(goal.at - scene.hand.at)), angle_between(scene.hand.turned, goal.turned)


def _goal(state: State, scene: Scene) -> Goal:
    """Return what the hand is to do now."""
    phase, anchor = state.phase, state.anchor
    if phase == REACH:
        grasp = _grasp(state.plan, scene)
        at = grasp.at - _BEFORE * grasp.turned[:, 2] + 0.3 * state.spread
        if np.linalg.norm((at - scene.hand.at)[:2]) > 0.1:
            at = np.array([*at[:2], _CLEAR])
        return Goal(Pose(at, grasp.turned), OPEN)
    if phase == DESCEND:
        return Goal(_grasp(state.plan, scene), OPEN, 0.6)
    if phase == GRASP:
        return Goal(anchor, CLOSE)
    if phase == RAISE:
        return Goal(Pose(scene.hand.at + np.array([0.0, 0.0, 0.05]), anchor.turned), CLOSE)
    if phase in (RELEASE, RETREAT):
        back = 0.0 if phase == RELEASE else _BACK
        return Goal(Pose(anchor.at - back * anchor.turned[:, 2], anchor.turned), OPEN, 0.5)
    return _stand(state, scene) if state.plan == FRAME else _hang(state, scene)


def _grasp(thing: int, scene: Scene) -> Pose:
    """Return how to hold the hand for grasping."""
    if thing == TOOL:
        turned = scene.tool.turned
        return Pose(scene.tool.point(TOOL_GRIP), grasping(scene.hand.turned, -turned[:, 2], turned[:, 1]))
    x, y, z = scene.frame.turned.T
    approach = np.sin(_LEAN) * y - np.cos(_LEAN) * z
    # This way round alone: the other, the wrist would come to its limit in turning the rod upright.
    return Pose(scene.frame.point(FRAME_GRIP), np.stack([np.cross(-x, approach), -x, approach], axis=1))


def _stand(state: State, scene: Scene) -> Goal:
    """Return the goal of the frame: upright over the tube, or on its way down."""
    tip = scene.frame.point(TIP)
    height = float(tip[2] - scene.hole[2])
    if state.phase == CARRY:
        over = TUBE + 0.025 + 0.3 * state.spread[2]
        goal = scene.hole + np.array([0.0, 0.0, over])
        near = np.linalg.norm(goal - tip) < 0.03
        hand = carried(scene.hand, scene.frame, TIP, goal, UPRIGHT)
        if angle_between(scene.hand.turned, hand.turned) > _TURNING:
            # Near its base the arm would fold up in turning, and its wrist come to its stops.
            hand = Pose(np.array([max(state.anchor.at[0], _OUT), state.anchor.at[1], _CLEAR]), hand.turned)
        return Goal(hand, CLOSE, 0.5 if near else 1.0)
    if height < TUBE - IN:
        # Where the tube guides the tip, the hand stays over the hole: a rod that is pushed sideways at its tip jams.
        down = scene.frame.point(ROD)[2] - 0.02
        goal = np.array([*scene.hole[:2], down])
        return Goal(carried(scene.hand, scene.frame, ROD, goal, UPRIGHT), CLOSE, 0.5)
    astray = float(np.linalg.norm((tip - scene.hole)[:2]))
    down = 0.02 * float(np.clip(1.5 - astray / 0.002, 0.0, 1.0)) if height > TUBE - 0.01 else 0.02
    goal = np.array([*scene.hole[:2], tip[2] - down])
    return Goal(carried(scene.hand, scene.frame, TIP, goal, UPRIGHT), CLOSE, 0.5)


def _hang(state: State, scene: Scene) -> Goal:
    """Return the goal of the ring: over the hook, or lowered on to it, or turned about the bar's end."""
    steep = float(STEEP[0])
    if state.phase == TURN:
        steep = float(np.clip(steepness(scene) + min(_AHEAD * state.speed, 0.2), *STEEP[[0, -1]]))
    bar, up = -scene.frame.turned[:, 0], scene.frame.turned[:, 2]
    x, z = np.cos(steep) * bar - np.sin(steep) * up, np.sin(steep) * bar + np.cos(steep) * up
    over = HOOK_TOP + 0.03 + 0.3 * state.spread[2] if state.phase == CARRY else 0.0
    turned = np.stack([x, np.cross(z, x), z], axis=1)
    pose = carried(scene.hand, scene.tool, RING, course(scene, steep) + over * up, turned)
    if state.phase == TURN:
        return Goal(pose, CLOSE, 0.7, gain=1.0)  # at more, the hand would run ahead of its own turning
    return Goal(pose, CLOSE, 1.0 if state.phase == CARRY else 0.4)
