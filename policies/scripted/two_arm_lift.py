"""Lifts the pot with two arms: over its handles, down, grasp both, up together, stay."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import CLOSE, OPEN, PhasedExpert, Style, Vector, gripping, matrix
from asm_gym.policies.scripted.two_arms import ARMS, Hand, Hands, move_arm

REACH, DESCEND, GRASP, LIFT, LOWER = range(5)

_OVER = 0.07  # how far above the handles to come from [m]
_DEPTH = 0.01  # how far below the bars' middle to grasp them: held by the fingers' tips, they slip [m]
_UP = 0.15  # how high to lift [m]; the task asks for 0.1


class TwoArmLiftState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    spread: Vector  # (2, 3) how this episode's way-points differ from the plan [m]
    height: float  # how high to lift [m]
    bases: Vector  # (2, 3, 3) how the arms stand in the room
    anchors: Vector  # (2, 3) where the hands were when the phase began [m]
    drift: Vector  # (14,) correlated action noise


class TwoArmLiftExpert(PhasedExpert):
    """A scripted expert for TwoArmLift."""

    def __init__(self, env: gym.Env[Any, Any], seed: int | None = None, style: Style | None = None) -> None:
        super().__init__(env, seed, style)
        self._hands = Hands(env)

    def _act(self, observation: Any, state: TwoArmLiftState, noise: Vector) -> tuple[Vector, TwoArmLiftState]:
        hands = self._hands.look(observation)
        handles = np.stack([self._read(observation, f"handle{i}_xpos") for i in range(ARMS)])  # (2, 3)
        across = matrix(self._read(observation, "pot_quat"))[:, 1]  # from one handle's bar to the other's
        state = self._advance(state, hands, handles, across)
        targets, grip = self._targets(state, handles, np.stack([hand.at for hand in hands]))
        command = np.zeros((ARMS, 7))
        for i, hand in enumerate(hands):
            held = gripping(hand.turned, across)
            command[i, :6] = move_arm(state.bases[i], hand, targets[i], held, state.speed, gain=1.5)
        command = command.reshape(-1)
        command += noise
        command[6::7] = grip
        return command, state

    def _begin(self, observation: Any) -> TwoArmLiftState:
        style, rng = self.style, self.np_random
        return TwoArmLiftState(
            phase=REACH,
            since=0,
            speed=style.pace(0.45, rng),
            spread=style.spread * rng.standard_normal((ARMS, 3)),
            height=_UP + float(np.clip(style.spread * rng.standard_normal(), -0.02, 0.05)),
            bases=self._hands.bases(),
            anchors=np.zeros((ARMS, 3)),
            drift=np.zeros(7 * ARMS),
        )

    @staticmethod
    def _advance(state: TwoArmLiftState, hands: tuple[Hand, Hand], handles: Vector, across: Vector) -> TwoArmLiftState:
        """The phase that comes next: one hand waits for the other."""
        at = np.stack([hand.at for hand in hands])  # (2, 3)

        def to(phase: int) -> TwoArmLiftState:
            return state._replace(phase=phase, since=0, anchors=at)

        off = at - handles
        far = np.linalg.norm(off + np.array([0.0, 0.0, _DEPTH]), axis=1)  # (2,)
        if state.phase == REACH:
            aligned = all(abs(hand.turned[:, 1] @ across) > np.cos(0.15) for hand in hands)
            over = np.linalg.norm(off - _above(state), axis=1)
            return to(DESCEND) if aligned and (over < 0.025).all() else state
        if state.phase == DESCEND:
            if (far < 0.009).all() or (state.since > 30 and (far < 0.015).all()):
                return to(GRASP)
            return to(REACH) if state.since > 60 else state
        if state.phase == GRASP:
            return to(LIFT) if state.since >= 8 else state
        if state.phase == LIFT and (far > 0.04).any():  # lost a handle
            return to(LOWER)
        if state.phase == LOWER and state.since > 30:
            return to(REACH)
        return state

    @staticmethod
    def _targets(state: TwoArmLiftState, handles: Vector, at: Vector) -> tuple[Vector, float]:
        """(2, 3) where the hands are to go, and whether they are to hold."""
        if state.phase == REACH:
            return handles + _above(state), OPEN
        if state.phase == DESCEND:
            return handles - [0.0, 0.0, _DEPTH], OPEN
        if state.phase == GRASP:
            return state.anchors, CLOSE
        if state.phase == LIFT:
            # Whoever is ahead waits: a pot that tilts turns in their fingers.
            risen = float(np.min(at[:, 2] - state.anchors[:, 2]))
            return state.anchors + np.array([0.0, 0.0, min(state.height, risen + 0.03)]), CLOSE
        # What one hand still holds comes down slowly, before both let go and try again.
        return state.anchors - np.array([0.0, 0.0, 0.01 * min(state.since, 15)]), CLOSE


def _above(state: TwoArmLiftState) -> Vector:
    """(2, 3) from the handles to where the hands come down from [m]."""
    above: Vector = np.array([0.0, 0.0, _OVER]) + 0.3 * state.spread
    return above
