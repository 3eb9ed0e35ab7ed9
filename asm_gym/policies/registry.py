"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym

from asm_gym.policies.hold import Hold
from asm_gym.policies.network import NetworkPolicy
from asm_gym.policies.policy import Policy
from asm_gym.policies.scripted.door import DoorExpert
from asm_gym.policies.scripted.lift import LiftExpert
from asm_gym.policies.scripted.nut_assembly import NutAssemblyExpert
from asm_gym.policies.scripted.pick_place import PickPlaceExpert
from asm_gym.policies.scripted.stack import StackExpert
from asm_gym.policies.scripted.sway import Swaying, SyntheticArmExpert
from asm_gym.policies.scripted.wipe import WipeExpert
from asm_gym.registries import Registry, target
from asm_gym.tasks import TaskSpec
from asm_gym.validation import check_choice, typed

# The scripted expert of each task.
EXPERTS: dict[str, Callable[..., Policy]] = {
    "Lift": LiftExpert,
    "Stack": StackExpert,
    "Door": DoorExpert,
    "Wipe": WipeExpert,
    "NutAssembly": NutAssemblyExpert,
    "NutAssemblySingle": NutAssemblyExpert,
    "NutAssemblySquare": NutAssemblyExpert,
    "NutAssemblyRound": NutAssemblyExpert,
    "PickPlace": PickPlaceExpert,
    "PickPlaceSingle": PickPlaceExpert,
    "PickPlaceCan": PickPlaceExpert,
    "PickPlaceMilk": PickPlaceExpert,
    "PickPlaceBread": PickPlaceExpert,
    "PickPlaceCereal": PickPlaceExpert,
}


def scripted(env: gym.Env[Any, Any], seed: int | None = None, **kwargs: Any) -> Policy:
    """Return the expert of an environment's task; raise ValueError where there is none."""
    experts = EXPERTS | {"asm_gym/SyntheticArm-v0": SyntheticArmExpert}
    task = getattr(env.unwrapped, "task", None)
    name = ""
    if isinstance(task, TaskSpec):
        name = task.name
    elif env.spec is not None:
        name = env.spec.id
    if name not in experts:
        raise ValueError(
            f"{name or env} has no scripted expert, use 'sway'; these have one: "
            f"{', '.join(experts)}"
        )
    return experts[name](env, seed=seed, **kwargs)


# Policies besides agents, by name.
POLICIES: Registry[Callable[..., Policy]] = Registry(
    "policy",
    "asm_gym.policies.registry:POLICIES",
    {"scripted": scripted, "hold": lambda env, seed=None: Hold(env), "sway": Swaying},
)

# Algorithms of stable-baselines3 whose archives ``make_policy`` loads.
ALGORITHMS = ("SAC", "TD3", "DDPG", "PPO", "A2C")

SHIPPED = Path(__file__).resolve().parent / "agents"  # trained agents that come with the package


def register_policy(name: str, make: Callable[..., Policy] | str) -> None:
    """Register a policy, in this process and its workers; raise ValueError if the name is taken.

    Args:
        name: for ``make_policy`` and ``--policy``.
        make: called as ``make(env, seed=seed)`` with further arguments of ``make_policy``; or its ``module:name``.

    Example:
        >>> from asm_gym import make_policy, register_policy
        >>> register_policy("waving", lambda env, seed=None: make_policy("sway", env, seed=seed))
    """
    if name in agents():
        raise ValueError(f"there is a policy {name!r} already")
    POLICIES.register(name, target(make))


def agents() -> tuple[str, ...]:
    """Return the names of the agents that come with the package."""
    return tuple(sorted(file.stem for file in SHIPPED.glob("*.npz")))


def trained_in(name: str) -> str:
    """Return the id of the environment that an agent, by name or path, was trained in; empty where it does not say."""
    return str(NetworkPolicy.load(_agent_file(name)).trained_in.get("env", ""))


def _agent_file(name: str) -> Path:
    """Return the file of an agent, by name or path."""
    if name in agents():
        return SHIPPED / f"{name}.npz"
    return Path(name)


@typed
def make_policy(
    name: str, env: gym.Env[Any, Any], seed: int | None = None, **kwargs: Any
) -> Policy:
    """Return a policy by name.

    Args:
        name: ``"scripted"`` (the expert of the task), ``"hold"`` (stay in place), ``"sway"`` (smooth motion in any
            environment with Box actions), a shipped agent such as ``"lift_sac"``, or the path of an agent: ``.npz`` of
            ``asm-gym train``, ``.asm`` of a Neural ASM that learned to act, or an archive of stable-baselines3 with
            its algorithm, ``"SAC:model.zip"``. Such an archive can run code: load only your own.
        env: the environment that the policy acts in.
        seed: of the random draws of the policy.
        kwargs: further arguments of the expert, for example ``style=Style(noise=0.1)``.

    Raises:
        ValueError: an unknown name, a task without an expert, or an agent that was trained in another environment.
        FileNotFoundError: no file at the path of an agent.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import make_policy
        >>> env = gym.make("asm_gym/SyntheticArm-v0")
        >>> policy = make_policy("sway", env, seed=0)
        >>> observation, info = env.reset(seed=0)
        >>> action, state = policy.predict(observation)
        >>> env.action_space.contains(action)
        True
    """
    if name in POLICIES:
        return POLICIES[name](env, seed=seed, **kwargs)
    # ``target`` imports what only some policies need.
    if name.endswith(".zip"):
        algorithm, _, file = name.partition(":")
        check_choice("algorithm", algorithm, ALGORITHMS)
        algorithm_class = target(f"stable_baselines3:{algorithm}")
        return cast(Policy, algorithm_class.load(file, env, device="cpu"))
    if name.endswith(".asm"):
        memory: Any = target("asm_gym.monitors:NeuralASM").load(name)
        policy_class = target("asm_gym.monitors.memory_policy:NeuralASMPolicy")
        return cast(Policy, policy_class(memory, env))
    if name.endswith(".npz") or name in agents():
        return NetworkPolicy.load(_agent_file(name)).fit_to(env, name)
    known = ", ".join((*POLICIES, *agents()))
    raise ValueError(
        f"unknown policy {name!r}; known: {known}, or the path of an agent (.npz, .asm, SAC:….zip)"
    )
