"""Train one agent: clone an expert, warm up the critic, learn, evaluate now and then, and keep the best."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformObservation
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

from asm_gym.episode import Episode
from asm_gym.policies import rollout
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.cloning import Anchor, Cloner, fill_buffer, steps_of
from asm_gym.rollouts.training.learners import export, make_learner, warm_critic

BEST, CLONE = "best.npz", "clone.npz"
"""Files of the best agent of the evaluations, and of the agent before it learned from its own steps."""
CRITIC_UPDATES = 2000
"""Updates of the critic alone, between cloning and learning."""

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


class Evaluation(BaseCallback):
    """Judge the agent now and then, and keep the best one."""

    def __init__(
        self, plan: Plan, out: Path, mean: NDArray[np.float32], scale: NDArray[np.float32], tick: Progress
    ) -> None:
        super().__init__()
        self._plan, self._out, self._mean, self._scale, self._tick = plan, out, mean, scale, tick
        self._env = plan.make()  # the learner's own must not be reset while it learns
        self.curve: Curve = []

    def _on_step(self) -> bool:
        self._tick(min(self.num_timesteps, self._plan.steps), self._plan.steps)
        if self.num_timesteps % self._plan.evaluate_every == 0 or self.num_timesteps == self._plan.steps:
            self.logger.record("eval/success", self.evaluate(self.model))
            self.logger.dump(self.num_timesteps)
        return True

    def evaluate(self, learner: Any) -> float:
        """Return the share of successes of the agent; it is saved as the clone, or where it is the best so far."""
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


def train(plan: Plan, out: Path, demonstrations: Sequence[Episode], tick: Progress) -> tuple[NetworkPolicy, Curve]:
    """Return the best agent of the evaluations, and their results.

    Args:
        plan: what to train.
        out: folder of the agents and the log.
        demonstrations: successful episodes of an expert.
        tick: progress.

    Raises:
        TypeError: spaces other than Boxes with one axis.
        ValueError: demonstrations of other sizes.
    """
    with closing(plan.make()) as env:
        check_sizes(env, demonstrations)
        observations, actions = steps_of(demonstrations)
        mean, scale = standard_of(observations)
        learner = make_learner(Monitor(standardised(env, mean, scale)), plan.seed)
        formats = ["csv"] + ["tensorboard"] * (importlib.util.find_spec("tensorboard") is not None)
        learner.set_logger(configure(str(out / "log"), formats))
        cloner = Cloner(learner, ((observations - mean) / scale).astype(np.float32), actions, plan.seed)
        cloner.clone(plan.cloning_updates, tick)
        with closing(Evaluation(plan, out, mean, scale, tick)) as evaluation:
            evaluation.evaluate(learner)
            if plan.steps:
                _improve(learner, plan, demonstrations, (mean, scale), [evaluation, Anchor(cloner)])
            return NetworkPolicy.load(out / (BEST if plan.steps else CLONE)), evaluation.curve


def _improve(
    learner: SAC, plan: Plan, demonstrations: Sequence[Episode], standard: tuple[Any, Any], callbacks: list[Any]
) -> None:
    fill_buffer(learner, demonstrations, *standard)
    warm_critic(learner, min(CRITIC_UPDATES, plan.cloning_updates))
    learner.learn(plan.steps, callback=callbacks)


def success_rate(agent: NetworkPolicy, env: gym.Env[Any, Any], seeds: Sequence[int]) -> float:
    """Return the share of successes over one episode from each seed."""
    return float(np.mean([rollout(env, agent, seed) for seed in seeds]))


def standard_of(observations: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (O,) mean and scale of (N, O) observations; the scale of a constant number is 1."""
    spread = observations.std(axis=0)
    return observations.mean(axis=0), np.where(spread > 1e-3, spread, 1.0).astype(np.float32)


def standardised(env: gym.Env[Any, Any], mean: NDArray[np.float32], scale: NDArray[np.float32]) -> gym.Env[Any, Any]:
    """Return the environment with standardised observations, as the learner sees it."""
    box = gym.spaces.Box(-np.inf, np.inf, mean.shape, np.float32)
    return TransformObservation(env, lambda o: ((o - mean) / scale).astype(np.float32), box)


def check_sizes(env: gym.Env[Any, Any], demonstrations: Sequence[Episode]) -> None:
    """Raise TypeError or ValueError where there is nothing that the learner can learn."""
    for name, space in (("observations", env.observation_space), ("actions", env.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(f"an agent is trained where {name} are a Box with one axis, got {space}")
        for n, episode in enumerate(demonstrations):
            size = getattr(episode, name).shape[1]
            if size != space.shape[0]:
                raise ValueError(f"demonstration {n} has {name} of {size} numbers, the environment {space.shape[0]}")
