"""How a robot is strained beside the force of its contacts: joints at their stops, and parts of it that touch."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from asm_gym.compilation import compiled
from asm_gym.envs.arms import Part, bodies, free_angles
from asm_gym.envs.mujoco_views import Floats, Ints

# Geoms by what they belong to.
ELSEWHERE = 0
GRIPPER = 1
LINK = 2  # of an arm, or its base


class Strain(NamedTuple):
    """The state of robots at one moment."""

    joint_stops: int  # joints at their stops
    self_contacts: int  # contacts between two parts of robots, without those within a gripper


class StrainSensor:
    """Counts the strain of the robots in one loaded model.

    Args:
        parts: the arms.
        model: MuJoCo's.
        data: of that model.
    """

    def __init__(self, parts: list[Part], model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._data = data
        joints = np.concatenate([robot._ref_joint_indexes for robot, _ in parts])
        self._angles = model.jnt_qposadr[joints]
        self._low, self._high = free_angles(model, joints)

        kind_of_body = np.full(model.nbody, ELSEWHERE)
        for robot, _ in parts:
            kind_of_body[bodies(model, robot)] = LINK
        for robot, arm in parts:
            gripper = model.body(robot.gripper[arm].root_body).id
            kind_of_body[_descendants(model, gripper)] = GRIPPER
        self._kinds = kind_of_body[model.geom_bodyid]

    def read(self) -> Strain:
        """Return the strain now."""
        stops = joints_at_stops(self._data.qpos, self._angles, self._low, self._high)
        touching = 0
        if self._data.ncon:
            touching = self_contacts(self._data.contact.geom, self._kinds)
        return Strain(joint_stops=stops, self_contacts=touching)


@compiled
def joints_at_stops(positions: Floats, places: Ints, low: Floats, high: Floats) -> int:
    """Return how many joints, at ``places`` (J,) of the positions, are below ``low`` or above ``high`` (J,)."""
    count = 0
    for n in range(len(places)):
        angle = positions[places[n]]
        if angle < low[n] or angle > high[n]:
            count += 1
    return count


@compiled
def self_contacts(pairs: Ints, kinds: Ints) -> int:
    """Return how many pairs (N, 2) of geoms in contact are of robots (G,), one of the two no gripper."""
    count = 0
    for n in range(len(pairs)):
        a = kinds[pairs[n, 0]]
        b = kinds[pairs[n, 1]]
        if min(a, b) > ELSEWHERE and max(a, b) == LINK:
            count += 1
    return count


def _descendants(model: mujoco.MjModel, body: int) -> Ints:
    """Return a body and all that hang on it."""
    found = [body]
    for other in range(body + 1, model.nbody):
        if model.body_parentid[other] in found:
            found.append(other)
    return np.array(found)
