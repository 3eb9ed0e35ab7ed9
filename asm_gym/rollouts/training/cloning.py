"""Behaviour cloning: an actor is brought near to what an expert does, and kept there while it learns.

L = mean (tanh μ(o) - a)²   over the expert's steps (Pomerleau 1991); a, not tanh μ, for PPO
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.sac.sac import SAC
from stable_baselines3.td3.td3 import TD3
from torch.nn import Parameter

from asm_gym.episode import Episode
from asm_gym.rollouts.parallel import Progress

BATCH = 256
LOG_STD = -3.5
"""Of a cloned SAC actor before tanh: it explores near to what the expert does."""


class Cloner:
    """Moves a learner's actor towards an expert's actions.

    Args:
        learner: SAC, TD3 or PPO.
        observations: (N, O), as the learner sees them.
        actions: (N, A), as the environment takes them.
        learning_rate: of the updates while learning; cloning itself begins at 1e-3.
        seed: of the batches.

    Attributes:
        draw: what batches are drawn with.
        optimiser: of the updates while learning.
    """

    def __init__(
        self,
        learner: BaseAlgorithm,
        observations: NDArray[np.float32],
        actions: NDArray[np.float32],
        learning_rate: float = 3e-4,
        seed: int = 0,
    ) -> None:
        if len(observations) != len(actions) or not len(actions):
            raise ValueError(f"every action needs its observation, got {len(observations)} and {len(actions)}")
        self._learner: Any = learner
        self._observations, self._actions = torch.as_tensor(observations), torch.as_tensor(as_kept(learner, actions))
        self.draw = torch.Generator().manual_seed(seed)
        self.optimiser = torch.optim.Adam(list(self._parameters()), lr=learning_rate)

    def clone(self, updates: int, progress: Progress = lambda done, total: None) -> float:
        """From scratch; returns the mean squared error of the last hundred updates."""
        if isinstance(self._learner, SAC):
            head: Any = self._learner.actor.log_std
            with torch.no_grad():
                head.weight.zero_()
                head.bias.fill_(LOG_STD)
        optimiser = torch.optim.Adam(list(self._parameters()), lr=1e-3)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
        errors = []
        for n in range(updates):
            errors.append(self._update(optimiser))
            decay.step()
            if n % 100 == 99:
                progress(n + 1, updates)
        if isinstance(self._learner, TD3):
            self._learner.actor_target.load_state_dict(self._learner.actor.state_dict())
        return float(np.mean(errors[-100:]))

    def anchor(self, updates: int) -> None:
        """A few more updates, while the actor learns."""
        for _ in range(updates):
            self._update(self.optimiser)

    def _update(self, optimiser: torch.optim.Optimizer) -> float:
        drawn = torch.randint(len(self._actions), (BATCH,), generator=self.draw)
        loss = ((self._mean(self._observations[drawn]) - self._actions[drawn]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        return float(loss.item())

    def _mean(self, observations: torch.Tensor) -> torch.Tensor:
        learner = self._learner
        mean: torch.Tensor
        if isinstance(learner, SAC):
            mean = torch.tanh(learner.actor.get_action_dist_params(observations)[0])
        elif isinstance(learner, TD3):
            mean = learner.actor(observations)
        else:
            mean = learner.policy.get_distribution(observations).distribution.mean
        return mean

    def _parameters(self) -> Iterator[Parameter]:
        """Those that decide over the mean action."""
        learner = self._learner
        if isinstance(learner, OffPolicyAlgorithm):
            actor: Any = learner.policy.actor
            yield from (p for name, p in actor.named_parameters() if "log_std" not in name)
        else:
            yield from learner.policy.mlp_extractor.policy_net.parameters()
            yield from learner.policy.action_net.parameters()


class Anchor(BaseCallback):
    """Keeps an actor near its expert: a few cloning updates whenever new steps are gathered."""

    def __init__(self, cloner: Cloner, updates: int) -> None:
        super().__init__()
        self._cloner, self._updates = cloner, updates

    def _on_rollout_start(self) -> None:
        self._cloner.anchor(self._updates)

    def _on_step(self) -> bool:
        return True


def steps_of(episodes: Sequence[Episode]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N, O) observations and (N, A) actions of whole episodes, one after the other."""
    return np.concatenate([e.observations[:-1] for e in episodes]), np.concatenate([e.actions for e in episodes])


def as_kept(learner: BaseAlgorithm, actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, A) actions within their bounds; off-policy learners keep them scaled to [-1, 1]."""
    space: Any = learner.action_space
    within = np.clip(actions, space.low, space.high)
    kept = learner.policy.scale_action(within) if isinstance(learner, OffPolicyAlgorithm) else within
    return np.asarray(kept, np.float32)


def fill_buffer(learner: OffPolicyAlgorithm, episodes: Sequence[Episode], mean: Any, scale: Any) -> None:
    """Puts episodes into a learner's replay buffer, standardised as its own are."""
    assert learner.replay_buffer is not None
    for episode in episodes:
        seen = ((episode.observations - mean) / scale).astype(np.float32)
        actions = as_kept(learner, episode.actions)
        for t, reward in enumerate(episode.rewards):
            last = t == len(episode.rewards) - 1
            # What was merely cut short is worth what would have followed.
            info: dict[str, Any] = {"TimeLimit.truncated": last and not episode.info.get("terminated", False)}
            row = seen[t][None], seen[t + 1][None], actions[t][None], np.array([reward]), np.array([last])
            learner.replay_buffer.add(*row, [info])
