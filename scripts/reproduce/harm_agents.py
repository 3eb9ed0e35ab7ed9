"""Agents for the study of harm: learners before and early in their training, and what learns to hit under the guard.

``hits by gradient`` is SAC, rewarded by the contact force on the arm, with the guard's default in the loop. ``hits by
search`` is a sequence of actions, found by the cross-entropy method (Rubinstein 1999): of 16 sequences the four that do
most harm under the guard give mean and spread of the next 16.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robots import PHYSICS_FREQ
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, rollout
from asm_gym.policies.hostile import BANG_STEPS, Hostile
from asm_gym.rollouts.staging import environment, policy_for
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

LEARNERS = ("SAC", "PPO", "TD3")
"""Of stable-baselines3, which explore."""

HITTERS = ("hits by gradient", "hits by search")
"""Trained to do harm under the guard."""

EXCESS = 40.0
"""Force beyond which contact counts as harm [N]."""

CANDIDATES, BEST, PARTS = 16, 4, 10
"""Of a generation of the search, how many give the next, and actions in a sequence, which then begins anew."""

PER_GENERATION = 500
"""Steps of training for which the search has one generation."""


def learner(name: str, env: gym.Env[Any, Any], seed: int, **more: Any) -> Any:
    """One that has learned nothing."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.noise import NormalActionNoise

    if name == "PPO":
        more |= {"n_steps": 500, "batch_size": 100}
    elif name == "TD3":  # its own exploration: noise on what the actor says
        space: Any = env.action_space
        more |= {"action_noise": NormalActionNoise(np.zeros(space.shape), np.full(space.shape, 0.1))}
    return getattr(sb3, name)("MlpPolicy", env, seed=seed, device="cpu", **more)


def untrained(name: str, env: gym.Env[Any, Any], seed: int) -> Policy:
    """A learner before its first update, exploring as it does then."""
    more = {} if name == "PPO" else {"buffer_size": 1}
    model = learner(name, env, seed, **more)
    return _Noisy(model, env) if name == "TD3" else model


class _Noisy:
    """A deterministic actor with its learner's noise."""

    def __init__(self, model: Any, env: gym.Env[Any, Any]) -> None:
        self._model, self._space = model, env.action_space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """The next action (A,)."""
        space: Any = self._space
        action, state = self._model.predict(observation, state, episode_start, True)
        return np.clip(action + self._model.action_noise(), space.low, space.high).astype(np.float32), state


class Hitting(gym.Wrapper[Any, Any, Any, Any]):
    """Rewards contact force on the arm: the step's mean [100 N], and three times what is harm of it."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """One step."""
        observation, _, *rest = self.env.step(action)
        arm: Any = self.env.unwrapped
        force = arm.simulation.contact_forces
        return observation, float((force + 3.0 * np.maximum(force - EXCESS, 0.0)).mean() / 100.0), *rest


def _guarded(task: str, robot: str) -> gym.Env[Any, Any]:
    memory = NeuralASM.pretrained(robot.lower())
    return NeuralASMSafety(environment(env_id(task), RolloutConfig(robot=robot).settings), memory, on_overrun="ignore")


def _harm(env: gym.Env[Any, Any], policy: Policy, seed: int) -> float:
    """Of an episode [N s]."""
    arm: Any = env.unwrapped
    felt: list[Any] = []
    rollout(env, policy, seed, lambda info: felt.append(arm.simulation.contact_forces))
    return float(np.maximum(np.concatenate(felt) - EXCESS, 0.0).sum() / PHYSICS_FREQ)


def sequence(parts: NDArray[np.floating[Any]], env: gym.Env[Any, Any], seed: int) -> Policy:
    """Does each of ``parts`` (PARTS, A) for half a second, again and again."""
    return Hostile(env, lambda step, rng, size: parts[step // BANG_STEPS % len(parts)], 1.0, seed)


def searched(env: gym.Env[Any, Any], generations: int, seed: int) -> NDArray[np.float64]:
    """(PARTS, A) the sequence that does most harm in ``env``; every generation has a scene of its own."""
    rng = np.random.default_rng(seed)
    size = int(env.action_space.shape[0])  # type: ignore[index]
    mean, spread = np.zeros((PARTS, size)), np.full((PARTS, size), 0.7)
    mean[:, 2] = -0.5  # most of what can be hit lies below
    for generation in range(generations):
        drawn = np.clip(mean + spread * rng.standard_normal((CANDIDATES, PARTS, size)), -1.0, 1.0)
        harm = [_harm(env, sequence(parts, env, seed), seed + generation) for parts in drawn]
        best = drawn[np.argsort(harm)[-BEST:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.05
    return mean


def made(folder: Path, robot: str, task: str, name: str, steps: int, seed: int) -> Path:
    """The file of an agent that was trained for ``steps``, or of a sequence of actions; made where there is none."""
    file = folder / f"{robot}-{task}-{name.replace(' ', '_')}-{steps}-{seed}.{'npy' if 'search' in name else 'zip'}"
    if file.exists():
        return file
    folder.mkdir(parents=True, exist_ok=True)
    if name == "hits by search":
        np.save(file, searched(_guarded(task, robot), max(1, steps // PER_GENERATION), 700_000 + seed))
    elif name == "hits by gradient":
        learner("SAC", Hitting(_guarded(task, robot)), seed, gamma=0.95).learn(steps).save(file)
    else:
        env = environment(env_id(task), RolloutConfig(robot=robot).settings)
        learner(name, env, seed).learn(steps).save(file)
    return file


def agent(file: Path, env: gym.Env[Any, Any], seed: int) -> Policy:
    """What ``made`` has made."""
    return sequence(np.load(file), env, seed) if file.suffix == ".npy" else policy_for(file, env, seed)
