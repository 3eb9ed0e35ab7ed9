"""SAC of stable-baselines3, set up to learn manipulation in minutes from demonstrations.

Critics have layer normalisation, without which their values explode on actions that no demonstration shows (Ball et al.
2023, RLPD), and the actor moves more slowly than they do, so that cloned behaviour is improved and not forgotten.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from asm_gym.policies.network import NetworkPolicy, describe
from asm_gym.policies.sb3 import network

HIDDEN = (256, 256)
ACTOR_SHARE = 0.05
"""The actor's learning rate, as a share of the critic's."""
ENTROPY = -3.0
"""Target entropy per number of the action: a third of the usual spread, or learned grasps are shaken off."""


class NormalisedCritic(SACPolicy):
    """SAC's policy, with critics that have layer normalisation after each hidden layer."""

    def make_critic(self, features_extractor: Any = None) -> Any:
        """Make the critics."""
        critic: Any = super().make_critic(features_extractor)
        for n, q in enumerate(critic.q_networks):
            layers: list[nn.Module] = []
            for layer in q:
                layers.append(layer)
                if isinstance(layer, nn.Linear) and layer.out_features > 1:
                    layers.append(nn.LayerNorm(layer.out_features))
            critic.q_networks[n] = nn.Sequential(*layers)
            critic.add_module(f"qf{n}", critic.q_networks[n])
        return critic


class GuardedSAC(SAC):
    """SAC with a slow actor, whose replay buffer holds the executed actions.

    Where a safety wrapper reports the executed action, the transition with it is true of the environment without the
    wrapper, whoever chose the action.
    """

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        for group in self.actor.optimizer.param_groups:
            group["lr"] *= ACTOR_SHARE

    def _store_transition(self, buffer: Any, action: Any, seen: Any, reward: Any, dones: Any, infos: Any) -> None:
        executed = [info.get("asm", {}).get("executed_action") for info in infos]
        scale = self.policy.scale_action
        kept = np.array([own if other is None else scale(other) for own, other in zip(action, executed, strict=True)])
        super()._store_transition(buffer, kept, seen, reward, dones, infos)


def make_learner(env: gym.Env[Any, Any], seed: int) -> GuardedSAC:
    """Return a learner whose actor is going to be cloned."""
    return GuardedSAC(
        NormalisedCritic,
        env,
        learning_rate=3e-4,
        buffer_size=300_000,
        batch_size=256,
        gamma=0.98,
        learning_starts=0,
        ent_coef="auto_0.005",
        target_entropy=ENTROPY * float(np.prod(env.action_space.shape or ())),
        policy_kwargs={"net_arch": list(HIDDEN)},
        seed=seed,
        device="cpu",
    )


def warm_critic(learner: SAC, updates: int) -> None:
    """Teach the critic the value of the actor, while the actor stays as it is."""
    learner.actor.requires_grad_(False)
    learner.train(updates, learner.batch_size)
    learner.actor.requires_grad_(True)


def export(
    learner: SAC, mean: NDArray[np.float32], scale: NDArray[np.float32], env: gym.Env[Any, Any]
) -> NetworkPolicy:
    """Return the learner's policy for unstandardised observations, without its noise.

    Args:
        learner: trained.
        mean, scale: (O,) that standardised the learner's observations.
        env: that the agent is to act in.
    """
    with torch.no_grad():
        tensors = {name: tensor.cpu().numpy().copy() for name, tensor in learner.policy.state_dict().items()}
    made = network("SAC", tensors, "relu", mean=mean, scale=scale, trained_in=describe(env))
    return made.fit_to(env, "the agent")
