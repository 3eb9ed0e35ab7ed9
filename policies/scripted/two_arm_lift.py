"""Lifts the pot with two arms: over its handles, down, grasp both, up together, stay."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, Expert, State
from asm_gym.policies.scripted.geometry import Pose, Vector, gripping, matrix, move

REACH, DESCEND, GRASP, LIFT, LOWER = range(5)
ARMS = 2

_OVER = 0.07  # how far above the handles to come from [m]
_DEPTH = 0.01  # how far below the bars' middle to grasp them: held by the fingers' tips, they slip [m]
_UP = 0.15  # how high to lift [m]; the task asks for 0.1


class _Scene(NamedTuple):
    hands: tuple[Pose, Pose]
    handles: Vector  # (2, 3) [m]
    across: Vector  # (3,) from one handle's bar to the other's


class TwoArmLiftExpert(Expert):
    """A scripted expert for TwoArmLift; the plan of its state is how high to lift [m]."""

    pace = 0.45

    def begin(self, observation: Any) -> State:
        style, rng = self.style, self.np_random
        speed = style.pace(self.pace, rng)
        spread = style.spread * rng.standard_normal((ARMS, 3))
        height = _UP + float(np.clip(style.spread * rng.standard_normal(), -0.02, 0.05))
        return self.start(speed, spread, height, noises=7 * ARMS)

    def look(self, observation: Any) -> _Scene:
        handles = np.stack([self.read(observation, f"handle{i}_xpos") for i in range(ARMS)])
        first, second = (self.read.hand(observation, f"robot{i}_") for i in range(ARMS))
        return _Scene((first, second), handles, matrix(self.read(observation, "pot_quat"))[:, 1])

    def entered(self, state: State, scene: _Scene, phase: int) -> State:
        return state._replace(phase=phase, since=0, anchor=np.stack([hand.at for hand in scene.hands]))

    def next_phase(self, state: State, scene: _Scene) -> int:
        # One hand waits for the other.
        phase, since = state.phase, state.since
        off = np.stack([hand.at for hand in scene.hands]) - scene.handles
        far = np.linalg.norm(off + np.array([0.0, 0.0, _DEPTH]), axis=1)  # (2,)
        if phase == REACH:
            aligned = all(abs(hand.turned[:, 1] @ scene.across) > np.cos(0.15) for hand in scene.hands)
            over = np.linalg.norm(off - _above(state), axis=1)
            return DESCEND if aligned and (over < 0.025).all() else REACH
        if phase == DESCEND:
            if (far < 0.009).all() or (since > 30 and (far < 0.015).all()):
                return GRASP
            return REACH if since > 60 else DESCEND
        if phase == GRASP:
            return LIFT if since >= 8 else GRASP
        if phase == LIFT and (far > 0.04).any():  # lost a handle
            return LOWER
        return REACH if phase == LOWER and since > 30 else phase

    def command(self, state: State, scene: _Scene) -> Vector:
        targets, command = self._targets(state, scene), np.zeros((ARMS, 7))
        for i, (robot, hand) in enumerate(zip(self.robosuite.robots, scene.hands, strict=True)):
            base = np.array(robot.base_ori, np.float64)  # (3, 3) in whose frame the controller takes commands
            held = gripping(hand.turned, scene.across)
            moves = move(hand, targets[i], held, state.speed, gain=1.5)
            command[i, :6] = np.concatenate([base.T @ moves[:3], base.T @ moves[3:]])
        command[:, 6] = OPEN if state.phase < GRASP else CLOSE
        return command.reshape(-1)

    @staticmethod
    def _targets(state: State, scene: _Scene) -> Vector:
        """Return where (2, 3) the hands are to go."""
        if state.phase == REACH:
            return scene.handles + _above(state)
        if state.phase == DESCEND:
            return scene.handles - [0.0, 0.0, _DEPTH]
        anchor, up = state.anchor, 0.0
        if state.phase == LIFT:
            # The hand that is ahead waits: a pot that tilts turns in their fingers.
            risen = min(float(hand.at[2] - start[2]) for hand, start in zip(scene.hands, anchor, strict=True))
            up = min(state.plan, risen + 0.03)
        if state.phase == LOWER:
            # What one hand still holds comes down slowly, before both let go and try again.
            up = -0.01 * min(state.since, 15)
        targets: Vector = anchor + np.array([0.0, 0.0, up])
        return targets


def _above(state: State) -> Vector:
    """Return (2, 3) from the handles to where the hands come down from [m]."""
    above: Vector = np.array([0.0, 0.0, _OVER]) + 0.3 * state.spread
    return above
