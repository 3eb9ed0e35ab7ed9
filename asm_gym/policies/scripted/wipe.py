"""Wipes the dirt off the table: over one end of the trace, down, along it, back for what was missed, up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.policies.scripted.expert import Expert, Phase, Scene, State
from asm_gym.policies.scripted.geometry import UP, Vector, length, pointing_down

REACH, LOWER, WIPE, REST = range(4)
TOOL_ACROSS = np.array([0.0, 1.0, 0.0])  # how the tool is held
ABOVE_DIRT = 0.06 * UP  # how high above the table the tool comes to the dirt [m]
ABOVE_TABLE = 0.1 * UP  # how high it rests above where the last mark was [m]
# The tool's face stands on the table's own plane and wipes under about 23 N [action units].
USUAL_PRESS = 0.2
FAR_OFF = 0.15  # so far from a mark the tool goes through the air, not over the table [m]


class WipePlan(NamedTuple):
    """What is decided at the beginning of an episode."""

    press: float  # action units
    dirt: Vector  # (N, 3) the marks in the order of the trace, from the end that is nearer [m]
    order: NDArray[np.intp]  # (N,) which of the task's marks they are


@dataclass(frozen=True)
class WipeScene(Scene):
    """What is observed."""

    dirt_left: Vector  # (M, 3) the marks still on the table, in the order of the trace [m]

    @property
    def level(self) -> Vector:
        """Orientation (3, 3) in which the tool lies flat on the table."""
        return pointing_down(self.hand.orientation, TOOL_ACROSS)

    @property
    def aside(self) -> float:
        """Horizontal distance of the tool from the first mark that is left [m]."""
        return length((self.dirt_left[0] - self.hand.position)[:2])

    @property
    def height(self) -> float:
        """Height of the tool above the first mark that is left [m]."""
        return float(self.hand.position[2] - self.dirt_left[0][2])

    def is_clean(self) -> bool:
        return not len(self.dirt_left)

    def reach(self) -> Vector:
        target = self.dirt_left[0] + ABOVE_DIRT + 0.3 * self.state.waypoint_offset
        return self.move(target, self.level)

    def is_over_dirt(self) -> bool:
        return self.aside < 0.03

    def lower(self) -> Vector:
        return self._follow(-0.06 - 5.0 * self.height)

    def is_down(self) -> bool:
        return self.height < 0.003

    def is_far_off(self) -> bool:
        """Return whether the tool was thrown off the trace, or missed something far back."""
        return self.aside > FAR_OFF

    def wipe(self) -> Vector:
        # Gently at first: a tool that comes down with all of it hits the table three times as hard
        # as it presses.
        share = min(1.0, 0.3 + self.state.steps_in_phase / 15)
        return self._follow(-self.plan.press * share)

    def is_lifted_off(self) -> bool:
        return self.height > 0.02

    def rest(self) -> Vector:
        target = self.state.anchor + ABOVE_TABLE + self.state.waypoint_offset
        return self.move(target, self.level)

    def _follow(self, down: float) -> Vector:
        """Return the command (6,) towards the first mark that is left, which leads the tool along the trace.

        ``down`` replaces the vertical part [action units].
        """
        x, y, _ = self.dirt_left[0]
        target = np.array([x, y, self.hand.position[2]])
        command = self.move(target, self.level, gain=2.0)
        command[2] = down
        return command

    phases: ClassVar = {
        REACH: Phase(reach, None, {REST: is_clean, LOWER: is_over_dirt}),
        LOWER: Phase(lower, None, {REST: is_clean, WIPE: is_down, REACH: is_far_off}),
        WIPE: Phase(wipe, None, {REST: is_clean, REACH: is_far_off, LOWER: is_lifted_off}),
        REST: Phase(rest, None),
    }


class WipeExpert(Expert):
    """A scripted expert for Wipe."""

    pace = 1.0

    def begin(self, observation: Any) -> State:
        speed = 0.5 * self.draw_speed()
        strength = 1 + self.style.speed_spread * self.np_random.standard_normal()
        press = USUAL_PRESS * float(np.clip(strength, 0.8, 1.2))

        hand = self.read(observation, "hand_position")
        env = self.robosuite
        marks = env.model.mujoco_arena.markers
        bodies = [env.sim.model.body_name2id(mark.root_body) for mark in marks]
        dirt = env.sim.data.body_xpos[bodies].copy()
        order = np.arange(len(dirt))
        if length(dirt[-1] - hand) < length(dirt[0] - hand):
            order = order[::-1]
        plan = WipePlan(press, dirt[order], order)
        return State(speed, plan, waypoint_offset=self.draw_offset(), anchor=hand)

    def observe(self, observation: Any, state: State) -> WipeScene:
        marks = self.robosuite.model.mujoco_arena.markers
        wiped = set(self.robosuite.wiped_markers)
        is_dirty = np.array([mark not in wiped for mark in marks])
        return WipeScene(
            state,
            hand=self.read.hand(observation),
            dirt_left=state.plan.dirt[is_dirty[state.plan.order]],
        )
