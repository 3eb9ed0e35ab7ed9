"""The rewards of the tasks for a pair of arms (robosuite 1.5.2, ``environments/manipulation``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.rewards.base import Contacts, RewardTerms, TaskReward, fingerpads


class TwoArmLift(TaskReward):
    """``lift`` + each arm's ``reach`` and ``grasp``, or ``lift`` alone once the pot is up, which must not tilt."""

    best = 3.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._pot, self._top = env.pot_body_id, env.pot.top_offset[2]
        self._centre, self._table = env.pot_center_id, env.table_top_id
        self._handles = env.handle0_site_id, env.handle1_site_id
        pads = [group for robot in env.robots for group in fingerpads(robot)]
        self._contacts = Contacts(env, *pads, env.pot.handle0_geoms, env.pot.handle1_geoms)
        self._upward = _upward()

    def __call__(self) -> RewardTerms:
        site = self.data.site_xpos
        bottom, table = site[self._centre, 2] - self._top, site[self._table, 2]
        upright = float(self._upward(self.data.xquat[self._pot]) >= np.cos(np.pi / 6))
        lifted = bottom > table + 0.10
        if not self.dense:
            return self.reward(lifted, success=3.0 * upright * lifted)
        if lifted:
            return self.reward(True, reach_0=0.0, reach_1=0.0, grasp_0=0.0, grasp_1=0.0, lift=3.0 * upright)
        reach = [
            0.5 * (1 - math.tanh(10.0 * math.dist(site[handle], site[hand])))
            for handle, hand in zip(self._handles, (self.hand, self.other_hand), strict=True)
        ]
        left_0, right_0, left_1, right_1, *_ = self._contacts()
        return self.reward(
            False,
            reach_0=reach[0],
            reach_1=reach[1],
            grasp_0=0.25 * (left_0[4] > 0 and right_0[4] > 0),
            grasp_1=0.25 * (left_1[5] > 0 and right_1[5] > 0),
            lift=10.0 * upright * min(max(bottom - table - 0.05, 0), 0.15),
        )


class TwoArmPegInHole(TaskReward):
    """``reach`` + ``perpendicular`` + ``parallel`` + ``align`` + ``place``."""

    best = 5.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._peg, self._hole = env.peg_body_id, env.hole_body_id

    def __call__(self) -> RewardTerms:
        peg, hole = self.data.xpos[self._peg], self.data.xpos[self._hole]
        axis = self.data.xmat[self._peg, 2::3]
        axis = axis / math.hypot(*axis)  # along the peg
        normal = self.data.xmat[self._hole, 2::3]
        offset = hole + 0.1 * self.data.xmat[self._hole, 0::3] - peg  # from the peg to the hole's centre
        parallel = float(offset @ axis)
        # A cross product: the root of |offset|² - parallel² would lose half the digits near zero.
        a, b = axis.tolist(), offset.tolist()
        perpendicular = math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
        cosine = abs(float(normal @ axis)) / math.hypot(*normal)
        placed = perpendicular < 0.06 and -0.12 <= parallel <= 0.14 and cosine > 0.95
        if not self.dense:
            return self.reward(placed, success=5.0 * placed)
        return self.reward(
            placed,
            reach=1 - math.tanh(math.dist(peg, hole)),
            perpendicular=1 - math.tanh(perpendicular),
            parallel=1 - math.tanh(abs(parallel)),
            align=cosine,
            place=placed,
        )


class TwoArmHandover(TaskReward):
    """On the table ``reach`` or ``grasp``; above it ``lift`` + ``hover``, then ``mutual_grasp``, then ``handover``."""

    best = 2.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        hammer = env.hammer
        self._hammer, self._handle, self._table = env.hammer_body_id, env.hammer_handle_geom_id, env.table_top_id
        self._top = hammer.top_offset[2]
        self._lever = hammer.handle_length / 2 + 2 * hammer.head_halfsize
        self._lifted = env.height_threshold
        pads = [group for robot in env.robots for group in fingerpads(robot)]
        self._contacts = Contacts(env, *pads, hammer.contact_geoms, hammer.handle_geoms)
        self._upward = _upward()

    def __call__(self) -> RewardTerms:
        handle, hands = self.data.geom_xpos[self._handle], self.data.site_xpos
        # The sine of the hammer's angle to the ground, π/2 - arccos z, is z.
        height = handle[2] - self._top - self._lever * self._upward(self.data.xquat[self._hammer])
        lifted = height - self.data.site_xpos[self._table, 2] > self._lifted
        left_0, right_0, left_1, right_1, *_ = self._contacts()
        first = left_0[4] > 0 and right_0[4] > 0
        second = left_1[5] > 0 and right_1[5] > 0
        solved = bool(lifted and second and not first)
        if not self.dense:
            return self.reward(solved, success=2.0 * solved)
        terms = dict.fromkeys(("reach", "grasp", "lift", "hover", "mutual_grasp", "handover"), 0.0)
        if solved:
            terms["handover"] = 2.0
        elif lifted and second:
            terms["mutual_grasp"] = 1.5
        elif lifted:
            terms["lift"] = 1.0
            terms["hover"] = 0.25 * (1 - math.tanh(math.dist(handle, hands[self.other_hand])))
        elif first:
            terms["grasp"] = 0.5
        else:
            terms["reach"] = 0.25 * (1 - math.tanh(math.dist(handle, hands[self.hand])))
        return self.reward(solved, **terms)


class TwoArmTransport(TaskReward):
    """``success``; robosuite has no dense reward for it, and prints a warning where one is asked for."""

    best = 1.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        parts = env.transport
        bins = parts.trash_bin.base_geoms, parts.target_bin.base_geoms
        self._contacts = Contacts(env, *bins, parts.trash.contact_geoms, parts.payload.contact_geoms)

    def __call__(self) -> RewardTerms:
        trash_bin, target_bin, *_ = self._contacts()
        solved = trash_bin[2] > 0 and target_bin[3] > 0
        return self.reward(solved, success=solved)


def _upward() -> Callable[[NDArray[np.float64]], float]:
    """A function from a quaternion (w, x, y, z) to how far the body's z axis points up, in [-1, 1].

    By robosuite's own conversion, in single precision, so that thresholds are crossed at the same step.
    """
    from robosuite.utils.transform_utils import quat2mat

    return lambda wxyz: float(quat2mat(wxyz[[1, 2, 3, 0]])[2, 2])
