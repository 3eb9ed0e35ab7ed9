"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym

from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold
from asm_gym.policies.scripted.door import DoorExpert
from asm_gym.policies.scripted.lift import LiftExpert
from asm_gym.policies.scripted.nut_assembly import NutAssemblyExpert
from asm_gym.policies.scripted.peg_in_hole import PegInHoleExpert
from asm_gym.policies.scripted.pick_place import PickPlaceExpert
from asm_gym.policies.scripted.stack import StackExpert
from asm_gym.policies.scripted.two_arm_lift import TwoArmLiftExpert
from asm_gym.policies.scripted.wipe import WipeExpert

EXPERTS: dict[str, Callable[..., Policy]] = {
    "Lift": LiftExpert,
    "Stack": StackExpert,
    "Door": DoorExpert,
    "Wipe": WipeExpert,
    "TwoArmLift": TwoArmLiftExpert,
    "TwoArmPegInHole": PegInHoleExpert,
    **{f"NutAssembly{which}": NutAssemblyExpert for which in ("", "Single", "Square", "Round")},
    **{f"PickPlace{which}": PickPlaceExpert for which in ("", "Single", "Can", "Milk", "Bread", "Cereal")},
}
"""The scripted expert of each task."""

POLICIES = ("scripted", "hold")
"""Names that ``make_policy`` knows, besides the path of a stable-baselines3 agent."""


def make_policy(name: str, env: gym.Env[Any, Any], seed: int | None = None, **kwargs: Any) -> Policy:
    """The policy called ``name`` for ``env``.

    Args:
        name: ``"scripted"`` (the task's expert), ``"hold"`` (stay where you are), or the path of an agent saved by
            stable-baselines3, such as ``"lift_sac.zip"``; its file name must contain the algorithm's name.
        seed: of whatever the policy draws.
        kwargs: handed to the expert, for example ``style=Style(noise=0.1)``.

    Raises:
        ValueError: an unknown name, or a task without an expert; the message lists what exists.
        FileNotFoundError: there is no such agent.
    """
    if name == "scripted":
        task = getattr(env.unwrapped, "task", None)
        if task is None or task.name not in EXPERTS:
            raise ValueError(f"no scripted expert for {task.name if task else env}; there are: {', '.join(EXPERTS)}")
        return EXPERTS[task.name](env, seed=seed, **kwargs)
    if name == "hold":
        return Hold(env)
    if name.endswith(".zip"):
        return _agent(Path(name), env)
    raise ValueError(f"unknown policy {name!r}; known: {', '.join(POLICIES)}, or the path of an agent (.zip)")


def _agent(path: Path, env: gym.Env[Any, Any]) -> Policy:
    if not path.is_file():
        raise FileNotFoundError(f"no agent at {path}")
    import stable_baselines3

    for algorithm in ("SAC", "PPO", "TD3", "A2C", "DDPG"):
        if algorithm.lower() in path.stem.lower():
            model: Policy = getattr(stable_baselines3, algorithm).load(path, env=env, device="cpu")
            return model
    raise ValueError(f"the file name must say the algorithm (sac, ppo, td3, a2c or ddpg), got {path.name!r}")
