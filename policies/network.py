"""Trained agents: a network from observation to action, in arrays and JSON.

    a = tanh(W_n f(… f(W_1 x + b_1) …) + b_n),   x = (o - m) / s,   f = max(·, 0)

The action is scaled from [-1, 1] to the action space.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.exceptions import DamagedFile
from asm_gym.policies.base import StatefulPolicy

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
        mean: Array | None = None,
        scale: Array | None = None,
        trained_in: dict[str, Any] | None = None,
    ) -> None:
        self.layers = [(np.asarray(W, np.float32), np.asarray(b, np.float32)) for W, b in layers]
        shapes = [W.shape for W, _ in self.layers]
        if not shapes or len(shapes[0]) != 2:
            raise ValueError(
                f"a network needs at least one layer, with weights in two dimensions, got {shapes[:1]}"
            )
        size = inputs = self.observation_size = int(shapes[0][1])
        for n, (W, b) in enumerate(self.layers):
            if W.ndim != 2 or W.shape[1] != size or b.shape != W.shape[:1]:
                raise ValueError(
                    f"layer {n} takes {size} numbers, got weights {W.shape} and biases {b.shape}"
                )
            size = len(W)
        self.action_size = size
        self.mean = np.asarray(np.zeros(inputs) if mean is None else mean, np.float32)
        self.scale = np.asarray(np.ones(inputs) if scale is None else scale, np.float32)
        if (
            self.mean.shape != (inputs,)
            or self.scale.shape != (inputs,)
            or not (self.scale > 0).all()
        ):
            raise ValueError(f"mean and scale must be {inputs} numbers, and scale positive")
        if not all(
            np.isfinite(a).all() for a in (self.mean, self.scale, *itertools.chain(*self.layers))
        ):
            raise ValueError("weights, biases, mean and scale must be finite")
        self.trained_in = dict(trained_in or {})
        self._low, self._high = np.full(size, -1.0, np.float32), np.ones(size, np.float32)

    def fit_to(self, env: gym.Env[Any, Any], whose: str) -> NetworkPolicy:
        """Return this policy, bound to the actions of ``env``; raise ValueError where it was trained in another one."""
        spaces_of = {"observations": env.observation_space, "actions": env.action_space}
        for (what, space), size in zip(
            spaces_of.items(), (self.observation_size, self.action_size), strict=True
        ):
            if not isinstance(space, spaces.Box) or space.shape != (size,):
                raise ValueError(
                    f"{whose} takes {what} of {size} numbers, {env.unwrapped} has {space}"
                )
        here = describe(env)
        other = [
            f"{n}: {v} there, {here[n]} here"
            for n, v in self.trained_in.items()
            if n in here and here[n] != v
        ]
        if other:
            raise ValueError(f"{whose} was trained in another environment ({'; '.join(other)})")
        assert isinstance(env.action_space, spaces.Box)
        self._low, self._high = env.action_space.low, env.action_space.high
        return self

    def act(self, observation: Any, state: Any, deterministic: bool) -> tuple[Array, Any]:
        """Return the action (A,), or (n, A) for n observations; and the state as it was."""
        x = (np.asarray(observation, np.float32) - self.mean) / self.scale
        for W, b in self.layers[:-1]:
            x = np.maximum(x @ W.T + b, np.float32(0.0))
        W, b = self.layers[-1]
        out = self._low + 0.5 * (np.tanh(x @ W.T + b) + 1.0) * (self._high - self._low)
        return np.clip(out, self._low, self._high).astype(np.float32), state

    def save(self, path: str | Path, **about: Any) -> None:
        """Write the agent, with what is said ``about`` it in JSON."""
        arrays = {"mean": self.mean, "scale": self.scale}
        for n, (W, b) in enumerate(self.layers):
            arrays |= {f"W{n}": W, f"b{n}": b}
        write_checkpoint(path, KIND, {"trained_in": self.trained_in, "about": about} | RULE, arrays)

    @classmethod
    def load(cls, path: str | Path) -> NetworkPolicy:
        """Read what ``save`` wrote; raise ValueError where the file is damaged, or no agent."""
        saved = read_checkpoint(path, KIND)
        header, arrays = saved.header, saved.arrays
        try:
            count = sum(name.startswith("W") for name in arrays)
            layers = [(arrays.pop(f"W{n}"), arrays.pop(f"b{n}")) for n in range(count)]
            scaling = {name: arrays.pop(name) for name in ("mean", "scale")}
            if arrays:
                raise ValueError(f"an agent has no {', '.join(arrays)}")
            if any(header[name] != known for name, known in RULE.items()):
                raise ValueError(f"its network is not of {RULE}")
            return cls(layers, trained_in=header["trained_in"], **scaling)
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFile(path, error) from error


def describe(env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Return what an agent's actions depend on beside the observation, as far as ``env`` says it."""
    inner: Any = env.unwrapped
    found: dict[str, Any] = {"env": inner.spec.id} if inner.spec is not None else {}
    if hasattr(inner, "robots") and hasattr(inner, "controller"):
        rate = int(inner.metadata["render_fps"])
        found |= {
            "robots": list(inner.robots),
            "controller": inner.controller,
            "control_freq": rate,
        }
    return found
