"""Wipes the dirt off the table: over one end of the trace, down, along it, back for what was missed, up."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.scripted.base import PhasedExpert, Vector, gripping, move, rotation

REACH, LOWER, WIPE, REST = range(4)

_OVER = 0.06  # how high above the table the tool comes to the dirt [m]
_PRESS = 0.2  # where the tool's face stands on the table's own plane and wipes, under about 23 N [action units]


class WipeState(NamedTuple):
    """Where one episode stands."""

    phase: int
    since: int  # steps spent in the phase
    speed: float  # action units
    press: float  # action units
    spread: Vector  # (3,) how this episode's way-points differ from the plan [m]
    dirt: Vector  # (N, 3) the marks in the order of the trace, from the end that is nearer [m]
    order: NDArray[np.intp]  # (N,) which of the task's marks they are
    anchor: Vector  # (3,) where the hand was when the phase began [m]
    drift: Vector  # (6,) correlated action noise


class WipeExpert(PhasedExpert):
    """A scripted expert for Wipe."""

    def _act(self, observation: Any, state: WipeState, noise: Vector) -> tuple[Vector, WipeState]:
        hand_at = self._read(observation, "hand_position")
        hand = rotation(self._read(observation, "hand_orientation"))
        left = state.dirt[self._dirty(state.order)]  # (M, 3)
        state = self._advance(state, hand_at, left)
        command = self._command(state, hand_at, hand, left)
        command += noise
        return command, state

    def _begin(self, observation: Any) -> WipeState:
        hand_at = self._read(observation, "hand_position")
        style, rng = self.style, self.np_random
        pace = style.pace(1.0, rng)
        press = _PRESS * float(np.clip(1 + style.speed_spread * rng.standard_normal(), 0.8, 1.2))
        env = self.env.unwrapped.robosuite_env  # type: ignore[attr-defined]
        bodies = [env.sim.model.body_name2id(mark.root_body) for mark in env.model.mujoco_arena.markers]
        dirt = env.sim.data.body_xpos[bodies].copy()
        order = np.arange(len(dirt))
        if np.linalg.norm(dirt[-1] - hand_at) < np.linalg.norm(dirt[0] - hand_at):
            order = order[::-1]
        spread = style.spread * rng.standard_normal(3)
        return WipeState(REACH, 0, 0.5 * pace, press, spread, dirt[order], order, hand_at, np.zeros(6))

    def _dirty(self, order: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(N,) which marks are still on the table."""
        env = self.env.unwrapped.robosuite_env  # type: ignore[attr-defined]
        wiped = set(env.wiped_markers)
        return np.array([mark not in wiped for mark in env.model.mujoco_arena.markers])[order]

    @staticmethod
    def _advance(state: WipeState, hand_at: Vector, left: Vector) -> WipeState:
        """The phase that comes next, where this one has done its work."""

        def to(phase: int) -> WipeState:
            return state._replace(phase=phase, since=0, anchor=hand_at)

        if not len(left):
            return state if state.phase == REST else to(REST)
        far = float(np.linalg.norm((left[0] - hand_at)[:2]))
        height = float(hand_at[2] - left[0][2])
        if state.phase == REACH and far < 0.03:
            return to(LOWER)
        if state.phase == LOWER and height < 0.003:
            return to(WIPE)
        # Thrown off the trace, or at its end with something missed far back: through the air, not over the table.
        if state.phase in (LOWER, WIPE) and far > 0.15:
            return to(REACH)
        if state.phase == WIPE and height > 0.02:  # lifted off
            return to(LOWER)
        return state

    def _command(self, state: WipeState, hand_at: Vector, hand: Vector, left: Vector) -> Vector:
        """(6,) towards what the phase asks for."""
        level = gripping(hand, np.array([0.0, 1.0, 0.0]))
        if state.phase == REST:
            up = state.anchor + np.array([0.0, 0.0, 0.1]) + state.spread
            return move(hand_at, up, hand, level, state.speed)
        if state.phase == REACH:
            over = left[0] + np.array([0.0, 0.0, _OVER]) + 0.3 * state.spread
            return move(hand_at, over, hand, level, state.speed)
        # The nearest mark of the trace that is left leads the tool along it.
        along = np.array([left[0][0], left[0][1], hand_at[2]])
        command = move(hand_at, along, hand, level, state.speed, gain=2.0)
        # Gently at first: a tool that comes down with all of it hits the table three times as hard as it presses.
        height = hand_at[2] - left[0][2]
        command[2] = -state.press * min(1.0, 0.3 + state.since / 15) if state.phase == WIPE else -0.06 - 5.0 * height
        return command
