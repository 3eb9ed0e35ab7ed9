"""Faults between policy and controller: what arrives is not what was commanded.

The stream's efference copy carries the action as commanded, without the fault.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.faults.base import LONGEST, Apply, Fault, Interface, group_labels, listed, within

Action = NDArray[np.float32]


class ActionFault(Fault):
    """One that acts on the commanded action."""

    anywhere = True
    grippers_too: ClassVar[bool] = False
    """Whether it acts on the numbers that command grippers as well."""

    def check(self, env: Interface) -> None:
        axis = getattr(self, "axis", 0)
        if not 0 <= axis < len(_arm_axes(env)):
            raise ValueError(f"axis must be 0 to {len(_arm_axes(env)) - 1}, got {axis}")

    def begin(self) -> Any:
        """Return the fault's memory for one injection."""
        return None

    @abstractmethod
    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Any:
        """Return what arrives instead of the numbers that were ``commanded``, k steps since the onset."""

    @contextmanager
    def applied(self, env: Interface) -> Iterator[Apply]:
        intensity, k, memory = 0.0, -1, self.begin()
        axes = np.arange(gym.spaces.flatdim(env.action_space)) if self.grippers_too else _arm_axes(env)

        def apply(share: float) -> None:
            nonlocal intensity, k
            intensity, k = share, k + 1

        def change(action: Action) -> Action:
            delivered = action.copy()
            delivered[axes] = self.deliver(action[axes], intensity, k, memory)
            return delivered

        with listed(env.deliveries, change):
            yield apply

    def labels(self, env: Interface) -> frozenset[str]:
        return group_labels(env, "joint", "torque", "hand")


def _arm_axes(env: Interface) -> NDArray[np.intp]:
    """Return the indices of the action that move arms."""
    size = gym.spaces.flatdim(env.action_space)
    return np.setdiff1d(np.arange(size), np.asarray(env.gripper_actions, dtype=int))


class ActionDelay(ActionFault):
    """Deliver actions ``steps`` control steps late."""

    graded = False
    grippers_too = True

    steps: int = within(4, low=1, high=LONGEST)

    def begin(self) -> deque[Action]:
        return deque()

    def deliver(self, commanded: Action, intensity: float, k: int, memory: deque[Action]) -> Action:
        memory.append(commanded)
        return memory.popleft() if len(memory) > self.steps else memory[0]


class ActionDrop(ActionFault):
    """Lose actions, each with ``probability``: the arm is told to stay, and the grippers what they were told."""

    probability: float = within(0.5, low=0, high=1)

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Any:
        return 0.0 if self.rng(2 + k).random() < intensity * self.probability else commanded


class ActionBias(ActionFault):
    """Add ``amount`` [action units] to one ``axis``, counted among those that move arms."""

    axis: int = 0
    amount: float = within(0.3, low=-2, high=2)

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Action:
        commanded[self.axis] = commanded[self.axis] + intensity * self.amount
        return commanded


class ActionScale(ActionFault):
    """Multiply the action by ``factor``."""

    factor: float = within(0.5, low=0, high=100)

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Action:
        return commanded * (1 + intensity * (self.factor - 1))


class ActionRepeat(ActionFault):
    """Repeat each action for ``steps`` control steps, and lose those in between."""

    graded = False
    grippers_too = True

    steps: int = within(5, low=1, high=LONGEST)

    def begin(self) -> list[Action]:
        return []

    def deliver(self, commanded: Action, intensity: float, k: int, memory: list[Action]) -> Action:
        if k % self.steps == 0 or not memory:
            memory[:] = [commanded]
        return memory[0]


class SignFlip(ActionFault):
    """Reverse one ``axis``, counted among those that move arms."""

    graded = False

    axis: int = 0

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Action:
        commanded[self.axis] = -commanded[self.axis]
        return commanded


class ActionNoise(ActionFault):
    """Replace a ``share`` of the action by noise of standard deviation ``std`` [action units]."""

    share: float = within(1.0, low=0, high=1)
    std: float = within(0.5, low=0, high=2)

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Any:
        share = intensity * self.share
        return (1.0 - share) * commanded + share * (self.std * self.rng(2 + k).standard_normal(len(commanded)))


class Adversary(ActionFault):
    """Disturb each axis by ``size`` [action units] straight against the commanded motion, the worst of this size."""

    size: float = within(0.4, low=0, high=2)

    def deliver(self, commanded: Action, intensity: float, k: int, memory: Any) -> Action:
        return commanded - intensity * self.size * np.sign(commanded)
