"""Trained agents: a network from observation to action, in arrays and JSON.

    a = tanh(W_n f(… f(W_1 x + b_1) …) + b_n),   x = (o - m) / s,   f = max(·, 0)

The action is scaled from [-1, 1] to the action space.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.exceptions import DamagedFile
from asm_gym.policies.policy import StatefulPolicy
from asm_gym.validation import check_numbers

Array = NDArray[np.float32]

KIND = "agent"
RULE = {"activation": "relu", "squash": "tanh"}  # in the header of each file


class NetworkPolicy(StatefulPolicy):
    """Acts by a network, without noise; it keeps nothing between steps.

    Args:
        layers: (out, in) weights and (out,) biases, first to last.
        mean, scale: (O,) what observations are standardised by; 0 and 1 where None.
        trained_in: the agent's environment, by name: see ``describe``.

    Raises:
        ValueError: layers that do not fit one another, or numbers that are not finite.
    """

    def __init__(
        self,
        layers: Sequence[tuple[Array, Array]],
        *,
        mean: ArrayLike | None = None,
        scale: ArrayLike | None = None,
        trained_in: dict[str, Any] | None = None,
    ) -> None:
        self.layers: list[tuple[Array, Array]] = []
        for W, b in layers:
            self.layers.append((np.asarray(W, np.float32), np.asarray(b, np.float32)))
        self._check_layers()
        first, _ = self.layers[0]
        last, _ = self.layers[-1]
        self.observation_size = first.shape[1]
        self.action_size = last.shape[0]
        size = self.observation_size
        if mean is None:
            mean = np.zeros(size)
        if scale is None:
            scale = np.ones(size)
        self.mean = check_numbers("mean", mean, size).astype(np.float32)
        self.scale = check_numbers("scale", scale, size, above=0.0).astype(np.float32)
        self.trained_in = dict(trained_in or {})
        self._high: NDArray[Any] = np.ones(self.action_size, np.float32)
        self._low: NDArray[Any] = -self._high

    def _check_layers(self) -> None:
        """Raise ValueError unless each layer takes what the one before gives."""
        if not self.layers:
            raise ValueError("a network needs at least one layer, got none")
        size = self.layers[0][0].shape[-1]
        for number, (W, b) in enumerate(self.layers):
            is_matrix = W.ndim == 2 and W.shape[1] == size
            if not is_matrix or b.shape != W.shape[:1]:
                raise ValueError(
                    f"layer {number} takes {size} numbers, with weights in two dimensions, "
                    f"got {W.shape} and biases {b.shape}"
                )
            check_numbers("weights", W, *W.shape)
            check_numbers("biases", b, *b.shape)
            size = len(W)

    def fit_to(self, env: gym.Env[Any, Any], whose: str) -> NetworkPolicy:
        """Return this policy, bound to the actions of ``env``; raise ValueError where it was trained in another one."""
        _check_size("observations", env.observation_space, self.observation_size, whose)
        actions = _check_size("actions", env.action_space, self.action_size, whose)
        here = describe(env)
        differences = []
        for name, there in self.trained_in.items():
            if name in here and here[name] != there:
                differences.append(f"{name}: {there} there, {here[name]} here")
        if differences:
            raise ValueError(
                f"{whose} was trained in another environment ({'; '.join(differences)})"
            )
        self._low = actions.low
        self._high = actions.high
        return self

    def act(self, observation: Any, state: Any, deterministic: bool) -> tuple[Array, Any]:
        """Return the action (A,), or (n, A) for n observations; and the state as it was."""
        x = (np.asarray(observation, np.float32) - self.mean) / self.scale
        for W, b in self.layers[:-1]:
            x = np.maximum(x @ W.T + b, np.float32(0.0))
        W, b = self.layers[-1]
        squashed = np.tanh(x @ W.T + b)
        span = self._high - self._low
        action = self._low + 0.5 * (squashed + 1.0) * span
        return np.clip(action, self._low, self._high).astype(np.float32), state

    def save(self, path: str | Path, **about: Any) -> None:
        """Write the agent, with what is said ``about`` it in JSON."""
        arrays = {"mean": self.mean, "scale": self.scale}
        for number, (W, b) in enumerate(self.layers):
            arrays[f"W{number}"] = W
            arrays[f"b{number}"] = b
        header = {"trained_in": self.trained_in, "about": about} | RULE
        write_checkpoint(path, KIND, header, arrays)

    @classmethod
    def load(cls, path: str | Path) -> NetworkPolicy:
        """Read what ``save`` wrote; raise DamagedFile where the file is damaged, or no agent."""
        header, arrays = read_checkpoint(path, KIND)
        try:
            if not RULE.items() <= header.items():
                raise ValueError(f"its network is not of {RULE}")
            mean = arrays.pop("mean")
            scale = arrays.pop("scale")
            layers: list[tuple[Array, Array]] = []
            while f"W{len(layers)}" in arrays:
                number = len(layers)
                layers.append((arrays.pop(f"W{number}"), arrays.pop(f"b{number}")))
            if arrays:
                raise ValueError(f"an agent has no {', '.join(arrays)}")
            return cls(layers, mean=mean, scale=scale, trained_in=header["trained_in"])
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFile(path, error) from error


def _check_size(what: str, space: gym.Space[Any], size: int, whose: str) -> spaces.Box:
    """Return the space of an environment; raise ValueError unless it is a Box of so many numbers."""
    if not isinstance(space, spaces.Box) or space.shape != (size,):
        raise ValueError(f"{whose} takes {what} of {size} numbers, the environment has {space}")
    return space


def describe(env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Return what an agent's actions depend on beside the observation, as far as ``env`` says it."""
    inner: Any = env.unwrapped
    facts: dict[str, Any] = {}
    if inner.spec is not None:
        facts["env"] = inner.spec.id
    if hasattr(inner, "robots") and hasattr(inner, "controller"):
        facts["robots"] = list(inner.robots)
        facts["controller"] = inner.controller
        facts["control_freq"] = int(inner.metadata["render_fps"])
    return facts
