"""The reward of Wipe (robosuite 1.5.2, ``environments/manipulation/wipe.py``)."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.rewards.base import Contacts, RewardTerms, TaskReward

_TERMS = (
    "collision",
    "joint_limit",
    "reach",
    "wipe",
    "contact",
    "press",
    "excess_force",
    "acceleration",
    "clean",
)


class Wipe(TaskReward):
    """Sum of: ``collision`` or ``joint_limit``, and where neither is, all the others.

    ``reach`` the dirt's centroid, ``wipe`` a marker off, ``contact`` and ``press`` on the table, ``excess_force`` and
    ``acceleration`` (penalties), ``clean`` when no marker is left.
    """

    best = 1.0

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        # Unlike the others, robosuite's Wipe takes a scale of 0 for no scaling.
        self.scale = env.reward_scale * env.reward_normalization_factor if env.reward_scale else 1.0
        model: mujoco.MjModel = env.sim.model._model
        self._robot = env.robots[0]
        (self._arm,) = self._robot.arms
        self._rgba = model.geom_rgba
        self._contacts = Contacts(env, self._robot.robot_model.contact_geoms, env.sim.model.geom_names)
        self._joints = np.asarray(self._robot._ref_joint_pos_indexes)
        low, high = model.jnt_range[self._robot._ref_joint_indexes].T
        # 0.1 rad before its end a joint counts as being there; joints without a range have none.
        self._low = np.where(low == high, -np.inf, low + 0.1)
        self._high = np.where(low == high, np.inf, high - 0.1)
        gripper = self._robot.gripper[self._arm]
        self._corners = [env.sim.model.geom_name2id(name) for name in gripper.important_geoms["corners"]]
        sensor = env.sim.model.sensor_name2id(gripper.important_sensors["force_ee"])
        self._force = slice(model.sensor_adr[sensor], model.sensor_adr[sensor] + 3)
        self._markers = env.model.mujoco_arena.markers
        self._index = {marker: i for i, marker in enumerate(self._markers)}
        self._marker_bodies = np.array([env.sim.model.body_name2id(m.root_body) for m in self._markers])
        self._marker_geoms = [env.sim.model.geom_name2id(m.visual_geoms[0]) for m in self._markers]

    def __call__(self) -> RewardTerms:
        env = self.env
        terms = dict.fromkeys(_TERMS, 0.0)
        unsafe = "collision" if self._collides() else "joint_limit" if self._is_at_a_limit() else None
        if unsafe:
            terms[unsafe] = env.arm_limit_collision_penalty
            env.collisions += 1
        else:
            positions = self.data.xpos[self._marker_bodies]  # (markers, 3)
            dirty = np.ones(len(self._markers), bool)
            dirty[[self._index[marker] for marker in env.wiped_markers]] = False
            if self.data.ncon:
                wiped = np.flatnonzero(dirty & self._under_the_tool(positions))
                self._wipe(wiped)
                dirty[wiped] = False
                terms["wipe"] = env.unit_wiped_reward * len(wiped)
            if self.dense:
                terms |= self._shaping(positions[dirty])
            if len(env.wiped_markers) == env.num_markers:
                terms["clean"] = env.task_complete_reward
        self._keep_bias()
        solved = len(env.wiped_markers) == env.num_markers
        return self.reward(solved, **(terms if self.dense else {"success": terms["clean"]}))

    def _collides(self) -> bool:
        arm, _ = self._contacts()
        return arm[1] > 0

    def _is_at_a_limit(self) -> bool:
        q = self.data.qpos[self._joints]
        return not ((self._low < q) & (q < self._high)).all()

    def _wipe(self, new: NDArray[np.intp]) -> None:
        for i in new:
            self._rgba[self._marker_geoms[i], 3] = 0
            self.env.wiped_markers.append(self._markers[i])

    def _under_the_tool(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which markers are less than 2 cm above the plane of the tool's face and within its four corners."""
        a, origin, b, c = self.data.geom_xpos[self._corners]
        x = (a - origin) / math.dist(a, origin)
        y = (c - origin) / math.dist(c, origin)
        normal = np.array([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
        normal /= math.hypot(*normal)
        plane = np.array([x, y]).T  # (3, 2)
        height = (positions - origin) @ normal  # (markers,)
        near: NDArray[np.bool_] = (height > 0.0) & (height < 0.02)
        if not near.any():
            return near
        points = (positions - height[:, None] * normal - origin) @ plane  # (markers, 2)
        corners = (np.array([a, origin, c, b]) - origin) @ plane  # (4, 2), in the order they stand around the face
        edges = corners[[1, 2, 3, 0]] - corners
        dx, dy = points[:, :1] - corners[:, 0], points[:, 1:] - corners[:, 1]  # (markers, 4)
        within: NDArray[np.bool_] = (edges[:, 0] * dy < dx * edges[:, 1]).all(axis=1)
        return near & within

    def _shaping(self, dirt: NDArray[np.float64]) -> dict[str, float]:
        env, data = self.env, self.data
        terms: dict[str, float] = {}
        if len(dirt):
            distance = math.dist(dirt.mean(axis=0), data.site_xpos[self.hand])
            terms["reach"] = env.distance_multiplier * (1 - math.tanh(env.distance_th_multiplier * distance))
        if data.ncon and math.dist(data.sensordata[self._force], env.ee_force_bias[self._arm]) > env.contact_threshold:
            terms["contact"] = env.wipe_contact_reward
        force = math.hypot(*self._robot.recent_ee_forcetorques[self._arm].current[:3])
        if force > env.pressure_threshold_max:
            terms["excess_force"] = -env.excess_force_penalty_mul * force
            env.f_excess += 1
        elif force > env.pressure_threshold and data.ncon > 1:
            crowd = 10.0 if data.ncon > 50 else 0.0
            terms["press"] = (1.0 + crowd) * env.wipe_contact_reward + 0.01 * force
        if env.ee_accel_penalty:
            acceleration = np.abs(self._robot.recent_ee_acc[self._arm].current).mean()
            terms["acceleration"] = -env.ee_accel_penalty * acceleration
        return terms

    def _keep_bias(self) -> None:
        """Takes the wrist's first reading for its zero.

        robosuite's own step does so after the reward; a step that calls the reward alone would never.
        """
        if not self.env.ee_force_bias[self._arm].any():
            self.env.ee_force_bias = self._robot.ee_force
            self.env.ee_torque_bias = self._robot.ee_torque
