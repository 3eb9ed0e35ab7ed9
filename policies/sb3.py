"""Reads the policy of a stable-baselines3 archive without unpickling anything in it.

The archive holds JSON, in which what is no JSON is pickled, and tensors. The network is rebuilt from the tensors and
from the plain text of the JSON; a policy that its tensors do not describe is refused.
"""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import MOST_EXPANDED, opened_zip
from asm_gym.policies.network import NetworkPolicy

Tensors = dict[str, NDArray[np.float32]]

MEMBERS = (
    *("data", "policy.pth", "pytorch_variables.pth", "policy.optimizer.pth", "actor.optimizer.pth"),
    *("critic.optimizer.pth", "ent_coef_optimizer.pth", "_stable_baselines3_version", "system_info.txt"),
)
"""The files that stable-baselines3 writes."""

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

DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, LookupError, TypeError, AttributeError)
"""Errors, besides ValueError, of reading an archive whose members are not what they should be."""


def read_archive(path: Path) -> NetworkPolicy:
    """Read the agent that ``model.save`` wrote, of SAC, TD3, DDPG, PPO or A2C with an ``MlpPolicy``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the archive is damaged, or is no such agent.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no agent at {path}")
    try:
        with opened_zip(path, path.stat().st_size, MOST_EXPANDED) as archive:
            foreign = sorted(set(archive.namelist()) - set(MEMBERS))
            if foreign:
                raise ValueError(f"unexpected content: {', '.join(foreign)}")
            data, tensors = json.loads(archive.read("data")), _tensors(archive.read("policy.pth"))
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
    except (*DAMAGE, ValueError) as error:
        why = str(error) or type(error).__name__
        raise ValueError(f"{path} is not an agent that can be read: {why}") from error


def _tensors(pth: bytes) -> Tensors:
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


def network(algorithm: str, tensors: Tensors, activation: str, **kwargs: Any) -> NetworkPolicy:
    """Build the network of ``"SAC"``, ``"TD3"`` (as DDPG) or ``"PPO"`` (as A2C) from the tensors of its policy."""
    hidden, last, squash = {
        "TD3": ("actor.mu", (), "tanh"),
        "SAC": ("actor.latent_pi", ("actor.mu",), "tanh"),
        "PPO": ("mlp_extractor.policy_net", ("action_net",), "clip"),
    }[algorithm]
    numbers = [k.removeprefix(f"{hidden}.").removesuffix(".weight") for k in tensors]
    names = [*(f"{hidden}.{n}" for n in sorted(map(int, filter(str.isdecimal, numbers)))), *last]
    return NetworkPolicy([(tensors[f"{n}.weight"], tensors[f"{n}.bias"]) for n in names], activation, squash, **kwargs)
