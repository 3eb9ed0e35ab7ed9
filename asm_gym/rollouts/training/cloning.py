"""Behaviour cloning: fit SAC's actor to an expert's actions, and keep it near them while it learns.

L = mean (tanh μ(o) - a)²   over the expert's steps (Pomerleau 1991)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.episode import Episode
from asm_gym.rollouts.parallel import Progress

BATCH = 256
LOG_STD = -3.5
"""Log standard deviation of a cloned actor before tanh: it explores near the expert."""
CLONING_RATE, ANCHOR_RATE = 1e-3, 3e-4
"""Learning rates of cloning, and of the updates while the actor learns."""


class Cloner:
    """Move a learner's actor towards an expert's actions.

    Args:
        learner: SAC.
        observations: (N, O), as the learner sees them.
        actions: (N, A), as the environment takes them.
        seed: of the batches.
    """

    def __init__(
        self, learner: SAC, observations: NDArray[np.float32], actions: NDArray[np.float32], seed: int = 0
    ) -> None:
        if len(observations) != len(actions) or not len(actions):
            raise ValueError(f"every action needs its observation, got {len(observations)} and {len(actions)}")
        self._actor = learner.actor
        self._observations = torch.as_tensor(observations)
        self._actions = torch.as_tensor(scaled_actions(learner, actions))
        self._batches = torch.Generator().manual_seed(seed)
        self._mean = [p for name, p in self._actor.named_parameters() if "log_std" not in name]
        self._optimiser = torch.optim.Adam(self._mean, lr=ANCHOR_RATE)

    def clone(self, updates: int, progress: Progress = lambda done, total: None) -> float:
        """Fit from scratch; return the mean squared error of the last hundred updates."""
        head: Any = self._actor.log_std
        with torch.no_grad():
            head.weight.zero_()
            head.bias.fill_(LOG_STD)
        optimiser = torch.optim.Adam(self._mean, lr=CLONING_RATE)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
        errors = []
        for n in range(updates):
            errors.append(self._update(optimiser))
            decay.step()
            if n % 100 == 99:
                progress(n + 1, updates)
        return float(np.mean(errors[-100:]))

    def anchor(self) -> None:
        """Make one more update, while the actor learns."""
        self._update(self._optimiser)

    def _update(self, optimiser: torch.optim.Optimizer) -> float:
        drawn = torch.randint(len(self._actions), (BATCH,), generator=self._batches)
        mean = torch.tanh(self._actor.get_action_dist_params(self._observations[drawn])[0])
        loss = ((mean - self._actions[drawn]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        return float(loss.item())


class Anchor(BaseCallback):
    """Keep an actor near its expert: a cloning update whenever new steps are gathered."""

    def __init__(self, cloner: Cloner) -> None:
        super().__init__()
        self._cloner = cloner

    def _on_rollout_start(self) -> None:
        self._cloner.anchor()

    def _on_step(self) -> bool:
        return True


def steps_of(episodes: Sequence[Episode]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (N, O) observations and (N, A) actions of whole episodes, one after the other."""
    return np.concatenate([e.observations[:-1] for e in episodes]), np.concatenate([e.actions for e in episodes])


def scaled_actions(learner: SAC, actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, A) actions within their bounds, scaled to [-1, 1]."""
    space: Any = learner.action_space
    return np.asarray(learner.policy.scale_action(np.clip(actions, space.low, space.high)), np.float32)


def fill_buffer(learner: SAC, episodes: Sequence[Episode], mean: Any, scale: Any) -> None:
    """Add episodes to a learner's replay buffer, standardised as its own are."""
    assert learner.replay_buffer is not None
    for episode in episodes:
        seen = ((episode.observations - mean) / scale).astype(np.float32)
        actions = scaled_actions(learner, episode.actions)
        for t, reward in enumerate(episode.rewards):
            last = t == len(episode.rewards) - 1
            info: dict[str, Any] = {"TimeLimit.truncated": last and not episode.info.get("terminated", False)}
            row = seen[t][None], seen[t + 1][None], actions[t][None], np.array([reward]), np.array([last])
            learner.replay_buffer.add(*row, [info])
