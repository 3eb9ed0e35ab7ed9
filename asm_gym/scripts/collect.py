"""Record episodes of a policy, in worker processes, as a Minari dataset.

Each episode is written when it ends: a killed run loses only running episodes, and the same command continues.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
from rich.console import Console

from asm_gym.data.episode import load_episode
from asm_gym.data.minari_datasets import require_minari, write_dataset
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed, versions
from asm_gym.rollouts.run_trials import check_config, collect_to, unknown_actions
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import RolloutConfig, task_in
from asm_gym.scripts.command import Options, option, run
from asm_gym.tasks import ROBOTS, TASKS, env_id


@dataclass(frozen=True)
class Args(Options):
    """Episodes of a policy, as a Minari dataset."""

    task: str = option("Lift", positional=True, check=env_id, known=TASKS, metavar="TASK")
    """Name of a task, or any Gymnasium id with numeric spaces, such as Pusher-v5."""
    policy: str = "scripted"
    """Policy: scripted, hold, sway, a shipped agent, or the path of an agent."""
    robot: str | None = option(None, known=ROBOTS, metavar="NAME")
    """The arm; by default that of the task."""
    episodes: int = option(100, quick=4, least=1)
    """Number of episodes; a second call with a larger number continues."""
    only_successful: bool = False
    """Leave failed episodes out of the dataset."""
    workers: int = option(2, least=1)
    """Number of processes."""
    out: Path = option(Path("runs/collect"), metavar="FOLDER")
    """Folder of the episodes and of the dataset."""


def dataset_id(task: str, policy: str) -> str:
    """Return Minari's name of a dataset."""
    without_module = env_id(task).rsplit(":", 1)[-1]
    name = task_in(without_module).lower()
    return f"asm_gym/{name}-{Path(policy).stem}-v0"


def collect(args: Args, console: Console) -> None:
    """Record the episodes that are missing, and write the dataset of all."""
    require_minari()
    task = env_id(args.task)
    config = RolloutConfig(args.policy, args.robot)
    settings = dict(config.settings)
    name = dataset_id(args.task, args.policy)
    check_config(task, config)
    unknown = unknown_actions(task, config)
    if unknown:
        console.print(f"Note: {unknown}.", soft_wrap=True, markup=False)
    claim = {"env_id": task, "policy": args.policy, "settings": settings, "seed": args.seed}
    with claimed(args.out, "collect.json", claim):
        with stage("recording") as progress:
            folder = args.out / "episodes"
            seeds = episode_seeds(args.seed, args.episodes)
            files = collect_to(folder, task, config, seeds, args.workers, progress)
        episodes = [load_episode(file) for file in files]
        successful = [episode for episode in episodes if episode.success]
        kept = episodes
        if args.only_successful:
            kept = successful
        if not kept:
            raise ValueError(
                f"none of {len(episodes)} episodes succeeded, so none is left for the dataset"
            )
        details = {"algorithm_name": args.policy, "versions": versions(), "settings": settings}
        with closing(gym.make(task, **settings)) as env:
            dataset = write_dataset(args.out, name, kept, env, details)
    steps = sum(map(len, kept))
    console.print(f"{len(kept)} episodes, {steps} steps, {len(successful)} successful: {dataset}")
    console.print(f"MINARI_DATASETS_PATH={args.out} lets minari.load_dataset({name!r}) find it")


main = partial(run, "collect", Args, collect)
