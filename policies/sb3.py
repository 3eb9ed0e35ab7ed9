"""Reads the policy of a stable-baselines3 archive without unpickling anything in it.

An archive is a zip of ``data`` (JSON, in which what is no JSON is pickled) and of tensors. The network is rebuilt from
the tensors and from what the JSON says in plain text; pickles are only looked at, for the names of what they would
import. An archive that holds more than stable-baselines3 writes may act in ways that the tensors do not show, and is
refused.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import pickletools
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import MOST_EXPANDED, opened_zip
from asm_gym.policies.network import NetworkPolicy

MEMBERS = (
    "data",
    "policy.pth",
    "pytorch_variables.pth",
    "policy.optimizer.pth",
    "actor.optimizer.pth",
    "critic.optimizer.pth",
    "ent_coef_optimizer.pth",
    "_stable_baselines3_version",
    "system_info.txt",
)
"""What stable-baselines3 writes."""

OWN = (
    "stable_baselines3.",
    "gymnasium.spaces.",
    "numpy.",
    "torch.nn.modules.activation.",
    "torch.optim.",
    "collections.",
)
"""Where what it pickles comes from."""

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
"""Where a policy class is from: the algorithms that use it, by the first of them, and its activation by default."""


DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, binascii.Error, EOFError, RuntimeError),
    *(LookupError, TypeError, AttributeError, ValueError),
)
"""What reading an archive may raise whose members are not what they should be."""


def read_archive(path: Path, seed: int | None = None) -> NetworkPolicy:
    """The agent that ``model.save`` wrote, of SAC, TD3, DDPG, PPO or A2C with an ``MlpPolicy``.

    Args:
        seed: of its noise.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the archive is damaged, holds what stable-baselines3 would not write, or is no such agent.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no agent at {path}")
    try:
        with opened_zip(path, path.stat().st_size, MOST_EXPANDED) as archive:
            foreign = sorted(set(archive.namelist()) - set(MEMBERS))
            if foreign:
                raise ValueError(f"unexpected content: {', '.join(foreign)}")
            data = json.loads(archive.read("data"))
            refused = sorted({name for value in _pickles(data) for name in _imports(value) if not _is_own(name)})
            if refused:
                raise ValueError(
                    f"its pickled data would import {', '.join(refused)}, which stable-baselines3 does not"
                )
            return _from_data(data, _tensors(archive.read("policy.pth")), seed)
    except DAMAGE as error:
        why = str(error) or type(error).__name__
        raise ValueError(f"{path} is not an agent that can be read: {why}") from error


def _pickles(data: Any) -> Iterator[bytes]:
    """Everything pickled in the JSON, however deep."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == ":serialized:":
                yield base64.b64decode(value)
            else:
                yield from _pickles(value)
    elif isinstance(data, list):
        for value in data:
            yield from _pickles(value)


def _imports(pickled: bytes) -> Iterator[str]:
    """Dotted names that a pickle would import, read from its opcodes."""
    strings: list[str] = []
    memo: dict[int, str] = {}
    last = ""
    for opcode, argument, _ in pickletools.genops(pickled):
        if opcode.name in ("GLOBAL", "INST"):
            yield str(argument).replace(" ", ".")
        elif opcode.name == "STACK_GLOBAL":
            yield ".".join(strings[-2:])
        elif "UNICODE" in opcode.name:
            last = str(argument)
            strings.append(last)
        elif opcode.name == "MEMOIZE":
            memo[len(memo)] = last
        elif opcode.name in ("BINGET", "LONG_BINGET"):
            strings.append(memo.get(int(argument or 0), ""))


def _is_own(name: str) -> bool:
    return name.startswith(OWN)


def _tensors(pth: bytes) -> dict[str, NDArray[np.float32]]:
    import pickle

    import torch

    if zipfile.is_zipfile(io.BytesIO(pth)):  # as torch has written them since 2020
        with opened_zip(io.BytesIO(pth), len(pth), MOST_EXPANDED):
            pass
    try:
        # Tensors alone: torch refuses everything else in the file.
        found = torch.load(io.BytesIO(pth), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ValueError(f"policy.pth holds more than tensors: {error}") from error
    claimed = sum(tensor.numel() for tensor in found.values())
    if claimed > len(pth):  # one number can be viewed as a tensor of any shape
        raise ValueError(f"policy.pth has {len(pth)} bytes, and its tensors {claimed} numbers")
    return {name: tensor.numpy().astype(np.float32) for name, tensor in found.items()}


def _from_data(data: dict[str, Any], tensors: dict[str, NDArray[np.float32]], seed: int | None) -> NetworkPolicy:
    module = str(data["policy_class"].get("__module__"))
    if module not in POLICIES:
        raise ValueError(f"its policy is from {module}; known: {', '.join(POLICIES)}")
    algorithm, activation = POLICIES[module]
    options = {k: v for k, v in (data.get("policy_kwargs") or {}).items() if k not in (":type:", ":serialized:")}
    unknown = sorted(set(options) - set(NETWORK_OPTIONS))
    if unknown:
        raise ValueError(
            f"its policy_kwargs hold {', '.join(unknown)}; only {', '.join(NETWORK_OPTIONS)} are understood"
        )
    if "activation_fn" in options:
        activation = str(options["activation_fn"]).rstrip("'>").rsplit(".", 1)[-1].lower()
    return network(algorithm, tensors, activation, noisy=not data.get("use_sde"), seed=seed)


def network(
    algorithm: str, tensors: dict[str, NDArray[np.float32]], activation: str, *, noisy: bool = False, **kwargs: Any
) -> NetworkPolicy:
    """The network in the tensors of a policy of stable-baselines3.

    Args:
        algorithm: ``"SAC"``, ``"TD3"`` (as DDPG) or ``"PPO"`` (as A2C).
        noisy: with the noise it explores by.
        kwargs: handed to ``NetworkPolicy``.
    """
    if algorithm == "TD3":
        return NetworkPolicy(_layers(tensors, "actor.mu"), activation, "tanh", **kwargs)
    if algorithm == "SAC":
        layers = [*_layers(tensors, "actor.latent_pi"), _layer(tensors, "actor.mu")]
        noise = _layer(tensors, "actor.log_std") if noisy else None
        return NetworkPolicy(layers, activation, "tanh", log_std=noise, **kwargs)
    layers = [*_layers(tensors, "mlp_extractor.policy_net"), _layer(tensors, "action_net")]
    noise = (np.zeros_like(layers[-1][0]), tensors["log_std"]) if noisy else None
    return NetworkPolicy(layers, activation, "clip", log_std=noise, **kwargs)


def _layers(
    tensors: dict[str, NDArray[np.float32]], name: str
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Linear layers of a torch Sequential, in order; activations lie between them and have no tensors."""
    numbers = sorted(
        int(key.removeprefix(f"{name}.").removesuffix(".weight"))
        for key in tensors
        if key.startswith(f"{name}.") and key.endswith(".weight")
    )
    return [_layer(tensors, f"{name}.{n}") for n in numbers]


def _layer(tensors: dict[str, NDArray[np.float32]], name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return tensors[f"{name}.weight"], tensors[f"{name}.bias"]
