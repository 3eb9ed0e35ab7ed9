"""Wipes the dirt off the table: over one end of the trace, down, along it, back for what was missed, up."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.scripted.base import Expert, State
from asm_gym.policies.scripted.geometry import Pose, Vector, gripping, move

REACH, LOWER, WIPE, REST = range(4)
_OVER = 0.06  # how high above the table the tool comes to the dirt [m]
_PRESS = 0.2  # where the tool's face stands on the table's own plane and wipes, under about 23 N [action units]


class _Plan(NamedTuple):
    press: float  # action units
    dirt: Vector  # (N, 3) the marks in the order of the trace, from the end that is nearer [m]
    order: NDArray[np.intp]  # (N,) which of the task's marks they are


class _Scene(NamedTuple):
    hand: Pose
    dirty: NDArray[np.bool_]  # which of the task's marks are still on the table


class WipeExpert(Expert):
    """A scripted expert for Wipe."""

    pace = 1.0

    def begin(self, observation: Any) -> State:
        hand_at = self.read(observation, "hand_position")
        style, rng = self.style, self.np_random
        pace = style.pace(self.pace, rng)
        press = _PRESS * float(np.clip(1 + style.speed_spread * rng.standard_normal(), 0.8, 1.2))
        env = self.robosuite
        bodies = [
            env.sim.model.body_name2id(mark.root_body) for mark in env.model.mujoco_arena.markers
        ]
        dirt = env.sim.data.body_xpos[bodies].copy()
        order = np.arange(len(dirt))
        if np.linalg.norm(dirt[-1] - hand_at) < np.linalg.norm(dirt[0] - hand_at):
            order = order[::-1]
        spread = style.spread * rng.standard_normal(3)
        return self.start(
            0.5 * pace, spread, _Plan(press, dirt[order], order), noises=6, anchor=hand_at
        )

    def look(self, observation: Any) -> _Scene:
        wiped = set(self.robosuite.wiped_markers)
        dirty = np.array([mark not in wiped for mark in self.robosuite.model.mujoco_arena.markers])
        return _Scene(self.read.hand(observation), dirty)

    def next_phase(self, state: State, scene: _Scene) -> int:
        phase, left = state.phase, _left(state, scene)
        if not len(left):
            return REST
        far = float(np.linalg.norm((left[0] - scene.hand.at)[:2]))
        height = float(scene.hand.at[2] - left[0][2])
        if phase == REACH and far < 0.03:
            return LOWER
        if phase == LOWER and height < 0.003:
            return WIPE
        # Thrown off the trace, or at its end with something missed far back: through the air, not over the table.
        if phase in (LOWER, WIPE) and far > 0.15:
            return REACH
        if phase == WIPE and height > 0.02:  # lifted off
            return LOWER
        return phase

    def command(self, state: State, scene: _Scene) -> Vector:
        hand, left = scene.hand, _left(state, scene)
        level = gripping(hand.turned, np.array([0.0, 1.0, 0.0]))
        if state.phase == REST:
            return move(
                hand, state.anchor + np.array([0.0, 0.0, 0.1]) + state.spread, level, state.speed
            )
        if state.phase == REACH:
            return move(
                hand, left[0] + np.array([0.0, 0.0, _OVER]) + 0.3 * state.spread, level, state.speed
            )
        # The nearest mark of the trace that is left leads the tool along it.
        command = move(
            hand, np.array([left[0][0], left[0][1], hand.at[2]]), level, state.speed, gain=2.0
        )
        if state.phase == WIPE:
            # Gently at first: a tool that comes down with all of it hits the table three times as hard as it presses.
            command[2] = -state.plan.press * min(1.0, 0.3 + state.since / 15)
        else:
            command[2] = -0.06 - 5.0 * (hand.at[2] - left[0][2])
        return command


def _left(state: State, scene: _Scene) -> Vector:
    """Return the marks (M, 3) that are still on the table, in the order of the trace [m]."""
    return state.plan.dirt[scene.dirty[state.plan.order]]
