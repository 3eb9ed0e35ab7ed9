"""Record a policy's episodes in any Gymnasium environment, by workers; in memory, or each in a file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from asm_gym.episode import Episode, save_episode
from asm_gym.rollouts.parallel import Progress, parallel_map
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.staging import environment, play, policy_for, staged
from asm_gym.rollouts.trial import PolicySource, RolloutConfig, Trial
from asm_gym.tasks import env_spec
from asm_gym.validation import check_number, typed
from asm_gym.wrappers import StreamRecorder


@typed
def collect(
    env_id: str,
    policy: PolicySource = "scripted",
    episodes: int = 100,
    seed: int = 0,
    workers: int | str = 2,
    *,
    stage: int = 0,
    progress: Progress | None = None,
    **env_kwargs: Any,
) -> list[Episode]:
    """Record episodes of ``policy`` in ``env_id``, in an order that does not depend on ``workers``.

    Where ``info`` has no ``"stream"``, observation and action are the stream.

    Args:
        env_id: any Gymnasium id with numeric spaces, such as ``asm_gym/Lift-v0``, ``Pusher-v5`` or ``module:id``.
        policy: a name or a path, as ``asm_gym.policies.make_policy`` takes; any object with stable-baselines3's
            ``predict``; or a factory that makes one for an environment, called for every episode. An object is shared
            by the episodes of one process, so it must reset itself where ``episode_start`` is set; one that draws at
            random must have ``set_random_seed``.
        episodes: how many.
        seed: of everything; the same seed gives the same episodes.
        workers: processes, 1 of which is this one; or a cluster, such as ``dask:tcp://host:8786``.
        stage: sets of episodes with the same ``seed`` and different stages are different.
        progress: is called as (done, total).
        env_kwargs: arguments of ``gym.make``.

    Raises:
        ValueError: fewer than one episode or worker; whatever the environment and the policy refuse.
        TypeError: spaces that are not numeric, or a policy that cannot be sent to another process.

    Example:
        >>> from asm_gym import collect
        >>> episodes = collect("asm_gym/SyntheticArm-v0", "sway", episodes=2, seed=0, workers=1)
        >>> len(episodes), episodes[0].stream.shape == (len(episodes[0]), episodes[0].spec.size)
        (2, True)
    """
    check_number("episodes", episodes, low=1, whole=True)
    config = RolloutConfig(policy, env_kwargs=tuple(sorted(env_kwargs.items())))
    task = partial(record_episode, spec=env_spec(env_id), config=config)
    return parallel_map(task, episode_seeds(seed, episodes, stage), workers, progress)


def record_episode(seed: int, spec: EnvSpec, config: RolloutConfig) -> Episode:
    """Record the episode of ``seed``."""
    gym.registry.setdefault(spec.id, spec)  # another process lacks what the user registered in this one
    trial = Trial(spec.id, seed)
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder)
    return recorder.finish()


def collect_to(
    folder: Path,
    env_id: str,
    config: RolloutConfig,
    seeds: Sequence[int],
    workers: int | str = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Record the episodes that are not in ``folder`` yet; return the files of all."""
    make = partial(_record_to, folder=folder.resolve(), spec=env_spec(env_id), config=config)
    return make_missing(make, seeds, lambda seed: folder.resolve() / f"{seed}.npz", workers, progress)


def _record_to(seed: int, folder: Path, spec: EnvSpec, config: RolloutConfig) -> Path:
    return save_episode(folder / f"{seed}.npz", record_episode(seed, spec, config))


def check(env_id: str, config: RolloutConfig) -> None:
    """Raise what the environment and the policy refuse, before anything runs."""
    policy_for(config.policy, StreamRecorder(environment(env_id, config.settings)), seed=0)
