"""Train a stable-baselines3 agent: clone an expert from its episodes, then improve the clone by SAC.

The best agent is saved, and evaluated again on other seeds. The same command reuses demonstrations after a kill.
"""

from __future__ import annotations

import json
import time
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from rich.console import Console

from asm_gym.data.episode import load_episode
from asm_gym.data.minari_datasets import read_dataset
from asm_gym.files import write_text
from asm_gym.policies import rollout
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.run_trials import check_config, collect_to
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training import TrainingSettings, train
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import Options, option, run
from asm_gym.tasks import ROBOTS, TASKS, env_id


@dataclass(frozen=True)
class Args(Options):
    """Options of training."""

    task: str = option("Lift", positional=True, check=env_id, known=TASKS, metavar="TASK")
    """Name of a task, or any Gymnasium id with Box spaces."""
    robot: str | None = option(None, known=ROBOTS, metavar="NAME")
    """The arm; by default that of the task."""
    steps: int = option(20_000, quick=300, least=0)
    """Control steps of SAC; 0 for a clone."""
    demonstrations: int = option(200, quick=4, least=1)
    """Episodes of the scripted expert to clone."""
    dataset: Path | None = option(None, metavar="FOLDER")
    """Minari dataset of demonstrations, instead of the scripted expert."""
    cloning_updates: int = option(15_000, quick=200, least=1)
    """Updates of the actor in cloning."""
    evaluate_every: int = option(5_000, quick=150, least=1)
    """Control steps between evaluations."""
    evaluation_episodes: int = option(40, quick=1, least=1)
    """Episodes of each evaluation."""
    final_episodes: int = option(100, quick=2, least=1)
    """Episodes of the last evaluation, on other seeds."""
    workers: int = option(1, least=1)
    """Processes that record demonstrations."""
    out: Path = option(Path("runs/train"), metavar="FOLDER")
    """Folder of the run."""


def train_agent(args: Args, console: Console) -> None:
    """Train, judge the best agent, and write it to ``out/agent.npz``."""
    task = env_id(args.task)
    config = RolloutConfig(robot=args.robot)
    make = partial(gym.make, task, **dict(config.settings))
    make().close()  # bad options are refused before the folder is made
    if args.dataset is None:
        check_config(task, config)
        episodes = []
    else:
        episodes = read_dataset(args.dataset, env_id=task)
    torch.set_num_threads(1)  # more of them slow networks this small down
    start = time.perf_counter()
    names = ("task", "robot", "demonstrations", "dataset", "seed")
    with claimed(args.out, "train.json", {name: getattr(args, name) for name in names}):
        if args.dataset is None:
            folder = args.out / "demonstrations" / "episodes"
            seeds = episode_seeds(args.seed, args.demonstrations)
            with stage("recording demonstrations") as progress:
                files = collect_to(folder, task, config, seeds, args.workers, progress)
            episodes = [load_episode(file) for file in files]
        solved = [episode for episode in episodes if episode.success]
        if not solved:
            raise ValueError(f"none of {len(episodes)} demonstrations succeeded")

        settings = TrainingSettings(
            steps=args.steps,
            cloning_updates=args.cloning_updates,
            evaluate_every=args.evaluate_every,
            evaluation_episodes=args.evaluation_episodes,
            seed=args.seed,
        )
        with stage("cloning and learning") as progress:
            agent = train(make, args.out, solved, settings, progress)
        with stage("judging"), closing(make()) as env:
            policy = agent.fit_to(env, "the agent")
            seeds = episode_seeds(args.seed, args.final_episodes, stage=3)
            success = float(np.mean([rollout(env, policy, seed) for seed in seeds]))
        minutes = round((time.perf_counter() - start) / 60, 1)
        result = {"success": success, "episodes": args.final_episodes, "minutes": minutes}
        agent.save(args.out / "agent.npz", **result)
        write_text(args.out / "result.json", json.dumps(result, indent=2) + "\n")
    console.print(
        f"success {success:.0%} of {args.final_episodes} episodes: {args.out / 'agent.npz'}"
    )


main = partial(run, "train", Args, train_agent)
