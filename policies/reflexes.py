"""Hold, the base class of reflexes, and the action at which a robot rests."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorActionWrapper
from numpy.typing import NDArray

from asm_gym.data.action_meaning import DELTA, VELOCITY
from asm_gym.stream_source import layers


@runtime_checkable
class HoldsItself(Protocol):
    """An environment that can stay where it is, whatever its controller and the wrappers around it."""

    holding: bool  # set, the arms stay in the next control step, and the grippers too; the step unsets it
    keeps_holding: bool  # set, no step unsets ``holding``: for wrappers in between that make several steps of one


class Hold:
    """Keep the robot in place and keep its grip.

    This package's environments hold by themselves, under any controller and wrapper. In any other environment a zero
    action holds if its attribute ``action_means`` is ``"delta"`` or ``"velocity"``.

    Args:
        env: an environment with a Box action space.
        safe_action: (A,) the action to take instead, if a zero action does not hold; it passes through all wrappers.

    Raises:
        TypeError: the action space is no Box.
        ValueError: ``safe_action`` does not fit the action space, or no action is known that holds the robot.
    """

    def __init__(self, env: gym.Env[Any, Any], safe_action: NDArray[np.float32] | None = None) -> None:
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"a reflex needs a Box action space, got {space}")
        inner = env.unwrapped
        self.env = env  # a guard refuses one that was made for another environment
        self.explicit = safe_action is not None  # it does that, and knows of no environment
        self._robot = inner if isinstance(inner, HoldsItself) and not self.explicit else None
        if safe_action is not None:
            self._rest = np.array(safe_action, np.float32)
        else:
            self._rest = nearest_to_rest(space) if self._robot else _zero_that_rests(env)
        if not space.contains(self._rest):
            raise ValueError(f"safe_action {self._rest} is not in {space}")
        self._grip = np.asarray(getattr(inner, "gripper_actions", ()), dtype=int)
        if self._grip.size and self._grip.max() >= self._rest.size:  # a wrapper inside takes other numbers
            self._grip = self._grip[:0]

    def begin(self, executed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the initial state after the action ``executed`` (A,), whose grip is kept."""
        return np.array(executed, np.float32)

    def predict(
        self,
        observation: Any,
        state: NDArray[np.float32] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the next action (A,) and the state."""
        action = self._rest.copy() if self.explicit else self.move()
        if state is not None and not self.explicit:
            action[self._grip] = state[self._grip]
        return action, state

    def move(self) -> NDArray[np.float32]:
        """Return the next action (A,); its numbers for the gripper are replaced."""
        if self._robot is not None:
            self._robot.holding = True
        return self._rest.copy()


def _zero_that_rests(env: gym.Env[Any, Any]) -> NDArray[np.float32]:
    """Return the resting action. Raises ValueError where the environment does not say that zero makes it stay."""
    means = env.get_wrapper_attr("action_means") if env.has_wrapper_attr("action_means") else ()
    each = {means} if isinstance(means, str) else set(means or ())
    if not each or not each <= {DELTA, VELOCITY}:
        raise ValueError(
            f'{env.unwrapped} has no action_means="delta" or "velocity", so a zero action may not make it stay: '
            'use Hold(env, safe_action=...), or on_alarm="hold" with NeuralASMSafety\'s action_means'
        )
    return resting_action(env)


def nearest_to_rest(space: spaces.Box) -> NDArray[np.float32]:
    """Return the action (A,) of a space that is nearest to zero."""
    return np.clip(np.zeros(space.shape), space.low, space.high).astype(np.float32)


def resting_action(env: gym.Env[Any, Any]) -> NDArray[np.float32]:
    """Return (A,) the action that reaches the innermost environment as zero; raise ValueError where none is known."""
    space: Any = env.action_space
    bounded = np.isfinite(space.low) & np.isfinite(space.high)
    middle = 0.5 * (np.where(bounded, space.low, 0.0) + np.where(bounded, space.high, 0.0))
    for candidate in (nearest_to_rest(space), middle.astype(np.float32)):
        arrives = candidate
        for wrapper in layers(env):
            if isinstance(wrapper, gym.wrappers.TransformAction):  # a function of the action alone, so it may be asked
                arrives = np.asarray(wrapper.action(arrives))
            elif isinstance(wrapper, gym.ActionWrapper):
                raise ValueError(outside(wrapper, "hold"))
        if not np.any(arrives):
            return candidate
    changed = changed_by(env)
    raise ValueError(outside(changed, "hold") if changed else no_rest(space))


def changed_by(env: Any) -> Any:
    """Return the outermost wrapper, of one or many, that changes actions; None where there is none."""
    changing = (layer for layer in layers(env) if isinstance(layer, gym.ActionWrapper | VectorActionWrapper))
    return next((layer for layer in changing if not isinstance(layer, gym.wrappers.ClipAction)), None)


def outside(wrapper: Any, reflex: str, guard: str = "NeuralASMSafety") -> str:
    """Return that a wrapper must not stand inside of the guard."""
    return (
        f"{type(wrapper).__name__} changes actions, so that {reflex} cannot know what reaches the robot: "
        f"put it outside of {guard}, or use Hold(env, safe_action=...)"
    )


def no_rest(space: Any) -> str:
    """Return that no action of a space is known to rest."""
    return f"hold takes a zero action for rest, which is not in {space}: use Hold(env, safe_action=...)"
