"""One training run: cloned, warmed up, learning, judged now and then; where it was killed it goes on.

It learns in stretches. Each begins with a new episode and generators seeded by how far the run is, and ends with a
checkpoint: what is learned in it follows from the checkpoint before it, whether or not the run was killed in between.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from asm_gym.episode import Episode
from asm_gym.policies import rollout
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.cloning import Anchor, Cloner, fill_buffer, steps_of
from asm_gym.rollouts.training.learners import RECIPES, export, make_learner, warm_critic
from asm_gym.rollouts.training.state import TrainingState, newest, resume, save

BEST, CLONE = "best.npz", "clone.npz"
"""The best agent of the evaluations, and what it was before it learned from its own steps."""


@dataclass(frozen=True)
class Plan:
    """What is trained where, and how long; the names are those of ``asm-gym train``'s options."""

    env_id: str
    settings: dict[str, Any]
    algorithm: str
    steps: int
    cloning_updates: int
    evaluate_every: int
    evaluation_episodes: int
    checkpoint_every: int
    seed: int

    def make(self) -> gym.Env[Any, Any]:
        return gym.make(self.env_id, **self.settings)


@dataclass(frozen=True)
class ObservationScale:
    """What observations are standardised by.

    Args:
        mean, scale: (O,).
    """

    mean: NDArray[np.float32]
    scale: NDArray[np.float32]

    @classmethod
    def of(cls, observations: NDArray[np.float32]) -> ObservationScale:
        """Of (N, O) observations; a number that never changes is left as it is."""
        spread = observations.std(axis=0)
        return cls(observations.mean(axis=0), np.where(spread > 1e-3, spread, 1.0).astype(np.float32))

    def around(self, env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        """The environment as the learner sees it."""
        assert env.observation_space.shape is not None
        box = gym.spaces.Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
        return TransformObservation(env, lambda o: ((o - self.mean) / self.scale).astype(np.float32), box)


class Evaluation(BaseCallback):
    """Judges the agent now and then, and keeps the best one."""

    def __init__(self, run: TrainingRun, tick: Progress) -> None:
        super().__init__()
        self._run, self._tick = run, tick

    def _on_step(self) -> bool:
        plan, steps = self._run.plan, self.num_timesteps
        self._tick(min(steps, plan.steps), plan.steps)
        if steps % plan.evaluate_every == 0:
            success = self._run.evaluate()
            self.logger.record("eval/success", success)
            self.logger.dump(steps)
        return True


class TrainingRun:
    """One training run: the learner, its environments, and the best agent so far.

    Args:
        plan: how.
        out: its folder.
        demonstrations: successful episodes of an expert; perhaps none.

    Raises:
        TypeError: spaces other than Boxes with one axis.
        ValueError: demonstrations of other sizes.
    """

    def __init__(self, plan: Plan, out: Path, demonstrations: Sequence[Episode]) -> None:
        self.plan, self.out, self.demonstrations = plan, out, demonstrations
        self.env = plan.make()
        _check(self.env, demonstrations)
        seen = steps_of(demonstrations)[0] if demonstrations else _wandered(self.env, plan.seed)
        self.standard = ObservationScale.of(seen)
        around = Monitor(self.standard.around(self.env))
        self.learner = make_learner(plan.algorithm, around, plan.seed, bool(demonstrations), plan.steps)
        self.state = TrainingState(0, -1.0, ())
        self.cloner: Cloner | None = None
        if demonstrations:
            observations, actions = steps_of(demonstrations)
            standard = (observations - self.standard.mean) / self.standard.scale
            self.cloner = Cloner(self.learner, standard.astype(np.float32), actions, seed=plan.seed)
        # The learner's environment must not be reset while it learns.
        self._judged = plan.make()

    def begin(self, tick: Progress) -> None:
        """Goes on from the newest checkpoint, or clones the expert."""
        folder = newest(self.out)
        if folder is not None:
            self.state = resume(folder, self.learner, self._anchor)
            return
        if self.cloner is None:
            self.evaluate()
            return
        recipe = RECIPES[self.plan.algorithm]
        self.cloner.clone(self.plan.cloning_updates, tick)
        self.evaluate()
        if isinstance(self.learner, OffPolicyAlgorithm):
            fill_buffer(self.learner, self.demonstrations, self.standard.mean, self.standard.scale)
            self.learner.set_logger(configure(None, []))
            warm_critic(self.learner, min(recipe.critic_updates, self.plan.cloning_updates) if self.plan.steps else 0)
        save(self.out, self.learner, self.state, self._anchor)

    @property
    def _anchor(self) -> torch.optim.Optimizer | None:
        return self.cloner.optimiser if self.cloner is not None else None

    def learn(self, tick: Progress) -> None:
        """The steps that are left, a checkpoint after each stretch; PPO ends one with the steps it gathers at once."""
        done, plan = self.learner.num_timesteps, self.plan
        if done >= plan.steps:
            return
        formats = ["csv"] + ["tensorboard"] * (importlib.util.find_spec("tensorboard") is not None)
        self.learner.set_logger(configure(str(self.out / "log" / f"from_{done}"), formats))
        callbacks: list[BaseCallback] = [Evaluation(self, tick)]
        recipe = RECIPES[self.plan.algorithm]
        if self.cloner is not None and recipe.anchor:
            callbacks.append(Anchor(self.cloner, recipe.anchor))
        while done < plan.steps:
            self._learn_on(min(plan.steps, (done // plan.checkpoint_every + 1) * plan.checkpoint_every), callbacks)
            done = self.learner.num_timesteps
            if done >= plan.steps and self.state.curve[-1][0] != done:
                self.evaluate()
            save(self.out, self.learner, self.state, self._anchor)

    def _learn_on(self, until: int, callbacks: list[BaseCallback]) -> None:
        """Learns until so many control steps are done, from a new episode on."""
        seed, around = self.plan.seed + self.learner.num_timesteps, self.learner.get_env()
        assert around is not None
        self.learner.set_env(around, force_reset=True)
        self.learner.set_random_seed(seed)
        if self.cloner is not None:
            self.cloner.draw.manual_seed(seed)
        self.learner.learn(until - self.learner.num_timesteps, callback=callbacks, reset_num_timesteps=False)

    def evaluate(self) -> float:
        """The share of successes of the agent as it is now, which is kept where it is the best.

        What has not learned from its own steps yet is a clone, and is kept as such.
        """
        agent = export(self.learner, self.plan.algorithm, self.standard.mean, self.standard.scale, self._judged)
        seeds = episode_seeds(self.plan.seed, self.plan.evaluation_episodes, stage=2)
        success = success_rate(agent, self._judged, seeds)
        steps, best = self.learner.num_timesteps, self.state.best
        if steps == 0:
            agent.save(self.out / CLONE, steps=steps, success=success, episodes=len(seeds))
        elif success >= best:
            agent.save(self.out / BEST, steps=steps, success=success, episodes=len(seeds))
            best = success
        self.state = TrainingState(steps, best, (*self.state.curve, (steps, success)))
        return success

    def close(self) -> None:
        self.env.close()
        self._judged.close()


def success_rate(agent: NetworkPolicy, env: gym.Env[Any, Any], seeds: Sequence[int]) -> float:
    """Over one episode from each seed."""
    return float(np.mean([rollout(env, agent, seed) for seed in seeds]))


def _check(env: gym.Env[Any, Any], demonstrations: Sequence[Episode]) -> None:
    """Raises TypeError or ValueError where there is nothing that these learners can learn."""
    for name, space in (("observations", env.observation_space), ("actions", env.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(f"an agent is trained where {name} are a Box with one axis, got {space}")
        for n, episode in enumerate(demonstrations):
            size = getattr(episode, name).shape[1]
            if size != space.shape[0]:
                raise ValueError(f"demonstration {n} has {name} of {size} numbers, the environment {space.shape[0]}")


def _wandered(env: gym.Env[Any, Any], seed: int, steps: int = 1000) -> NDArray[np.float32]:
    """(N, O) what is seen on the way of random actions."""
    rng = np.random.default_rng(seed)
    space: Any = env.action_space
    seen = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(rng.uniform(space.low, space.high).astype(np.float32))
        seen.append(env.reset()[0] if terminated or truncated else observation)
    return np.asarray(seen, np.float32)
