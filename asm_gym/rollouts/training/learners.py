"""Stable-baselines3's learners, with what makes them learn manipulation in minutes from demonstrations.

Critics have layer normalisation, without which their values explode on actions that no demonstration shows (Ball et al.
2023, RLPD), and the actor moves more slowly than they do, so that cloned behaviour is improved and not forgotten.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from asm_gym.policies.network import NetworkPolicy, describe
from asm_gym.policies.sb3 import network
from asm_gym.validation import check_choice

ALGORITHMS = ("sac", "td3", "ppo")
HIDDEN = (256, 256)


@dataclass(frozen=True)
class Recipe:
    """How an algorithm learns.

    Args:
        settings: of the constructor in stable-baselines3.
        actor_share: the actor's learning rate, as a share of the critic's, once it has been cloned.
        anchor: cloning updates each time the learner has gathered new steps.
        critic_updates: of the critic alone, between cloning and learning.
    """

    settings: dict[str, Any]
    actor_share: float = 1.0
    anchor: int = 0
    critic_updates: int = 0


_OFF_POLICY: dict[str, Any] = {
    "learning_rate": 3e-4,
    "buffer_size": 300_000,
    "batch_size": 256,
    "gamma": 0.98,
    "learning_starts": 1000,
}
RECIPES = {
    "sac": Recipe(_OFF_POLICY, 0.05, 1, 2000),
    "td3": Recipe({**_OFF_POLICY, "policy_delay": 2}, 0.05, 1, 2000),
    "ppo": Recipe(
        {"learning_rate": 1e-4, "n_steps": 2000, "batch_size": 200, "gamma": 0.98, "n_epochs": 5}, 1.0, 50, 0
    ),
}
"""By algorithm."""


class _NormalisedCritic:
    """A policy whose critics have layer normalisation after each hidden layer."""

    def make_critic(self, features_extractor: Any = None) -> Any:
        critic = super().make_critic(features_extractor)  # type: ignore[misc]
        for n, q in enumerate(critic.q_networks):
            layers: list[nn.Module] = []
            for layer in q:
                layers.append(layer)
                if isinstance(layer, nn.Linear) and layer.out_features > 1:
                    layers.append(nn.LayerNorm(layer.out_features))
            critic.q_networks[n] = nn.Sequential(*layers)
            critic.add_module(f"qf{n}", critic.q_networks[n])
        return critic


class _SACPolicy(_NormalisedCritic, SACPolicy):
    pass


class _TD3Policy(_NormalisedCritic, TD3Policy):
    pass


class _SlowActor:
    """A learner whose actor has a learning rate of its own."""

    actor_share = 1.0

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)  # type: ignore[misc]
        for group in self.actor.optimizer.param_groups:  # type: ignore[attr-defined]
            group["lr"] *= self.actor_share


class _KeepsExecuted:
    """A learner whose buffer keeps the action that was executed, where a safety wrapper says which.

    Of the environment without the wrapper that is the truth, whoever chose the action.
    """

    def _store_transition(self, buffer: Any, action: Any, seen: Any, reward: Any, dones: Any, infos: Any) -> None:
        done = [info.get("asm", {}).get("executed_action") for info in infos]
        scale = self.policy.scale_action  # type: ignore[attr-defined]
        kept = np.array([own if other is None else scale(other) for own, other in zip(action, done, strict=True)])
        super()._store_transition(buffer, kept, seen, reward, dones, infos)  # type: ignore[misc]


class _SAC(_KeepsExecuted, _SlowActor, SAC):
    pass


class _TD3(_KeepsExecuted, _SlowActor, TD3):
    pass


def make_learner(algorithm: str, env: gym.Env[Any, Any], seed: int, cloned: bool, steps: int) -> BaseAlgorithm:
    """A learner with the settings of its recipe.

    Args:
        cloned: its actor is going to be cloned, and is then moved slowly; without, it explores at random at first.
        steps: that it will gather; PPO gathers no more than these at once.

    Raises:
        ValueError: an unknown algorithm.
    """
    check_choice("algorithm", algorithm, ALGORITHMS)
    recipe = RECIPES[algorithm]
    settings = {**recipe.settings, "seed": seed, "device": "cpu"}
    if algorithm == "ppo":
        # Little noise at first: a cloned gripper that flutters drops things.
        kwargs = {"net_arch": list(HIDDEN), "activation_fn": nn.ReLU, "log_std_init": -2.0 if cloned else -0.5}
        settings["n_steps"] = max(2, min(settings["n_steps"], steps))
        settings["batch_size"] = min(settings["batch_size"], settings["n_steps"])
        return PPO("MlpPolicy", env, policy_kwargs=kwargs, **settings)
    if cloned:
        settings["learning_starts"] = 0
        if algorithm == "sac":
            # A third of the usual spread for each number of the action, or grasps that were learned are shaken off.
            entropy = -3.0 * float(np.prod(env.action_space.shape or ()))
            settings |= {"ent_coef": "auto_0.005", "target_entropy": entropy}
    kwargs = {"net_arch": list(HIDDEN)}
    learner: _SAC | _TD3
    if algorithm == "sac":
        learner = _SAC(_SACPolicy, env, policy_kwargs=kwargs, **settings)
    else:
        learner = _TD3(_TD3Policy, env, policy_kwargs=kwargs, action_noise=_noise(env), **settings)
    learner.actor_share = recipe.actor_share if cloned else 1.0
    return learner


def _noise(env: gym.Env[Any, Any]) -> Any:
    from stable_baselines3.common.noise import NormalActionNoise

    size = int(np.prod(env.action_space.shape or ()))
    return NormalActionNoise(np.zeros(size), np.full(size, 0.1))


def warm_critic(learner: BaseAlgorithm, updates: int) -> None:
    """Teaches an off-policy learner's critic what the actor is worth, while the actor stays as it is."""
    if not isinstance(learner, OffPolicyAlgorithm) or not updates:
        return
    actor: Any = learner.policy.actor
    actor.requires_grad_(False)
    learner.train(updates, learner.batch_size)
    actor.requires_grad_(True)


def export(
    learner: BaseAlgorithm,
    algorithm: str,
    mean: NDArray[np.float32],
    scale: NDArray[np.float32],
    env: gym.Env[Any, Any],
) -> NetworkPolicy:
    """The learner's policy for unstandardised observations, without its noise.

    Args:
        mean, scale: (O,) what the learner's observations were standardised by.
        env: that it is to act in.
    """
    with torch.no_grad():
        tensors = {name: tensor.cpu().numpy().copy() for name, tensor in learner.policy.state_dict().items()}
    made = network(algorithm.upper(), tensors, "relu", mean=mean, scale=scale, trained_in=describe(env))
    return made.fit_to(env, "the agent")
