"""Environments that run side by side: what one of them is like, and one row here exchanged for one there."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from copy import deepcopy
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper
from gymnasium.wrappers.vector import NormalizeObservation
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
ATTRIBUTES = (
    *("stream_spec", "gripper_actions", "controller", "dt", "holding", "keeps_holding"),
    *("felt_channels", "contact_limits", "observation_layout", "laid_out_space", "hand_chains"),
)
"""What monitors and reflexes ask an environment for."""


@runtime_checkable
class Askable(Protocol):
    """A vector environment whose members can be asked, and told."""

    def call(self, name: str, *args: Any) -> tuple[Any, ...]:
        """What the method ``name`` of each returns."""
        ...

    def set_attr(self, name: str, values: list[Any]) -> None:
        """Sets an attribute of each."""
        ...


@runtime_checkable
class Named(Protocol):
    """A named tuple."""

    def _make(self, parts: Iterable[Any]) -> Any: ...


class Member(gym.Env[Any, Any]):
    """One of many environments, as far as a monitor or a reflex asks; it cannot be stepped by itself.

    Args:
        envs: all of them.
        index: which.
        attributes: what it has of ``ATTRIBUTES``.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], index: int, attributes: dict[str, Any]) -> None:
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space
        self.metadata = envs.metadata
        self._envs: Any = envs.unwrapped
        self._index = index
        for name, value in attributes.items():
            setattr(self, name, value)

    def action_for(self, turns: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """The action that moves the arms' joints by ``turns`` [rad]."""
        # A vector environment asks all of its members or none.
        action: NDArray[np.float32] = self._envs.call("action_for", turns)[self._index]
        return action

    def slowed(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """(A,) what is commanded in the place of ``action``, by the speed that contact limits allow."""
        slow: NDArray[np.float32] = self._envs.call("slowed", action)[self._index]
        return slow

    def force_behind(self, torques: NDArray[np.floating[Any]]) -> tuple[str, NDArray[np.float64]]:
        """The link that is pressed, and the force on it; nowhere, where the members do not know."""
        if not hasattr(self, "felt_channels"):
            return "", np.zeros(3)
        link, force = self._envs.call("force_behind", torques)[self._index]
        return link, force


def members(envs: VectorEnv[Any, Any, Any]) -> list[Member]:
    """The environments of a vector environment.

    Raises:
        TypeError: it has no ``call``, by which Gymnasium's own are asked for what their members are.
    """
    inner = envs.unwrapped
    if not isinstance(inner, Askable):
        raise TypeError(
            f"{inner} cannot be asked what its environments are: make it with SyncVectorEnv or AsyncVectorEnv"
        )
    found: list[dict[str, Any]] = [{} for _ in range(envs.num_envs)]
    for name in ATTRIBUTES:
        # Asked first, for a worker process in which an attribute is missing is ended by Gymnasium.
        if all(inner.call("has_wrapper_attr", name)):
            for attributes, value in zip(found, inner.call("get_wrapper_attr", name), strict=True):
                attributes[name] = value
    return [Member(envs, i, attributes) for i, attributes in enumerate(found)]


def set_attribute(envs: VectorEnv[Any, Any, Any], name: str, values: list[Any]) -> None:
    """Sets an attribute of each member; workers' too."""
    inner = envs.unwrapped
    assert isinstance(inner, Askable)
    inner.set_attr(name, values)


def refuse_changes(envs: VectorEnv[Any, Any, Any]) -> None:
    """Raises ValueError where a wrapper around all of them changes actions."""
    while isinstance(envs, VectorWrapper):
        if isinstance(envs, VectorActionWrapper):
            raise ValueError(
                f"{type(envs).__name__} changes actions, so that the reflex cannot know what reaches the robot: put it "
                "outside of VectorNeuralASMSafety"
            )
        envs = envs.env


def refuse_running_statistics(envs: VectorEnv[Any, Any, Any]) -> None:
    """Raises ValueError for a wrapper around all of them that makes more and more else of the same sense."""
    while isinstance(envs, VectorWrapper):
        if isinstance(envs, NormalizeObservation) and envs.update_running_mean:
            raise ValueError(
                "NormalizeObservation changes what it makes of the same sense as it goes on: put it outside, as in "
                "NormalizeObservation(VectorNeuralASMSafety(envs, monitor)), or set its update_running_mean to False"
            )
        envs = envs.env


def put(batch: Any, i: int, value: Any) -> Any:
    """A copy of a batch, an array or a dict of such, with ``value`` at ``i``."""
    if isinstance(batch, dict):
        return {key: put(part, i, value[key]) for key, part in batch.items()}
    changed = np.array(batch)
    changed[i] = value
    return changed


def choose(mask: Mask, new: Any, old: Any) -> Any:
    """A monitor's state with ``new`` where ``mask`` (n,) holds, ``old`` elsewhere.

    Args:
        new, old: arrays whose first axis is n, or named tuples of such, nested or not.
    """
    if isinstance(old, tuple):
        parts = [choose(mask, n, o) for n, o in zip(new, old, strict=True)]
        return old._make(parts) if isinstance(old, Named) else tuple(parts)
    if not isinstance(old, np.ndarray) or len(old) != len(mask):
        raise TypeError(f"a monitor's state must be arrays whose first axis is {len(mask)} long, got {old!r}")
    return np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def replace(infos: dict[str, Any], by: dict[str, Any], mask: Mask, keep: Collection[str] = ()) -> dict[str, Any]:
    """Infos in which the environments of ``mask`` (n,) have what ``by`` says of them, and nothing else.

    Args:
        keep: keys, with their masks, to leave as they are.
    """
    merged = dict(infos)
    for key in infos.keys() | by.keys():
        if key.removeprefix("_") in keep:
            continue
        old, new = infos.get(key), by.get(key)
        if isinstance(old, dict) or isinstance(new, dict):
            merged[key] = replace(old or {}, new or {}, mask)
            continue
        old = _blank(new) if old is None else old
        new = _blank(old) if new is None else new
        merged[key] = np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    return merged


def final(infos: dict[str, Any], observations: Sequence[Any], mask: Mask) -> dict[str, Any]:
    """Infos with ``final_obs`` and ``final_info`` of the environments of ``mask`` (n,), from what is theirs now."""
    ends = ("final_obs", "final_info", "_final_obs", "_final_info")
    now = {key: value for key, value in infos.items() if key not in ends}
    last = np.array(infos.get("final_obs", np.full(len(mask), None, object)))
    for i in np.flatnonzero(mask):
        last[i] = deepcopy(observations[i])
    known = {"_final_obs": mask | infos.get("_final_obs", False), "_final_info": mask | infos.get("_final_info", False)}
    return {**infos, **known, "final_obs": last, "final_info": replace(infos.get("final_info", {}), now, mask)}


def _blank(like: Any) -> NDArray[Any]:
    return np.full(like.shape, None, object) if like.dtype == object else np.zeros_like(like)
