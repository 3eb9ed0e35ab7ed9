"""Robosuite's own rewards as named terms that add up to them, and success with them, from one look at the contacts."""

from __future__ import annotations

from typing import Any

from asm_gym.envs.rewards.base import RewardTerms, TaskReward
from asm_gym.envs.rewards.one_arm import Door, Lift, Stack, ToolHang
from asm_gym.envs.rewards.sorting import NutAssembly, PickPlace
from asm_gym.envs.rewards.two_arm import TwoArmHandover, TwoArmLift, TwoArmPegInHole, TwoArmTransport
from asm_gym.envs.rewards.wipe import Wipe
from asm_gym.tasks import task as task_spec

__all__ = ["RewardTerms", "Rewards"]

_FAMILIES: tuple[type[TaskReward], ...] = (
    Lift,
    Stack,
    Door,
    Wipe,
    ToolHang,
    NutAssembly,
    PickPlace,
    TwoArmLift,
    TwoArmPegInHole,
    TwoArmHandover,
    TwoArmTransport,
)


class Rewards:
    """Computes the reward of one robosuite environment.

    It holds ids of the present model: make it anew after a hard reset. Dense or sparse is what ``env.reward_shaping``
    said when it was made; the keys of the terms then never change.

    Args:
        task: a name in ``asm_gym.tasks.TASKS``.
        env: robosuite's environment of that task.

    Raises:
        ValueError: an unknown task, or a robot with more than one arm.
    """

    def __init__(self, task: str, env: Any) -> None:
        name = task_spec(task).name
        # PickPlaceCan and its like differ from PickPlace in their objects alone.
        family = next(f for f in _FAMILIES if name.startswith(f.__name__))
        self._reward = family(env)
        self.reads_history = family is Wipe
        """Whether it reads the robots' buffers of recent forces and accelerations (``recent_ee_…``)."""

    def __call__(self, action: Any) -> RewardTerms:
        """What ``env.reward(action)`` would return, term by term; changes in ``env`` what that would change, once.

        Args:
            action: not used: none of robosuite's tasks rewards the action itself.
        """
        return self._reward()
