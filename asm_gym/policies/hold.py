"""What ``hold`` means: under any controller, and in any order of wrappers.

    environment                      a robot stays because
    holds by itself                  it is braked beneath its controller, whatever the action is
    action is a change or velocity   the action reaches it as 0
    action is a target x*            x* = x where its override began, by ``ActionMeaning.staying``
    action is a torque, or unknown   nothing makes it stay: hold is refused

The brake beneath the controllers of this package's environments is in ``asm_gym.envs.controllers``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorActionWrapper, VectorEnv
from gymnasium.wrappers import ClipAction, TransformAction
from numpy.typing import NDArray

from asm_gym.data.action_meaning import DELTA, KEPT, TARGET, VELOCITY, ActionMeaning
from asm_gym.data.known_environments import known_means
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.stream_source import layers

SAFE_ACTION = "use Hold(env, safe_action=...)"
KNOWN_TO_STAY = (DELTA, TARGET, VELOCITY)  # meanings under which some action makes a robot stay


@runtime_checkable
class HoldsItself(Protocol):
    """An environment that can stay where it is, under any controller and wrapper."""

    holding: bool  # set, arms and grippers stay in the next control step; the step unsets it
    keeps_holding: bool  # set, no step unsets ``holding``: a wrapper may make several of one


class Hold:
    """Keep the robot in place and keep its grip.

    This package's environments hold by themselves, under any controller and wrapper. In any other
    environment a zero action holds if its attribute ``action_means`` is ``"delta"`` or
    ``"velocity"``.

    Args:
        env: an environment with a Box action space.
        safe_action: (A,) the action to take instead, if a zero action does not hold; it passes
            through all wrappers.

    Raises:
        TypeError: the action space is no Box.
        ValueError: ``safe_action`` does not fit the action space.
        UnsupportedEnvironment: no action is known that holds the robot.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        safe_action: NDArray[np.float32] | None = None,
    ) -> None:
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"a reflex needs a Box action space, got {space}")

        innermost = env.unwrapped
        self.env = env  # a guard refuses a policy that was made for another environment
        self.explicit = safe_action is not None  # such a policy is bound to no environment
        self._robot: HoldsItself | None = None
        if safe_action is not None:
            self._rest = np.array(safe_action, np.float32)
        elif isinstance(innermost, HoldsItself):
            self._robot = innermost
            self._rest = nearest_to_zero(space)
        else:
            self._rest = _rest_by_attribute(env)

        if not space.contains(self._rest):
            raise ValueError(f"safe_action {self._rest} is not in {space}")
        self._grip = gripper_columns(getattr(innermost, "gripper_actions", ()), self._rest.size)

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
        if self.explicit:
            return self._rest.copy(), state

        action = self._rest.copy()
        if self._robot is not None:
            self._robot.holding = True
        if state is not None:
            action[self._grip] = state[self._grip]
        return action, state


class HoldingActions:
    """The actions (n, A) for which n robots stay: each where it was when its override began.

    Args:
        count: n, how many robots there are.
        meaning: what their actions mean; None where ``rest`` is known to make them stay.
        rest: (A,) the action where nothing else is known.
    """

    def __init__(
        self,
        count: int,
        meaning: ActionMeaning | None,
        rest: NDArray[np.float32],
    ) -> None:
        self._meaning = meaning
        self._rest = rest
        self.executed = np.tile(rest, (count, 1))  # (n, A) the last action before the override
        self._actions = np.full_like(self.executed, np.nan)  # (n, A) NaN: not yet known
        # (2, n, D) the newest finite value of each number of a row, now and a row earlier
        self._rows: NDArray[np.float32] = np.zeros((2, count, 0), np.float32)  # D = 0: none sensed

    def begin(self, which: NDArray[np.bool_]) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.executed[which] = self._rest
        self._actions[which] = np.nan
        self._rows[:, which] = np.nan

    def sense(self, rows: NDArray[np.float32]) -> None:
        """Take in the newest rows (n, D)."""
        if self._meaning is None:
            return
        previous = self._rows[0]
        if not previous.size:
            previous = np.full_like(rows, np.nan)
        newest = np.where(np.isfinite(rows), rows, previous)
        self._rows = np.stack([newest, previous])

    def start(self, robot: int, executed: NDArray[np.float32]) -> None:
        """Begin the override of a robot that has ``executed`` (A,)."""
        self.executed[robot] = executed
        self._actions[robot] = np.nan

    def stay(self, robot: int) -> NDArray[np.float32]:
        """Return the action (A,) for which a robot stays; that of ``rest`` where unknown."""
        action = self._actions[robot]
        if self._meaning is not None and self._rows.size:
            newest, previous = self._rows[:, robot]
            sensed = self._meaning.staying(newest, previous, self.executed[robot])
            np.copyto(action, sensed, where=np.isnan(action))
        return np.where(np.isnan(action), self._rest, action)


class Staying(NamedTuple):
    """Which actions make robots stay."""

    action: NDArray[np.float32]  # (A,) where it is no target
    meaning: ActionMeaning | None = None  # None where ``action`` makes them stay everywhere
    refused: str = ""  # why none is known to make them stay


def staying(
    env: gym.Env[Any, Any] | VectorEnv[Any, Any, Any],
    space: spaces.Box,
    declared: ActionMeaning | None,
    recorded: ActionMeaning | None,
) -> Staying:
    """Return which actions make robots stay that do not hold by themselves.

    Args:
        env: the environment, or a vector environment.
        space: the action space of one robot.
        declared: what the user or the environment says of the actions.
        recorded: what recorded episodes show of them.

    Raises:
        UnsupportedEnvironment: the meaning of an action is unknown, or it is a torque, or a wrapper changes it.
    """
    zero = nearest_to_zero(space)
    meaning = declared or recorded or ActionMeaning.unknown(space.shape)
    meaning.check_stays(env.unwrapped)
    if declared is None:
        return Staying(zero, meaning)

    if recorded is not None:
        _warn_of_contradictions(declared, recorded)
    follows_rows = np.isin(declared.means, (TARGET, KEPT))
    if not follows_rows.any() and not isinstance(env, VectorEnv):
        return Staying(resting_action(env))

    changed = why_changed(env, "a reflex")
    if changed:
        raise UnsupportedEnvironment(changed)
    if np.any(zero.ravel()[~follows_rows]):  # the space does not contain zero
        raise UnsupportedEnvironment(_no_rest(space))
    if follows_rows.any():
        return Staying(zero, declared)
    return Staying(zero)


def _warn_of_contradictions(declared: ActionMeaning, recorded: ActionMeaning) -> None:
    """Warn of numbers that are declared a target and move as none, or the other way round."""
    contradictions = []
    for number, (own, measured) in enumerate(zip(declared.means, recorded.means, strict=True)):
        differs = own != measured and TARGET in (own, measured)
        if differs and measured in KNOWN_TO_STAY:
            contradictions.append(f"number {number} moves as a {measured}")
    if contradictions:
        message = "; ".join(contradictions)
        warnings.warn(f"action_means contradicts the recorded episodes: {message}", stacklevel=7)


def _rest_by_attribute(env: gym.Env[Any, Any]) -> NDArray[np.float32]:
    """Return the resting action of an environment with the attribute ``action_means``, or with a known id.

    Raises:
        UnsupportedEnvironment: the attribute does not say that a zero action makes the robot stay.
    """
    means: Any = ()
    if env.has_wrapper_attr("action_means"):
        means = env.get_wrapper_attr("action_means") or ()
    if isinstance(means, str):
        means = (means,)
    if not means:
        env_id = getattr(env.unwrapped.spec, "id", "")
        means = known_means(env_id, int(np.prod(env.action_space.shape or ())))
    if not means or not set(means) <= {DELTA, VELOCITY}:
        raise UnsupportedEnvironment(
            f'{env.unwrapped} has no action_means="delta" or "velocity", '
            "so a zero action may not make it stay",
            f'{SAFE_ACTION}, or on_alarm="hold" with NeuralASMSafety\'s action_means',
        )
    return resting_action(env)


def nearest_to_zero(space: spaces.Box) -> NDArray[np.float32]:
    """Return the action (A,) of a space that is nearest to zero."""
    zero = np.zeros(space.shape)
    return np.clip(zero, space.low, space.high).astype(np.float32)


def resting_action(env: gym.Env[Any, Any]) -> NDArray[np.float32]:
    """Return (A,) the action that reaches the innermost environment as zero.

    Raises:
        UnsupportedEnvironment: none is known.
    """
    space: Any = env.action_space
    is_bounded = np.isfinite(space.low) & np.isfinite(space.high)
    low_plus_high = np.zeros(space.shape)  # 0 without bounds
    np.add(space.low, space.high, out=low_plus_high, where=is_bounded)
    middle = 0.5 * low_plus_high
    for candidate in (nearest_to_zero(space), middle.astype(np.float32)):
        if not np.any(_innermost_action(env, candidate)):
            return candidate
    raise UnsupportedEnvironment(why_changed(env, "hold") or _no_rest(space))


def _innermost_action(env: gym.Env[Any, Any], action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what an action (A,) becomes on its way to the innermost environment.

    Raises:
        UnsupportedEnvironment: a wrapper changes it by more than a function of the action.
    """
    for wrapper in layers(env):
        if isinstance(wrapper, TransformAction):  # a function of the action alone
            action = np.asarray(wrapper.action(action))
        elif isinstance(wrapper, gym.ActionWrapper):
            raise UnsupportedEnvironment(_changes_actions(wrapper, "hold"))
    return action


def why_changed(env: gym.Env[Any, Any] | VectorEnv[Any, Any, Any], reflex: str) -> str:
    """Return which wrapper keeps a reflex from knowing the action that reaches the robot.

    Args:
        env: the environment, or a vector environment.
        reflex: what the message calls the reflex.

    Returns:
        A message; empty where no wrapper changes actions.
    """
    for layer in layers(env):
        changes = isinstance(layer, gym.ActionWrapper | VectorActionWrapper)
        if changes and not isinstance(layer, ClipAction):
            return _changes_actions(layer, reflex)
    return ""


def _changes_actions(wrapper: Any, reflex: str) -> str:
    """Return that a wrapper must not stand inside of the guard."""
    guard = "NeuralASMSafety"
    if isinstance(wrapper, VectorActionWrapper):
        guard = "VectorNeuralASMSafety"
    return (
        f"{type(wrapper).__name__} changes actions, "
        f"so that {reflex} cannot know what reaches the robot: "
        f"put it outside of {guard}, or {SAFE_ACTION}"
    )


def _no_rest(space: spaces.Box) -> str:
    """Return that no action of a space is known to rest."""
    return f"hold takes a zero action for rest, which is not in {space}: {SAFE_ACTION}"


def gripper_columns(columns: Sequence[int], size: int) -> NDArray[np.intp]:
    """Return (G,) the numbers of an action that command grippers.

    They are none where one of the ``columns`` lies beyond the ``size`` of the action.
    """
    if max(columns, default=-1) >= size:  # a wrapper inside takes other actions
        columns = ()
    return np.asarray(columns, np.intp)
