"""The rewards of NutAssembly and PickPlace, and of their variants with one object (robosuite 1.5.2).

Each placed object counts 1, ``place``; to that comes the largest of ``reach``, ``grasp``, ``lift`` and ``hover`` over
the objects that are not placed yet. A later stage includes the earlier ones.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from asm_gym.envs.rewards.base import Contacts, RewardTerms, TaskReward, fingerpads, largest

_REACH, _GRASP, _LIFT, _HOVER = 0.1, 0.35, 0.5, 0.7
"""What the four stages can reach at most."""
_LET_GO = 0.6  # an object is placed only when 1 - tanh(10 distance to the hand) is below this


class Sorting(TaskReward):
    """Args:
    objects: robosuite's, in the order of their targets.
    """

    best = 1.0

    def __init__(self, env: Any, objects: Sequence[Any]) -> None:
        super().__init__(env)
        self._all = env.single_object_mode == 0
        if self._all and env.reward_scale is not None:
            self.scale /= len(objects)
        self._bodies = [env.obj_body_id[o.name] for o in objects]
        self._contacts = Contacts(env, *fingerpads(env.robots[0]), *(o.contact_geoms for o in objects))

    @abstractmethod
    def _remembered(self) -> Any:
        """robosuite's own array of which objects are placed."""

    @abstractmethod
    def _is_at_target(self, i: int, position: Sequence[float]) -> bool: ...

    @abstractmethod
    def _reach_targets(self, active: list[int], positions: list[list[float]]) -> list[Any]:
        """Where the hand should be to grasp each object [m]."""

    @abstractmethod
    def _lift_target(self) -> float:
        """Height that an object is lifted to [m]."""

    @abstractmethod
    def _hover(self, i: int, position: Sequence[float], lift: float) -> float:
        """The reward for carrying an object to its target."""

    def __call__(self) -> RewardTerms:
        hand = self.data.site_xpos[self.hand].tolist()
        positions = self.data.xpos[self._bodies].tolist()
        placed = [
            1 - math.tanh(10.0 * math.dist(hand, position)) < _LET_GO and self._is_at_target(i, position)
            for i, position in enumerate(positions)
        ]
        self._remembered()[:] = placed
        done = sum(placed)
        solved = done == len(positions) if self._all else done > 0
        if not self.dense:
            return self.reward(solved, success=done)
        active = [i for i, here in enumerate(placed) if not here]
        return self.reward(solved, place=done, **self._stages(hand, positions, active))

    def _stages(self, hand: list[float], positions: list[list[float]], active: list[int]) -> dict[str, float]:
        reach = grasp = lift = hover = 0.0
        if active:
            nearest = min(math.dist(hand, target) for target in self._reach_targets(active, positions))
            reach = _REACH * (1 - math.tanh(10.0 * nearest))
            left, right, *_ = self._contacts()
            if any(left[2 + i] > 0 for i in active) and any(right[2 + i] > 0 for i in active):
                grasp = _GRASP
                below = max(self._lift_target() - max(positions[i][2] for i in active), 0.0)  # the highest object
                lift = _GRASP + (1 - math.tanh(15.0 * below)) * (_LIFT - _GRASP)
            hover = max(self._hover(i, positions[i], lift) for i in active)
        return largest({"reach": reach}, {"grasp": grasp}, {"lift": lift}, {"hover": hover})


def _above(distance: float) -> float:
    """What carrying adds to lifting, by the horizontal distance to the target [m]."""
    return (1 - math.tanh(10.0 * distance)) * (_HOVER - _LIFT)


class NutAssembly(Sorting):
    """Square and round nuts, each around its peg."""

    def __init__(self, env: Any) -> None:
        super().__init__(env, env.nuts)
        pegs = env.peg1_body_id, env.peg2_body_id
        self._own_peg = [pegs[next(k for n, k in env.nut_to_id.items() if n in nut.name.lower())] for nut in env.nuts]
        self._pegs = pegs
        self._handles = env.object_site_ids
        self._table = env.table_body_id
        self._table_top = env.table_offset[2]

    def _remembered(self) -> Any:
        return self.env.objects_on_pegs

    def _is_at_target(self, i: int, position: Sequence[float]) -> bool:
        x, y = self.data.xpos[self._pegs[i], :2]
        near = abs(position[0] - x) < 0.03 and abs(position[1] - y) < 0.03
        return bool(near and position[2] < self._table_top + 0.05)

    def _reach_targets(self, active: list[int], positions: list[list[float]]) -> list[Any]:
        return [self.data.site_xpos[self._handles[i]] for i in active]

    def _lift_target(self) -> float:
        return float(self.data.xpos[self._table, 2]) + 0.2

    def _hover(self, i: int, position: Sequence[float], lift: float) -> float:
        return lift + _above(math.dist(self.data.xpos[self._own_peg[i], :2], position[:2]))


class PickPlace(Sorting):
    """Milk, bread, cereal and can, each in its bin, all four of which make up the second bin."""

    def __init__(self, env: Any) -> None:
        super().__init__(env, env.objects)
        self._x, self._y, self._floor = env.bin2_pos
        width, depth = env.bin_size[0], env.bin_size[1]
        self._half = width / 2, depth / 2
        self._quarter = width / 4.0, depth / 4.0
        self._targets = [env.target_bin_placements[env.object_to_id[o.name.lower()], :2].tolist() for o in env.objects]

    def _remembered(self) -> Any:
        return self.env.objects_in_bins

    def _is_at_target(self, i: int, position: Sequence[float]) -> bool:
        width, depth = self._half
        x = self._x - width if i in (0, 2) else self._x
        y = self._y - depth if i < 2 else self._y
        inside = x < position[0] < x + width and y < position[1] < y + depth
        return bool(inside and self._floor < position[2] < self._floor + 0.1)

    def _reach_targets(self, active: list[int], positions: list[list[float]]) -> list[Any]:
        return [positions[i] for i in active]

    def _lift_target(self) -> float:
        return float(self._floor) + 0.25

    def _hover(self, i: int, position: Sequence[float], lift: float) -> float:
        x, y = self._targets[i]
        above = abs(position[0] - x) < self._quarter[0] and abs(position[1] - y) < self._quarter[1]
        # Above its bin an object counts as lifted whatever its height, so that dropping it there costs nothing.
        return (_LIFT if above else lift) + _above(math.dist((x, y), position[:2]))
