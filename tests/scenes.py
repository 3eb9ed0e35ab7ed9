"""A robosuite task brought into a state at will, and its reward compared there."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from asm_gym.envs.backend import import_robosuite
from asm_gym.envs.rewards import Rewards, RewardTerms
from asm_gym.tasks import TASKS

UP = np.array([0.0, 0.0, 1.0])
STATE = ("wiped_markers", "collisions", "f_excess", "objects_on_pegs", "objects_in_bins")
"""What robosuite's rewards remember."""


class Scene:
    """A robosuite environment, and ways to bring it about."""

    def __init__(self, task: str) -> None:
        self.task = task
        self.env = import_robosuite().make(
            task,
            robots=["Panda"] * TASKS[task].arms if TASKS[task].arms > 1 else "Panda",
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            reward_shaping=True,
            ignore_done=True,
        )
        self.reset()

    def reset(self, hard: bool = False) -> None:
        """Begins the same episode again."""
        self.env.hard_reset = hard
        self.env.rng.bit_generator.state = np.random.default_rng(0).bit_generator.state
        self.env.reset()
        self.data: mujoco.MjData = self.env.sim.data._data
        self.model: mujoco.MjModel = self.env.sim.model._model
        self.hand = self.env.robots[0].eef_site_id["right"]

    def step(self, action: Any) -> None:
        """A control step without robosuite's reward."""
        for k in range(25):
            self.env.sim.step1()
            self.env._pre_action(action, k == 0)
            self.env.sim.step2()

    def forward(self) -> None:
        mujoco.mj_forward(self.model, self.data)

    def place(self, thing: Any, position: Any, quat: Any = None) -> None:
        """Teleports an object's frame."""
        pose = self.env.sim.data.get_joint_qpos(thing.joints[0]).copy()
        pose[:3] = position
        pose[3:] = pose[3:] if quat is None else quat
        self.env.sim.data.set_joint_qpos(thing.joints[0], pose)
        self.forward()

    def bring(self, thing: Any, feature: Callable[[], Any], to: Any) -> None:
        """Teleports an object so that a point of it comes to a place."""
        pose = self.env.sim.data.get_joint_qpos(thing.joints[0])
        self.place(thing, pose[:3] + to - feature())

    def reach(self, target: Any) -> None:
        """Moves the hand to a position, its orientation kept, by damped least squares."""
        robot = self.env.robots[0]
        q, v = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
        start = self.data.site_xmat[self.hand].copy()
        jacobian, error, turn = np.zeros((6, self.model.nv)), np.zeros(6), np.zeros(4)
        for _ in range(100):
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self.hand)
            error[:3] = target - self.data.site_xpos[self.hand]
            there = start.reshape(3, 3) @ self.data.site_xmat[self.hand].reshape(3, 3).T
            mujoco.mju_mat2Quat(turn, there.ravel())
            mujoco.mju_quat2Vel(error[3:], turn, 1.0)
            j = jacobian[:, v]
            self.data.qpos[q] += 0.5 * j.T @ np.linalg.solve(j @ j.T + 1e-4 * np.eye(6), error)
        self.forward()
        np.testing.assert_allclose(self.data.site_xpos[self.hand], target, atol=2e-3)

    def grasp(self, thing: Any) -> None:
        """Closes the fingers until both pads touch."""
        robot = self.env.robots[0]
        for opening in np.linspace(0.04, 0.0, 41):
            self.data.qpos[robot._ref_gripper_joint_pos_indexes["right"]] = opening, -opening
            self.forward()
            if self.env._check_grasp(robot.gripper, thing):
                return
        raise AssertionError("the fingers closed around nothing")

    def touch(self, *pairs: tuple[str, str]) -> None:
        """Makes the first contacts ones between these geoms, and the others ones of the floor with itself."""
        while self.data.ncon < len(pairs):  # until things have fallen onto the table
            mujoco.mj_step(self.model, self.data)
        geoms = [[self.env.sim.model.geom_name2id(name) for name in pair] for pair in pairs]
        floor = self.env.sim.model.geom_name2id("floor")
        for contact, (a, b) in zip(self.data.contact, itertools.chain(geoms, itertools.repeat((floor, floor)))):  # noqa: B905
            contact.geom[:] = contact.geom1, contact.geom2 = a, b

    def compare(self, dense: bool = True) -> RewardTerms:
        """The terms, once they have been found equal to what robosuite computes, with the same effects."""
        env = self.env
        env.reward_shaping = dense
        before = {name: copy.copy(getattr(env, name)) for name in STATE if hasattr(env, name)}
        rgba = self.model.geom_rgba.copy()
        if self.task == "TwoArmTransport":
            env.reward_shaping = False  # what robosuite does too, after a warning
        expected, success = env.reward(None), env._check_success()
        after = {name: copy.copy(getattr(env, name)) for name in before}
        rgba_after = self.model.geom_rgba.copy()
        for name, value in before.items():
            setattr(env, name, value)
        self.model.geom_rgba[:] = rgba
        env.reward_shaping = dense
        terms, found = Rewards(self.task, env)(None)
        assert sum(terms.values()) == pytest.approx(expected, rel=0, abs=1e-9)
        assert found is bool(success)
        for name, value in after.items():
            np.testing.assert_array_equal(getattr(env, name), value)
        np.testing.assert_array_equal(self.model.geom_rgba, rgba_after)
        return RewardTerms(terms, found)

    def both(self) -> RewardTerms:
        """The terms of the dense reward; the sparse one is compared too."""
        before = {name: copy.copy(getattr(self.env, name)) for name in STATE if hasattr(self.env, name)}
        sparse = self.compare(dense=False)
        assert list(sparse.terms) == ["success"]
        for name, value in before.items():
            setattr(self.env, name, value)
        return self.compare()


def of(*tasks: str) -> pytest.MarkDecorator:
    """Runs a test in a scene of each of these tasks."""
    return pytest.mark.parametrize("kept_scene", tasks, indirect=True)
