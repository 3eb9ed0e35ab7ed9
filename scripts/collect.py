"""Records a policy's episodes, in worker processes; as a command, into a Minari dataset.

Every episode is a file of its own as soon as it has ended: a run that is killed loses those that were running, and the
same command goes on with the rest.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console

from asm_gym.datasets import require_minari, write_dataset
from asm_gym.episodes import Episode, load_episode, save_episode
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.folder import claim_folder, versions
from asm_gym.rollouts.parallel import ParallelConfig, Progress, environment, parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import USAGE_ERRORS
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import StreamRecorder

Settings = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Args:
    """Episodes of a policy, as a Minari dataset."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")] = "Lift"
    """Name of a task, or any Gymnasium id with Box spaces."""
    policy: str = "scripted"
    """What acts: scripted, hold, a shipped agent, or the path of one."""
    robot: str | None = None
    """The arm; the task's own by default."""
    episodes: int = 100
    """How many; a second call with more of them goes on."""
    only_successful: bool = False
    """Leave episodes that failed out of the dataset."""
    workers: int = 2
    """Processes."""
    backend: str = "loky"
    """loky for processes on this machine; dask or ray for a cluster that is running."""
    address: str | None = None
    """Where the cluster is, such as tcp://host:8786."""
    seed: int = 0
    """Seed of the environment and of the policy: the same seed gives the same episodes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/collect")
    """Folder of the episodes and of the dataset."""
    quick: bool = False
    """Four episodes: to see that everything runs."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        if self.task not in gym.registry:
            task_spec(self.task)
        ParallelConfig(self.workers, self.backend, self.address)  # refuses what makes no sense

    @property
    def env_id(self) -> str:
        return self.task if self.task in gym.registry else task_spec(self.task).id

    @property
    def dataset_id(self) -> str:
        """Minari's name of the dataset."""
        name = self.env_id.rsplit("/", 1)[-1].rsplit("-v", 1)[0].lower()
        return f"asm_gym/{name}-{Path(self.policy).stem}-v0"

    @property
    def settings(self) -> Settings:
        """What ``gym.make`` is given besides the id."""
        return () if self.robot is None else (("robot", self.robot),)


def episode_seeds(seed: int, episodes: int, stage: int = 0) -> list[int]:
    """One seed an episode; lists of different ``stage`` have nothing in common."""
    return [int(s) for s in np.random.SeedSequence([seed, stage]).generate_state(episodes, np.uint32) // 2]


def record(seed: int, env_id: str, policy: str, settings: Settings) -> Episode:
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
    return parallel_map(task, seeds, workers, progress)


def record_to(seed: int, env_id: str, policy: str, settings: Settings, folder: Path) -> Path:
    """Records the episode of ``seed``, and writes it to its place."""
    return save_episode(_place(folder, seed), record(seed, env_id, policy, settings))


def record_all(args: Args, progress: Progress) -> list[Path]:
    """Records the episodes that are not there yet; where all of them are."""
    seeds = episode_seeds(args.seed, args.episodes)
    folder = args.out.resolve() / "episodes"
    missing = [s for s in seeds if not _place(folder, s).is_file()]
    done = len(seeds) - len(missing)
    progress(done, len(seeds))
    task = partial(record_to, env_id=args.env_id, policy=args.policy, settings=args.settings, folder=folder)
    crew = ParallelConfig(args.workers, args.backend, args.address)
    parallel_map(task, missing, crew, lambda k, _: progress(done + k, len(seeds)))
    return [_place(folder, s) for s in seeds]


def assemble(args: Args, files: list[Path]) -> tuple[Path, list[Episode]]:
    """The dataset of recorded episodes, and what of them went into it."""
    episodes = [load_episode(file) for file in files]
    kept = [e for e in episodes if e.success or not args.only_successful]
    if not kept:
        raise ValueError(f"none of {len(episodes)} episodes succeeded, so none is left for the dataset")
    details = {"algorithm_name": args.policy, "versions": versions(), "settings": dict(args.settings)}
    env = gym.make(args.env_id, **dict(args.settings))
    try:
        return write_dataset(args.out, args.dataset_id, kept, env, details), kept
    finally:
        env.close()


def check(args: Args) -> None:
    """Raises what the environment and the policy refuse, before anything runs."""
    env = StreamRecorder(environment(args.env_id, args.settings))
    make_policy(args.policy, env, seed=0)


def main(argv: list[str] | None = None) -> int:
    """Records; 2 where the arguments make no sense."""
    console, seconds = Console(), dict[str, float]()
    try:
        args = tyro.cli(Args, args=argv, prog="asm-gym collect", description=__doc__)
        args = replace(args, episodes=4) if args.quick else args
        require_minari()
        check(args)
        claim = {"env_id": args.env_id, "policy": args.policy, "settings": dict(args.settings), "seed": args.seed}
        claim_folder(args.out, "collect.json", claim)
        with stage("recording", console, seconds) as progress:
            files = record_all(args, progress)
        folder, kept = assemble(args, files)
    except USAGE_ERRORS as error:
        print(f"asm-gym collect: {error}", file=sys.stderr)
        return 2
    steps = sum(map(len, kept))
    console.print(f"{len(kept)} episodes, {steps} steps, {sum(e.success for e in kept)} successful: {folder}")
    console.print(f"MINARI_DATASETS_PATH={args.out} lets minari.load_dataset({args.dataset_id!r}) find it")
    return 0


def _place(folder: Path, seed: int) -> Path:
    return folder / f"{seed}.npz"


if __name__ == "__main__":
    sys.exit(main())
