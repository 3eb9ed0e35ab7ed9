"""Trains a stable-baselines3 agent: cloned from an expert's episodes, then improved by its own (SAC).

Demonstrations that were recorded are not recorded again. The best agent of the evaluations is written as arrays and
JSON, beside the clone, and judged once more on seeds of its own.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import torch
from rich.console import Console

from asm_gym.data.datasets import read_dataset
from asm_gym.episode import Episode, load_episode
from asm_gym.rollouts.collect import check as check_policy
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.parallel import ParallelConfig
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.run import Plan, success_rate, train
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, option
from asm_gym.tasks import ROBOTS, TASKS, env_id


@dataclass(frozen=True)
class Args:
    """An agent for a task."""

    task: str = option("Lift", positional=True, check=env_id, known=TASKS, metavar="TASK")
    """Name of a task, or any Gymnasium id with Box spaces."""
    robot: str | None = option(None, known=ROBOTS)
    """The arm; the task's own by default."""
    steps: int = option(20_000, quick=300, least=0)
    """Control steps of its own that the agent learns from; 0 for a clone."""
    demonstrations: int = option(200, quick=4, least=1)
    """Episodes of the scripted expert to begin with."""
    dataset: Path | None = option(None, metavar="FOLDER")
    """Minari dataset of demonstrations, in place of the scripted expert's."""
    cloning_updates: int = option(15_000, quick=200, least=1)
    """Updates of the actor on demonstrations, before it acts."""
    evaluation_episodes: int = option(40, quick=1, least=1)
    """Episodes of each evaluation."""
    final_episodes: int = option(100, quick=2, least=1)
    """Episodes of the last evaluation, on other seeds."""
    workers: str = option("1", check=ParallelConfig.named, metavar="N")
    """Processes that record demonstrations; or a running cluster, as dask:tcp://host:8786 or ray:host:6379."""
    seed: int = option(0, least=0)
    """Seed of all that is drawn: the same seed gives the same result."""
    out: Path = option(Path("runs/train"), metavar="FOLDER")
    """Folder of the run."""
    quick: bool = False
    """Few demonstrations, few steps: to see that everything runs."""
    evaluate_every: int = option(5_000, quick=150, least=1)
    """Control steps between evaluations."""

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def config(self) -> RolloutConfig:
        """How demonstrations are recorded."""
        return RolloutConfig(robot=self.robot)

    @property
    def plan(self) -> Plan:
        """What is trained."""
        names = ("steps", "cloning_updates", "evaluate_every", "evaluation_episodes", "seed")
        return Plan(env_id(self.task), dict(self.config.settings), **{name: getattr(self, name) for name in names})


def demonstrations(args: Args, console: Console) -> list[Episode]:
    """Record or read successful episodes to begin with."""
    if args.dataset is not None:
        episodes = read_dataset(args.dataset, env_id=env_id(args.task))
    else:
        folder, seeds = args.out / "demonstrations" / "episodes", episode_seeds(args.seed, args.demonstrations)
        with stage("recording demonstrations", console, {}) as tick:
            workers = ParallelConfig.named(args.workers)
            files = collect_to(folder, env_id(args.task), args.config, seeds, workers, tick)
        episodes = [load_episode(file) for file in files]
    kept = [e for e in episodes if e.success]
    if not kept:
        raise ValueError(f"none of {len(episodes)} demonstrations succeeded")
    return kept


def train_and_report(args: Args, console: Console) -> None:
    """Train, judge the best agent, and write it to ``out/agent.npz``."""
    gym.make(
        env_id(args.task), **args.plan.settings
    ).close()  # what makes no sense is refused before the folder is made
    if args.dataset is not None:
        read_dataset(args.dataset, env_id=env_id(args.task))
    else:
        check_policy(env_id(args.task), args.config)
    torch.set_num_threads(1)  # more of them slow networks this small down
    start = time.perf_counter()
    claim = {name: getattr(args, name) for name in ("task", "robot", "demonstrations", "dataset", "seed")}
    with claimed(args.out, "train.json", claim):
        episodes = demonstrations(args, console)
        with stage("cloning and learning", console, {}) as tick:
            agent, curve = train(args.plan, args.out, episodes, tick)
        with stage("judging", console, {}), closing(args.plan.make()) as env:
            seeds = episode_seeds(args.seed, args.final_episodes, stage=3)
            success = success_rate(agent.fit_to(env, "the agent"), env, seeds)
        minutes = round((time.perf_counter() - start) / 60, 1)
        result = {"success": success, "episodes": args.final_episodes, "curve": curve, "minutes": minutes}
        agent.save(args.out / "agent.npz", **result)
        (args.out / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    console.print(f"success {success:.0%} of {args.final_episodes} episodes: {args.out / 'agent.npz'}")


def main(argv: list[str] | None = None) -> int:
    """Train, and return the exit code."""
    return run("train", Args, train_and_report, argv)


if __name__ == "__main__":
    sys.exit(main())
