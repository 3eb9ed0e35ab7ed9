"""The kinematic chains of robosuite's arms, as the model has them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from asm_gym.envs.backend import PHYSICS_FREQ
from asm_gym.kinematics import Chain


def chains_of(parts: list[tuple[Any, str]], model: mujoco.MjModel, noise: float) -> tuple[Chain, ...]:
    """Of each robot and arm of ``parts``; an arm on what moves too has none.

    Args:
        noise: scales that of the sensors.
    """
    data, found = mujoco.MjData(model), []
    for robot, _ in parts:
        data.qpos[robot._ref_joint_pos_indexes] = 0.0
    mujoco.mj_kinematics(model, data)
    for i, (robot, arm) in enumerate(parts):
        joints = np.asarray(robot._ref_joint_indexes)
        site = robot.eef_site_id[arm]
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, robot.robot_model.eef_name[arm])
        turns = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)
        if set(_moved_by(model, body)) != set(joints.tolist()) or not turns.all():
            continue
        turn = data.xmat[body].reshape(3, 3)
        hand = np.stack([data.site_xpos[site], turn[:, 0], turn[:, 1]])
        prefix = f"robot{i}_" if len(parts) > 1 else ""
        # Sites and bodies are where they were before the last substep moved the joints.
        late = 1.0 / PHYSICS_FREQ
        found.append(Chain(prefix, data.xaxis[joints].copy(), data.xanchor[joints].copy(), hand, late, max(noise, 1.0)))
    return tuple(found)


def _moved_by(model: mujoco.MjModel, body: int) -> list[int]:
    """The joints between a body and the world."""
    found: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        found += range(first, first + int(model.body_jntnum[body])) if first >= 0 else ()
        body = int(model.body_parentid[body])
    return found
