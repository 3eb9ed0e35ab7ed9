"""What the rewards of all tasks share: hands, contacts between groups of geoms, and the scale."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np


class RewardTerms(NamedTuple):
    """One step's reward.

    Args:
        terms: name to value, scaled; they add up to the reward.
        success: whether the task is solved now.
    """

    terms: dict[str, float]
    success: bool


class TaskReward(ABC):
    """The reward of one task, bound to the present model.

    Args:
        env: robosuite's environment.
    """

    best: ClassVar[float]
    """The largest reward before scaling, which robosuite divides by."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.dense = bool(env.reward_shaping)
        self.scale = 1.0 if env.reward_scale is None else env.reward_scale / self.best
        self.data: mujoco.MjData = env.sim.data._data
        hands = [site for robot in env.robots for site in robot.eef_site_id.values()]
        if len(hands) != len(env.robots):
            raise ValueError(f"rewards are for robots with one arm each, got {len(hands)} arms")
        self.hand, self.other_hand = hands[0], hands[-1]
        """The sites between each hand's fingers; one and the same where there is one robot."""

    @abstractmethod
    def __call__(self) -> RewardTerms:
        """The reward in the present state."""

    def reward(self, solved: bool, /, **terms: float) -> RewardTerms:
        """Terms before scaling to the result."""
        return RewardTerms({name: float(value) * self.scale for name, value in terms.items()}, bool(solved))


def largest(*stages: dict[str, float]) -> dict[str, float]:
    """All terms, zero but for those of the stage with the largest sum."""
    best = max(stages, key=lambda stage: sum(stage.values()))
    return {name: value if stage is best else 0.0 for stage in stages for name, value in stage.items()}


def fingerpads(robot: Any) -> tuple[list[str], list[str]]:
    """Geoms of the left and the right pad, which both touch what is grasped."""
    (gripper,) = robot.gripper.values()
    return gripper.important_geoms["left_fingerpad"], gripper.important_geoms["right_fingerpad"]


class Contacts:
    """Which of some groups of geoms touch each other.

    With A (ncon, G) saying of each contact which groups its first geom is in, and B its second,

        T = A'B + B'A > 0.

    Args:
        groups: names of geoms; a geom may be in several groups.
    """

    def __init__(self, env: Any, *groups: Collection[str]) -> None:
        self._data: mujoco.MjData = env.sim.data._data
        model: mujoco.MjModel = env.sim.model._model
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) for i in range(model.ngeom)]
        members = [set(group) for group in groups]
        # Floats, because numpy multiplies matrices of booleans without BLAS.
        self._member = np.array([[name in group for group in members] for name in names], np.float32)  # (ngeom, G)

    def __call__(self) -> list[list[float]]:
        """G rows of G numbers, symmetric and above 0 where two groups touch."""
        pairs = self._data.contact.geom  # (ncon, 2)
        one_way = self._member[pairs[:, 0]].T @ self._member[pairs[:, 1]]  # (G, G)
        return (one_way + one_way.T).tolist()  # type: ignore[no-any-return]
