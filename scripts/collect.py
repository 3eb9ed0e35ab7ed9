"""Records a policy's episodes, in worker processes."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from asm_gym.episodes import Episode
from asm_gym.policies import make_policy, rollout
from asm_gym.scripts.dispatch import Progress, dispatch, environment
from asm_gym.wrappers import StreamRecorder


def episode_seeds(seed: int, episodes: int, stage: int = 0) -> list[int]:
    """One seed an episode; lists of different ``stage`` have nothing in common."""
    return [int(s) for s in np.random.SeedSequence([seed, stage]).generate_state(episodes, np.uint32) // 2]


def record(seed: int, env_id: str, policy: str, settings: tuple[tuple[str, Any], ...]) -> Episode:
    """The episode of ``seed``."""
    env = StreamRecorder(environment(env_id, settings))
    rollout(env, make_policy(policy, env, seed=seed), seed)
    return env.finish()


def collect(
    env_id: str,
    policy: str = "scripted",
    episodes: int = 100,
    seed: int = 0,
    workers: int = 2,
    *,
    stage: int = 0,
    progress: Progress | None = None,
    **env_kwargs: Any,
) -> list[Episode]:
    """Episodes of ``policy`` in ``env_id``, in an order that does not depend on ``workers``.

    Args:
        env_id: a Gymnasium id, such as ``asm_gym/Lift-v0``.
        policy: what ``asm_gym.policies.make_policy`` takes.
        episodes: how many.
        seed: of everything; the same seed gives the same episodes.
        workers: processes; 1 stays in this one.
        stage: sets of episodes with the same ``seed`` and different stages are different.
        progress: is called as (done, total).
        env_kwargs: handed to ``gym.make``.

    Raises:
        ValueError: fewer than one episode or worker; whatever the environment and the policy refuse.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    seeds = episode_seeds(seed, episodes, stage)
    task = partial(record, env_id=env_id, policy=policy, settings=tuple(sorted(env_kwargs.items())))
    return dispatch(task, seeds, workers, progress)
