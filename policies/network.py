"""Trained agents: a network from observation to action, in arrays and JSON, or an archive of stable-baselines3.

    a = squash(W_n f(… f(W_1 x + b_1) …) + b_n),   x = (o - m) / s

``squash`` is tanh, scaled from [-1, 1] to the action space (SAC, TD3, DDPG), or a clip to it (PPO, A2C).

An archive holds JSON, in which what is no JSON is pickled, and tensors. The network is rebuilt from the tensors and the
plain text of the JSON, without unpickling anything; a policy that its tensors do not describe is refused.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.checkpoint import MOST_EXPANDED, opened_zip, read_checkpoint, write_checkpoint
from asm_gym.extras import require
from asm_gym.policies.base import StatefulPolicy
from asm_gym.validation import check_choice

Array = NDArray[np.float32]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "relu": lambda x: np.maximum(x, np.float32(0.0)),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0.0)))),
}
SQUASHES = ("tanh", "clip")
KIND = "agent"

NETWORK_OPTIONS = (
    *("net_arch", "activation_fn", "log_std_init", "ortho_init", "use_sde", "n_critics", "normalize_images"),
    *("optimizer_class", "optimizer_kwargs", "share_features_extractor"),
)
"""Options of ``policy_kwargs`` under which a policy is the plain network that its tensors describe."""

POLICIES = {
    "stable_baselines3.sac.policies": ("SAC", "relu"),
    "stable_baselines3.td3.policies": ("TD3", "relu"),
    "stable_baselines3.common.policies": ("PPO", "tanh"),
}
"""The first of the algorithms that use a module's policies, and their activation by default."""


class NetworkPolicy(StatefulPolicy):
    """Acts by a network, without noise; it keeps nothing between steps.

    Args:
        layers: (out, in) weights and (out,) biases, first to last.
        activation: of the hidden layers, one of ``ACTIVATIONS``.
        squash: what brings the output into the action space, one of ``SQUASHES``.
        mean, scale: (O,) what observations are standardised by; 0 and 1 where None.
        trained_in: the agent's environment, by name: see ``describe``.

    Raises:
        ValueError: layers that do not fit one another, or an unknown name.
    """

    def __init__(
        self,
        layers: Sequence[tuple[Array, Array]],
        activation: str,
        squash: str,
        *,
        mean: Array | None = None,
        scale: Array | None = None,
        trained_in: dict[str, Any] | None = None,
    ) -> None:
        check_choice("activation", activation, ACTIVATIONS)
        check_choice("squash", squash, SQUASHES)
        self.layers = [(np.asarray(W, np.float32), np.asarray(b, np.float32)) for W, b in layers]
        shapes = [W.shape for W, _ in self.layers]
        if not shapes or len(shapes[0]) != 2:
            raise ValueError(f"a network needs at least one layer, with weights in two dimensions, got {shapes[:1]}")
        size = inputs = self.observation_size = int(shapes[0][1])
        for n, (W, b) in enumerate(self.layers):
            if W.ndim != 2 or W.shape[1] != size or b.shape != W.shape[:1]:
                raise ValueError(f"layer {n} takes {size} numbers, got weights {W.shape} and biases {b.shape}")
            size = len(W)
        self.action_size = size
        self.activation, self.squash = activation, squash
        self.mean = np.asarray(np.zeros(inputs) if mean is None else mean, np.float32)
        self.scale = np.asarray(np.ones(inputs) if scale is None else scale, np.float32)
        if self.mean.shape != (inputs,) or self.scale.shape != (inputs,) or not (self.scale > 0).all():
            raise ValueError(f"mean and scale must be {inputs} numbers, and scale positive")
        if not all(np.isfinite(a).all() for a in (self.mean, self.scale, *itertools.chain(*self.layers))):
            raise ValueError("weights, biases, mean and scale must be finite")
        self.trained_in = dict(trained_in or {})
        self._low, self._high = np.full(size, -1.0, np.float32), np.ones(size, np.float32)

    def fit_to(self, env: gym.Env[Any, Any], whose: str) -> NetworkPolicy:
        """Return this policy, bound to the actions of ``env``; raise ValueError where it was trained in another one."""
        spaces_of = {"observations": env.observation_space, "actions": env.action_space}
        for (what, space), size in zip(spaces_of.items(), (self.observation_size, self.action_size), strict=True):
            if not isinstance(space, spaces.Box) or space.shape != (size,):
                raise ValueError(f"{whose} takes {what} of {size} numbers, {env.unwrapped} has {space}")
        here = describe(env)
        other = [f"{n}: {v} there, {here[n]} here" for n, v in self.trained_in.items() if n in here and here[n] != v]
        if other:
            raise ValueError(f"{whose} was trained in another environment ({'; '.join(other)})")
        assert isinstance(env.action_space, spaces.Box)
        self._low, self._high = env.action_space.low, env.action_space.high
        return self

    def begin(self, observation: Any) -> None:
        return None

    def act(self, observation: Any, state: Any, deterministic: bool) -> tuple[Array, Any]:
        """Return the action (A,), or (n, A) for n observations; and the state as it was."""
        f = ACTIVATIONS[self.activation]
        x = (np.asarray(observation, np.float32) - self.mean) / self.scale
        for W, b in self.layers[:-1]:
            x = f(x @ W.T + b)
        W, b = self.layers[-1]
        out = x @ W.T + b
        if self.squash == "tanh":
            out = self._low + 0.5 * (np.tanh(out) + 1.0) * (self._high - self._low)
        return np.clip(out, self._low, self._high).astype(np.float32), state

    def save(self, path: str | Path, **about: Any) -> None:
        """Write the agent, with what is said ``about`` it in JSON."""
        arrays = {"mean": self.mean, "scale": self.scale}
        for n, (W, b) in enumerate(self.layers):
            arrays |= {f"W{n}": W, f"b{n}": b}
        header = {"activation": self.activation, "squash": self.squash, "trained_in": self.trained_in, "about": about}
        write_checkpoint(path, KIND, header, arrays)

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
            return cls(layers, header["activation"], header["squash"], trained_in=header["trained_in"], **scaling)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error


def describe(env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Return what an agent's actions depend on beside the observation, as far as ``env`` says it."""
    inner: Any = env.unwrapped
    found: dict[str, Any] = {"env": inner.spec.id} if inner.spec is not None else {}
    if hasattr(inner, "robots") and hasattr(inner, "controller"):
        rate = int(inner.metadata["render_fps"])
        found |= {"robots": list(inner.robots), "controller": inner.controller, "control_freq": rate}
    return found


def read_archive(path: Path) -> NetworkPolicy:
    """Read what ``model.save`` wrote of SAC, TD3, DDPG, PPO or A2C with an ``MlpPolicy``; refuse anything else."""
    if not path.is_file():
        raise FileNotFoundError(f"no agent at {path}")
    saving = require("stable_baselines3.common.save_util", what="an agent of stable-baselines3")
    try:
        with opened_zip(path, path.stat().st_size, MOST_EXPANDED) as archive:
            data = json.loads(archive.read("data"))
        # Tensors alone: torch refuses everything else in them.
        found = saving.load_from_zip_file(path, load_data=False, device="cpu")[1]["policy"]
        tensors = {name: tensor.numpy().astype(np.float32) for name, tensor in found.items()}
        module = str(data["policy_class"].get("__module__"))
        if module not in POLICIES:
            raise ValueError(f"its policy is from {module}; known: {', '.join(POLICIES)}")
        algorithm, activation = POLICIES[module]
        options = {k: v for k, v in (data.get("policy_kwargs") or {}).items() if k not in (":type:", ":serialized:")}
        unknown = sorted(set(options) - set(NETWORK_OPTIONS))
        if unknown:
            raise ValueError(f"its policy_kwargs hold {unknown}; only {', '.join(NETWORK_OPTIONS)} are understood")
        if "activation_fn" in options:
            activation = str(options["activation_fn"]).rstrip("'>").rsplit(".", 1)[-1].lower()
        return network(algorithm, tensors, activation)
    except Exception as error:  # whatever members that are not what they should be raise
        why = str(error) or type(error).__name__
        raise ValueError(f"{path} is not an agent that can be read: {why}") from error


def network(algorithm: str, tensors: dict[str, Array], activation: str, **kwargs: Any) -> NetworkPolicy:
    """Build the network of ``"SAC"``, ``"TD3"`` (as DDPG) or ``"PPO"`` (as A2C) from the tensors of its policy."""
    hidden, last, squash = {
        "TD3": ("actor.mu", (), "tanh"),
        "SAC": ("actor.latent_pi", ("actor.mu",), "tanh"),
        "PPO": ("mlp_extractor.policy_net", ("action_net",), "clip"),
    }[algorithm]
    numbers = [k.removeprefix(f"{hidden}.").removesuffix(".weight") for k in tensors]
    names = [*(f"{hidden}.{n}" for n in sorted(map(int, filter(str.isdecimal, numbers)))), *last]
    return NetworkPolicy([(tensors[f"{n}.weight"], tensors[f"{n}.bias"]) for n in names], activation, squash, **kwargs)
