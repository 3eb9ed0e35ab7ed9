"""Faults between policy and controller: what arrives is not what was commanded.

The stream's efference copy carries the action as commanded, without the fault.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.faults.fault import LONGEST_DELAY, Clock, HookedFault, Interface, delayed, within
from asm_gym.validation import check_number

Action = NDArray[np.float32]


class ActionFault(HookedFault):
    """One that acts on the commanded action."""

    anywhere = True
    hooks = "deliveries"
    groups = ("joint", "torque", "hand")
    # whether it acts on the numbers that command grippers as well
    grippers_too: ClassVar[bool] = False

    def check(self, env: Interface) -> None:
        last = len(_arm_axes(env)) - 1
        check_number("axis", getattr(self, "axis", 0), low=0, high=last, whole=True)

    @abstractmethod
    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Any:
        """Return what arrives instead of what was ``commanded``, k steps since the onset; ``memory`` is its own."""

    def hook(self, env: Interface, clock: Clock) -> Callable[[Action], Action]:
        memory: list[Action] = []
        axes = _arm_axes(env)
        if self.grippers_too:
            axes = np.arange(gym.spaces.flatdim(env.action_space))

        def change(action: Action) -> Action:
            delivered = action.copy()
            delivered[axes] = self.deliver(action[axes], clock.steps, memory)
            return delivered

        return change


def _arm_axes(env: Interface) -> NDArray[np.intp]:
    """Return the indices of the action that move arms."""
    size = gym.spaces.flatdim(env.action_space)
    return np.setdiff1d(np.arange(size), np.asarray(env.gripper_actions, dtype=int))


class ActionDelay(ActionFault):
    """Deliver actions ``steps`` control steps late."""

    grippers_too = True

    steps: int = within(4, low=1, high=LONGEST_DELAY)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Action:
        return delayed(commanded, self.steps, memory)


class ActionDrop(ActionFault):
    """Lose actions, each with ``probability``: the arm then stays, and the grippers keep their last command."""

    probability: float = within(0.5, low=0, high=1)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Any:
        if self.rng(2 + k).random() < self.probability:
            return 0.0
        return commanded


class ActionBias(ActionFault):
    """Add ``amount`` [action units] to one ``axis``, counted among those that move arms."""

    axis: int = 0
    amount: float = within(0.3, low=-2, high=2)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Action:
        commanded[self.axis] += self.amount
        return commanded


class ActionScale(ActionFault):
    """Multiply the action by ``factor``."""

    factor: float = within(0.5, low=0, high=100)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Action:
        return commanded * self.factor


class ActionRepeat(ActionFault):
    """Repeat each action for ``steps`` control steps, and lose those in between."""

    grippers_too = True

    steps: int = within(5, low=1, high=LONGEST_DELAY)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Action:
        if k % self.steps == 0 or not memory:
            memory[:] = [commanded]
        return memory[0]


class SignFlip(ActionFault):
    """Reverse one ``axis``, counted among those that move arms."""

    axis: int = 0

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Action:
        commanded[self.axis] = -commanded[self.axis]
        return commanded


class ActionNoise(ActionFault):
    """Replace a ``share`` of the action by noise of standard deviation ``std`` [action units]."""

    share: float = within(1.0, low=0, high=1)
    std: float = within(0.5, low=0, high=2)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Any:
        noise = self.std * self.rng(2 + k).standard_normal(len(commanded))
        return (1.0 - self.share) * commanded + self.share * noise


class Adversary(ActionFault):
    """Disturb each axis by ``size`` [action units] against the commanded motion, the worst disturbance of this size."""

    size: float = within(0.4, low=0, high=2)

    def deliver(self, commanded: Action, k: int, memory: list[Action]) -> Any:
        return commanded - self.size * np.sign(commanded)
