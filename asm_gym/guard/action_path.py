"""Follow actions through the wrappers around an environment, without a step.

u_inner = f_n(… f_1(u_outer))        f_i: what the i-th wrapper makes of an action, the outermost first
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformAction

from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.robot_table import Floats32
from asm_gym.stream_source import layers


def passed_on(actions: Floats32, outer: gym.Env[Any, Any], inner: gym.Env[Any, Any]) -> Floats32:
    """Return actions of an environment (k, ...) as they reach one of its layers (k, ...).

    Args:
        actions: (k, *shape of the actions of ``outer``).
        outer: the outermost wrapper.
        inner: a wrapper in ``outer``, or the environment in all.

    Raises:
        ValueError: ``inner`` is not in ``outer``.
        UnsupportedEnvironment: a wrapper between them changes actions by more than a function of the action.
    """
    for layer in [*layers(outer), outer.unwrapped]:
        if layer is inner:
            return actions
        if isinstance(layer, TransformAction):  # ClipAction and RescaleAction too
            actions = np.array([layer.action(action) for action in actions], np.float32)
        elif _changes_actions(layer):
            raise UnsupportedEnvironment(
                f"{type(layer).__name__} changes actions, and preview() cannot know how",
                advice="make it a gymnasium.wrappers.TransformAction, or preview inside of it",
            )
    raise ValueError(f"{outer} is not the environment around this guard")


def _changes_actions(layer: Any) -> bool:
    """Return whether a wrapper is made to change actions, or takes others than the environment in it."""
    if isinstance(layer, gym.ActionWrapper):
        return True
    return isinstance(layer, gym.Wrapper) and layer.action_space != layer.env.action_space
