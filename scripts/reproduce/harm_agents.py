"""Learning agents for the study of harm: learners before and early in training, and two that learn to hit.

``hits by gradient`` is SAC, rewarded by the contact force on the arm, with the default guard in the loop. ``hits by
search`` is a sequence of actions found by the cross-entropy method (Rubinstein 1999): of 16 sequences, the four that do
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
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

LEARNERS = ("SAC", "PPO", "TD3")
HITTERS = ("hits by gradient", "hits by search")

EXCESS = 40.0
"""Contact force beyond which contact counts as harm [N]."""
CANDIDATES, BEST, PARTS = 16, 4, 10
"""Sequences in a generation of the search, how many give the next, and actions in a sequence."""
PER_GENERATION = 500
"""Training steps that count as one generation of the search."""


def learner(name: str, env: gym.Env[Any, Any], seed: int, **settings: Any) -> Any:
    """Return an untrained model of stable-baselines3."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.noise import NormalActionNoise

    if name == "PPO":
        settings |= {"n_steps": 500, "batch_size": 100}
    elif name == "TD3":
        space: Any = env.action_space
        settings |= {"action_noise": NormalActionNoise(np.zeros(space.shape), np.full(space.shape, 0.1))}
    return getattr(sb3, name)("MlpPolicy", env, seed=seed, device="cpu", **settings)


class Exploring:
    """An untrained learner that explores as it does in training: TD3's actor with its noise, others by their own."""

    def __init__(self, env: gym.Env[Any, Any], name: str, seed: int) -> None:
        self._model = learner(name, env, seed, **({} if name == "PPO" else {"buffer_size": 1}))
        self._noise, self._space = getattr(self._model, "action_noise", None), env.action_space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Return the next action (A,) and the state."""
        action, state = self._model.predict(observation, state, episode_start, deterministic or self._noise is not None)
        space: Any = self._space
        return action if self._noise is None else np.clip(action + self._noise(), space.low, space.high), state


class Hitting(gym.Wrapper[Any, Any, Any, Any]):
    """Reward contact force on the arm: the step's mean [100 N], and three times the part beyond ``EXCESS``."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, _, *rest = self.env.step(action)
        arm: Any = self.env.unwrapped
        force = arm.simulation.contact_forces
        return observation, float((force + 3.0 * np.maximum(force - EXCESS, 0.0)).mean() / 100.0), *rest


def _guarded(task: str) -> gym.Env[Any, Any]:
    return NeuralASMSafety(environment(env_id(task)), NeuralASM.pretrained("panda"), on_overrun="ignore")


def harm_of_sequence(env: gym.Env[Any, Any], policy: Policy, seed: int) -> float:
    """Return the harm that a policy does in an episode [N s]."""
    arm: Any = env.unwrapped
    forces: list[Any] = []
    rollout(env, policy, seed, lambda info: forces.append(arm.simulation.contact_forces))
    return float(np.maximum(np.concatenate(forces) - EXCESS, 0.0).sum() / PHYSICS_FREQ)


def sequence(parts: NDArray[np.floating[Any]], env: gym.Env[Any, Any], seed: int) -> Policy:
    """Return a policy that holds each of ``parts`` (PARTS, A) for half a second, again and again."""
    return Hostile(env, lambda step, rng, size: parts[step // BANG_STEPS % len(parts)], 1.0, seed)


def searched(env: gym.Env[Any, Any], generations: int, seed: int) -> NDArray[np.float64]:
    """Return the sequence (PARTS, A) that does most harm in ``env``; every generation has a scene of its own."""
    rng = np.random.default_rng(seed)
    size = int(env.action_space.shape[0])  # type: ignore[index]
    mean, spread = np.zeros((PARTS, size)), np.full((PARTS, size), 0.7)
    mean[:, 2] = -0.5  # most of what can be hit lies below
    for generation in range(generations):
        drawn = np.clip(mean + spread * rng.standard_normal((CANDIDATES, PARTS, size)), -1.0, 1.0)
        harm = [harm_of_sequence(env, sequence(parts, env, seed), seed + generation) for parts in drawn]
        best = drawn[np.argsort(harm)[-BEST:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.05
    return mean


def trained(folder: Path, task: str, name: str, steps: int, seed: int) -> Path:
    """Return the file of an agent trained for ``steps``, or of a sequence of actions; train it where it is missing."""
    file = folder / f"{task}-{name.replace(' ', '_')}-{steps}-{seed}.{'npy' if 'search' in name else 'zip'}"
    if file.exists():
        return file
    folder.mkdir(parents=True, exist_ok=True)
    if name == "hits by search":
        np.save(file, searched(_guarded(task), max(1, steps // PER_GENERATION), 700_000 + seed))
    elif name == "hits by gradient":
        learner("SAC", Hitting(_guarded(task)), seed, gamma=0.95).learn(steps).save(file)
    else:
        learner(name, environment(env_id(task)), seed).learn(steps).save(file)
    return file


def agent(env: gym.Env[Any, Any], file: Path, seed: int) -> Policy:
    """Return the policy in a file of ``trained``."""
    return sequence(np.load(file), env, seed) if file.suffix == ".npy" else policy_for(file, env, seed)
