"""Faults between policy and controller: what arrives is not what was commanded.

The stream's efference copy carries the action as commanded; nobody tells the robot what became of it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.faults.base import LONGEST, Apply, Fault, Interface, group_labels, listed, within

Action = NDArray[np.float32]
Deliver = Callable[[Action, float, int], Action]


@dataclass(frozen=True, kw_only=True)
class ActionFault(Fault):
    """One that acts on the commanded action, grippers aside."""

    anywhere = True

    def check(self, env: Interface) -> None:
        axis = getattr(self, "axis", 0)
        if not 0 <= axis < len(_arm_axes(env)):
            raise ValueError(f"axis must be 0 to {len(_arm_axes(env)) - 1}, got {axis}")

    @abstractmethod
    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        """What arrives: a function of (action, intensity, k), with k steps since the onset.

        Args:
            axes: the numbers of the action that move arms.
        """

    @contextmanager
    def applied(self, env: Interface) -> Iterator[Apply]:
        intensity, k = 0.0, -1
        rule = self.deliver(_arm_axes(env))

        def apply(share: float) -> None:
            nonlocal intensity, k
            intensity, k = share, k + 1

        with listed(env.deliveries, lambda action: rule(action, intensity, k)):
            yield apply

    def labels(self, env: Interface) -> frozenset[str]:
        return group_labels(env, "joint", "torque", "hand")


def _arm_axes(env: Interface) -> NDArray[np.intp]:
    size = gym.spaces.flatdim(env.action_space)
    return np.setdiff1d(np.arange(size), np.asarray(env.gripper_actions, dtype=int))


@dataclass(frozen=True, kw_only=True)
class ActionDelay(ActionFault):
    """Actions that arrive late.

    Args:
        steps: by how many control steps.
    """

    graded = False

    steps: int = within(4, low=1, high=LONGEST)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        queue: deque[Action] = deque()

        def late(action: Action, _: float, __: int) -> Action:
            queue.append(action)
            return queue.popleft() if len(queue) > self.steps else queue[0]

        return late


@dataclass(frozen=True, kw_only=True)
class ActionDrop(ActionFault):
    """Actions that are lost: the arm is told to stay, and the grippers what they were told.

    Args:
        probability: of each action.
    """

    probability: float = within(0.5, low=0, high=1)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        def drop(action: Action, intensity: float, k: int) -> Action:
            if self.rng(2 + k).random() < intensity * self.probability:
                return _with(action, axes, 0.0)
            return action

        return drop


@dataclass(frozen=True, kw_only=True)
class ActionBias(ActionFault):
    """Something is added to one axis.

    Args:
        axis: counted among those that move arms.
        amount: in action units.
    """

    axis: int = 0
    amount: float = within(0.3, low=-2, high=2)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        where = axes[self.axis]
        return lambda action, intensity, _: _with(action, where, action[where] + intensity * self.amount)


@dataclass(frozen=True, kw_only=True)
class ActionScale(ActionFault):
    """Motors do more or less than they are told, all alike.

    Args:
        factor: what the action is multiplied by.
    """

    factor: float = within(0.5, low=0, high=100)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        return lambda action, intensity, _: _with(action, axes, action[axes] * (1 + intensity * (self.factor - 1)))


@dataclass(frozen=True, kw_only=True)
class ActionRepeat(ActionFault):
    """Each action is repeated, and those in between are lost.

    Args:
        steps: how long one is held [control steps].
    """

    graded = False

    steps: int = within(5, low=1, high=LONGEST)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        held: list[Action] = []

        def repeat(action: Action, _: float, k: int) -> Action:
            if k % self.steps == 0 or not held:
                held[:] = [action]
            return held[0]

        return repeat


@dataclass(frozen=True, kw_only=True)
class SignFlip(ActionFault):
    """One axis goes the wrong way.

    Args:
        axis: counted among those that move arms.
    """

    graded = False

    axis: int = 0

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        where = axes[self.axis]
        return lambda action, _, __: _with(action, where, -action[where])


@dataclass(frozen=True, kw_only=True)
class ActionNoise(ActionFault):
    """The action is replaced by noise, in part or as a whole.

    Args:
        share: how much of it.
        std: standard deviation of the noise, in action units.
    """

    share: float = within(1.0, low=0, high=1)
    std: float = within(0.5, low=0, high=2)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        def noise(action: Action, intensity: float, k: int) -> Action:
            share = intensity * self.share
            drawn = self.std * self.rng(2 + k).standard_normal(len(axes))
            return _with(action, axes, (1.0 - share) * action[axes] + share * drawn)

        return noise


@dataclass(frozen=True, kw_only=True)
class Adversary(ActionFault):
    """Of all disturbances of a given size, the one that takes most of the commanded motion away: straight against it.

    Args:
        size: of the disturbance in each axis, in action units.
    """

    size: float = within(0.4, low=0, high=2)

    def deliver(self, axes: NDArray[np.intp]) -> Deliver:
        return lambda action, intensity, _: _with(
            action, axes, action[axes] - intensity * self.size * np.sign(action[axes])
        )


def _with(action: Action, where: Any, values: Any) -> Action:
    delivered = action.copy()
    delivered[where] = values
    return delivered
