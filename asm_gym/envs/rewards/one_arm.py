"""The rewards of Lift, Stack, Door and ToolHang (robosuite 1.5.2, ``environments/manipulation``)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.rewards.base import Contacts, RewardTerms, TaskReward, fingerpads, largest

_LIFTED = 0.04  # of a cube's centre above the table [m]


class Lift(TaskReward):
    """``reach`` + ``grasp``, or ``lift`` alone, which is all of the reward, once the cube is lifted."""

    best = 2.25

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._table = env.model.mujoco_arena.table_offset[2]
        self._cube = env.cube_body_id
        self._contacts = Contacts(env, *fingerpads(env.robots[0]), env.cube.contact_geoms)

    def __call__(self) -> RewardTerms:
        cube = self.data.xpos[self._cube]
        lifted = cube[2] > self._table + _LIFTED
        if not self.dense:
            return self.reward(lifted, success=2.25 * lifted)
        if lifted:
            return self.reward(True, reach=0.0, grasp=0.0, lift=2.25)
        reach = 1 - math.tanh(10.0 * math.dist(self.data.site_xpos[self.hand], cube))
        left, right, _ = self._contacts()
        return self.reward(False, reach=reach, grasp=0.25 * (left[2] > 0 and right[2] > 0), lift=0.0)


class Stack(TaskReward):
    """The largest of ``reach`` + ``grasp``, ``lift`` + ``align`` and ``stack``."""

    best = 2.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._table = env.table_offset[2]
        self._a, self._b = env.cubeA_body_id, env.cubeB_body_id
        cubes = env.cubeA.contact_geoms, env.cubeB.contact_geoms
        self._contacts = Contacts(env, *fingerpads(env.robots[0]), *cubes)

    def __call__(self) -> RewardTerms:
        a, b = self.data.xpos[self._a], self.data.xpos[self._b]
        lifted = a[2] > self._table + _LIFTED
        left, right, cube, _ = self._contacts()
        grasped = left[2] > 0 and right[2] > 0
        stacked = bool(lifted and not grasped and cube[3] > 0)
        if not self.dense:
            return self.reward(stacked, success=2.0 * stacked)
        reach = 0.25 * (1 - math.tanh(10.0 * math.dist(self.data.site_xpos[self.hand], a)))
        align = 0.5 * (1 - math.tanh(math.dist(a[:2], b[:2]))) if lifted else 0.0
        stages = {"reach": reach, "grasp": 0.25 * grasped}, {"lift": float(lifted), "align": align}
        return self.reward(stacked, **largest(*stages, {"stack": 2.0 * stacked}))


class Door(TaskReward):
    """``reach`` + ``rotate`` (of the handle), or ``open`` alone."""

    best = 1.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._hinge, self._handle = env.hinge_qpos_addr, env.door_handle_site_id
        self._latch = env.handle_qpos_addr if env.use_latch else None

    def __call__(self) -> RewardTerms:
        opened = self.data.qpos[self._hinge] > 0.3
        if not self.dense:
            return self.reward(opened, success=opened)
        if opened:
            return self.reward(True, reach=0.0, rotate=0.0, open=1.0)
        site = self.data.site_xpos
        reach = 0.25 * (1 - math.tanh(10.0 * math.dist(site[self._handle], site[self.hand])))
        turned = 0.0 if self._latch is None else abs(self.data.qpos[self._latch] / (0.5 * math.pi))  # of a right angle
        return self.reward(False, reach=reach, rotate=min(0.25 * turned, 0.25), open=0.0)


class ToolHang(TaskReward):
    """``success``; robosuite has no dense reward for it."""

    best = 1.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        sites, geoms = env.obj_site_id, env.obj_geom_id
        tool, frame = env.tool_args, env.frame_args
        self._mount, self._corner, self._hang = (
            sites[f"{name}_site"] for name in ("frame_mount", "frame_intersection", "frame_hang")
        )
        self._tip = sites.get("frame_tip_site", self._mount)
        self._stand, self._shaft = geoms["stand_base"], sites["stand_mount_site"]
        self._walls = [geoms[f"stand_wall_{i}"] for i in range(4)]
        self._hole = sites["tool_hole1_center"]
        self._rim = [geoms[f"tool_hole1_hc_{i}"] for i in (0, tool["ngeoms"] // 2)]
        self._clearance = tool["inner_radius_1"] - frame["frame_thickness"] / 2.0  # [m]
        (gripper,) = env.robots[0].gripper.values()
        fingers = {name for group in gripper.important_geoms.values() for name in group}
        hole = [f"tool_hole1_hc_{i}" for i in range(tool["ngeoms"])]
        self._contacts = Contacts(env, fingers, env.tool.contact_geoms, hole, ["frame_horizontal_frame"])

    def __call__(self) -> RewardTerms:
        solved = self._frame_stands() and self._tool_hangs()
        return self.reward(solved, success=solved)

    def _frame_stands(self) -> bool:
        """The stand is upright and the frame's end is between its walls."""
        site, geom = self.data.site_xpos, self.data.geom_xpos
        shaft = site[self._shaft] - geom[self._stand]
        if shaft[2] <= math.cos(math.pi / 18.0) * math.hypot(*shaft):
            return False
        if math.dist(site[self._tip], geom[self._stand]) >= 0.05:
            return False
        rod = site[self._corner] - site[self._mount]
        a, b, c, d = geom[self._walls] - site[self._mount]
        return _astride(rod, a, c) and _astride(rod, b, d)

    def _tool_hangs(self) -> bool:
        """The tool's hole is around the frame's hook, touches it, and nobody holds the tool."""
        site, geom = self.data.site_xpos, self.data.geom_xpos
        fingers, _, hole, _ = self._contacts()
        if fingers[1] > 0 or not hole[3] > 0:
            return False
        end = site[self._hang]
        hook = site[self._corner] - end
        length = math.hypot(*hook)
        hook /= length
        offset = site[self._hole] - end
        along = float(offset @ hook)
        close = math.hypot(*(offset - along * hook)) < self._clearance
        return close and _astride(hook, *(geom[self._rim] - end)) and 0.05 < along / length < 1.0


def _astride(axis: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two points lie on opposite sides of an axis: (a × axis) · (b × axis) < 0, by Lagrange's identity."""
    return bool((a @ b) * (axis @ axis) < (a @ axis) * (b @ axis))
