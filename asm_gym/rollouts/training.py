"""Train one agent with stable-baselines3's SAC: clone an expert, warm up the critic, learn, evaluate, keep the best.

    cloning    L = mean (tanh μ(o) - a)²   over the expert's steps (Pomerleau 1991)

Critics have layer normalisation, without which their values explode on actions that no demonstration shows (Ball et al.
2023, RLPD). The actor learns more slowly than they do, and an update of cloning follows each rollout, so that cloned
behaviour is improved and not forgotten.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from asm_gym.episode import Episode
from asm_gym.policies import rollout
from asm_gym.policies.network import NetworkPolicy, describe
from asm_gym.policies.sb3 import network
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.seeds import episode_seeds

ACTOR_SHARE = 0.05
"""The actor's learning rate, as a share of the critic's."""
ENTROPY = -3.0
"""Target entropy per number of the action: a third of the usual spread, or learned grasps are shaken off."""
BATCH, LOG_STD, CLONING_RATE, ANCHOR_RATE = 256, -3.5, 1e-3, 3e-4
"""Of cloning: batch size; the actor's log standard deviation before tanh; learning rates before and while it learns."""
CRITIC_UPDATES = 2000
"""Updates of the critic alone, between cloning and learning."""
BEST, CLONE = "best.npz", "clone.npz"
"""Files of the best agent of the evaluations, and of the agent before it learned from its own steps."""

Floats = NDArray[np.float32]
Curve = list[tuple[int, float]]
"""(control steps, share of successes) of each evaluation."""


@dataclass(frozen=True)
class Plan:
    """What is trained where, and how long; the names are those of ``asm-gym train``'s options."""

    env_id: str
    settings: dict[str, Any]
    steps: int
    cloning_updates: int
    evaluate_every: int
    evaluation_episodes: int
    seed: int

    def make(self) -> gym.Env[Any, Any]:
        """Make the environment."""
        return gym.make(self.env_id, **self.settings)


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
    """SAC with a slow actor, whose replay buffer holds the actions that a safety wrapper executed."""

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
        policy_kwargs={"net_arch": [256, 256]},
        seed=seed,
        device="cpu",
    )


class Cloner(BaseCallback):
    """Move a learner's actor towards an expert's actions; as a callback, by one update after each rollout.

    Args:
        learner: SAC.
        observations: (N, O), as the learner sees them.
        actions: (N, A), as the environment takes them.
        seed: of the batches.
    """

    def __init__(self, learner: SAC, observations: Floats, actions: Floats, seed: int = 0) -> None:
        super().__init__()
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

    def _update(self, optimiser: torch.optim.Optimizer) -> float:
        drawn = torch.randint(len(self._actions), (BATCH,), generator=self._batches)
        mean = torch.tanh(self._actor.get_action_dist_params(self._observations[drawn])[0])
        loss = ((mean - self._actions[drawn]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        return float(loss.item())

    def _on_rollout_start(self) -> None:
        self._update(self._optimiser)

    def _on_step(self) -> bool:
        return True


class Evaluation(BaseCallback):
    """Evaluate the agent now and then, and keep the best one."""

    def __init__(self, plan: Plan, out: Path, mean: Floats, scale: Floats, progress: Progress) -> None:
        super().__init__()
        self._plan, self._out, self._mean, self._scale, self._progress = plan, out, mean, scale, progress
        self._env = plan.make()  # the learner's own must not be reset while it learns
        self.curve: Curve = []

    def _on_step(self) -> bool:
        self._progress(min(self.num_timesteps, self._plan.steps), self._plan.steps)
        if self.num_timesteps % self._plan.evaluate_every == 0 or self.num_timesteps == self._plan.steps:
            self.logger.record("eval/success", self.evaluate(self.model))
            self.logger.dump(self.num_timesteps)
        return True

    def evaluate(self, learner: Any) -> float:
        """Return the agent's share of successes; save it as the clone, or where it is the best so far."""
        agent = export(learner, self._mean, self._scale, self._env)
        seeds = episode_seeds(self._plan.seed, self._plan.evaluation_episodes, stage=2)
        success, steps = success_rate(agent, self._env, seeds), learner.num_timesteps
        if not steps or success >= max((share for done, share in self.curve if done), default=0.0):
            agent.save(self._out / (BEST if steps else CLONE), steps=steps, success=success, episodes=len(seeds))
        self.curve.append((steps, success))
        return success

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def train(plan: Plan, out: Path, demonstrations: Sequence[Episode], progress: Progress) -> tuple[NetworkPolicy, Curve]:
    """Return the best agent of the evaluations, and their results.

    Raises:
        TypeError: spaces other than Boxes with one axis.
        ValueError: demonstrations of other sizes.
    """
    with closing(plan.make()) as env:
        check_sizes(env, demonstrations)
        observations = np.concatenate([e.observations[:-1] for e in demonstrations])  # (N, O)
        actions = np.concatenate([e.actions for e in demonstrations])  # (N, A)
        mean, scale = standard_of(observations)
        learner = make_learner(Monitor(standardised(env, mean, scale)), plan.seed)
        formats = ["csv"] + ["tensorboard"] * (importlib.util.find_spec("tensorboard") is not None)
        learner.set_logger(configure(str(out / "log"), formats))
        cloner = Cloner(learner, ((observations - mean) / scale).astype(np.float32), actions, plan.seed)
        cloner.clone(plan.cloning_updates, progress)
        with closing(Evaluation(plan, out, mean, scale, progress)) as evaluation:
            evaluation.evaluate(learner)
            if plan.steps:
                fill_buffer(learner, demonstrations, mean, scale)
                warm_critic(learner, min(CRITIC_UPDATES, plan.cloning_updates))
                learner.learn(plan.steps, callback=[evaluation, cloner])
            return NetworkPolicy.load(out / (BEST if plan.steps else CLONE)), evaluation.curve


def check_sizes(env: gym.Env[Any, Any], demonstrations: Sequence[Episode]) -> None:
    """Raise TypeError or ValueError where the learner cannot learn from these demonstrations."""
    for name, space in (("observations", env.observation_space), ("actions", env.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(f"an agent is trained where {name} are a Box with one axis, got {space}")
        for n, episode in enumerate(demonstrations):
            size = getattr(episode, name).shape[1]
            if size != space.shape[0]:
                raise ValueError(f"demonstration {n} has {name} of {size} numbers, the environment {space.shape[0]}")


def standard_of(observations: Floats) -> tuple[Floats, Floats]:
    """Return (O,) mean and scale of (N, O) observations; the scale of a constant number is 1."""
    spread = observations.std(axis=0)
    return observations.mean(axis=0), np.where(spread > 1e-3, spread, 1.0).astype(np.float32)


def standardised(env: gym.Env[Any, Any], mean: Floats, scale: Floats) -> gym.Env[Any, Any]:
    """Return the environment with standardised observations, as the learner sees it."""
    box = gym.spaces.Box(-np.inf, np.inf, mean.shape, np.float32)
    return TransformObservation(env, lambda o: ((o - mean) / scale).astype(np.float32), box)


def scaled_actions(learner: SAC, actions: Floats) -> Floats:
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


def warm_critic(learner: SAC, updates: int) -> None:
    """Teach the critic the value of the actor, while the actor stays as it is."""
    learner.actor.requires_grad_(False)
    learner.train(updates, learner.batch_size)
    learner.actor.requires_grad_(True)


def export(learner: SAC, mean: Floats, scale: Floats, env: gym.Env[Any, Any]) -> NetworkPolicy:
    """Return the learner's policy for unstandardised observations, without its noise, to act in ``env``."""
    with torch.no_grad():
        tensors = {name: tensor.cpu().numpy().copy() for name, tensor in learner.policy.state_dict().items()}
    made = network("SAC", tensors, "relu", mean=mean, scale=scale, trained_in=describe(env))
    return made.fit_to(env, "the agent")


def success_rate(agent: NetworkPolicy, env: gym.Env[Any, Any], seeds: Sequence[int]) -> float:
    """Return the share of successes over one episode from each seed."""
    return float(np.mean([rollout(env, agent, seed) for seed in seeds]))
