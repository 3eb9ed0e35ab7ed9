"""Trains a stable-baselines3 agent: cloned from an expert's episodes, then improved by its own.

A run lives in one folder and can be killed at any time: the same command goes on from the last checkpoint. The best
agent of its evaluations is written as arrays and JSON, beside the clone, and judged once more on seeds of its own.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from rich.console import Console

from asm_gym.data.datasets import read_dataset
from asm_gym.episode import Episode, load_episode
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.collect import check as check_policy
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.parallel import ParallelConfig, Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.learners import ALGORITHMS
from asm_gym.rollouts.training.run import BEST, CLONE, Plan, TrainingRun, success_rate
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.tasks import ROBOTS, TASKS, env_id

KEPT = ("env_id", "algorithm", "robot", "demonstrations", "dataset", "cloning_updates", "seed")
"""What must not change while a run goes on."""
FREE = ("task", "out", "quick", "workers")
"""What is left out of the command that is noted down."""

Curve = tuple[tuple[int, float], ...]
"""Control steps, and the share of successes after them."""


@dataclass(frozen=True)
class Args:
    """An agent for a task."""

    task: str = option("Lift", positional=True, check=env_id, listed=TASKS, metavar="TASK")
    """Name of a task, or any Gymnasium id with Box spaces."""
    algorithm: str = option("sac", known=ALGORITHMS)
    """How it learns."""
    robot: str | None = option(None, known=ROBOTS)
    """The arm; the task's own by default."""
    steps: int = option(20_000, quick=300, least=0)
    """Control steps of its own that the agent learns from; 0 for a clone."""
    demonstrations: int = option(200, quick=4, least=0)
    """Episodes of the scripted expert to begin with; 0 for none."""
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
    evaluate_every: int = fixed(5_000, quick=150, least=1)
    """Control steps between evaluations."""
    checkpoint_every: int = fixed(2_500, quick=100, least=1)
    """Control steps between checkpoints: what a kill loses at most. PPO's wait for the end of its rollout."""

    def __post_init__(self) -> None:
        check_options(self)
        if not self.steps and not self.demonstrations and self.dataset is None:
            raise ValueError("there is nothing to learn from: neither steps nor demonstrations")

    @property
    def parallel(self) -> ParallelConfig:
        """Who does the work."""
        return ParallelConfig.named(self.workers)

    @property
    def env_id(self) -> str:
        return env_id(self.task)

    @property
    def plan(self) -> Plan:
        settings = {} if self.robot is None else {"robot": self.robot}
        each = (
            "algorithm",
            "steps",
            "cloning_updates",
            "evaluate_every",
            "evaluation_episodes",
            "checkpoint_every",
            "seed",
        )
        return Plan(self.env_id, settings, **{name: getattr(self, name) for name in each})


def check(args: Args) -> None:
    """Raises what the environment, the dataset or the expert refuse, before the folder is claimed."""
    gym.make(args.env_id, **args.plan.settings).close()
    if args.dataset is not None:
        read_dataset(args.dataset, env_id=args.env_id)
    elif args.demonstrations:
        check_policy(args.env_id, RolloutConfig(robot=args.robot))


def _recorded(args: Args, tick: Progress) -> list[Path]:
    folder, seeds = args.out / "demonstrations" / "episodes", episode_seeds(args.seed, args.demonstrations)
    return collect_to(folder, args.env_id, RolloutConfig(robot=args.robot), seeds, args.parallel, tick)


def demonstrate(args: Args, tick: Progress) -> list[Episode]:
    """Successful episodes to begin with, recorded or read."""
    if args.dataset is not None:
        episodes = read_dataset(args.dataset, env_id=args.env_id)
    elif not args.demonstrations:
        return []
    else:
        episodes = [load_episode(file) for file in _recorded(args, tick)]
    kept = [e for e in episodes if e.success]
    if not kept:
        raise ValueError(f"none of {len(episodes)} demonstrations succeeded")
    return kept


def train(args: Args, console: Console) -> dict[str, Any]:
    """Trains, and says how well the best agent does; it is left in ``out/agent.npz``."""
    with claimed(args.out, "train.json", {key: getattr(args, key) for key in KEPT}):
        return _train(args, console)


def _train(args: Args, console: Console) -> dict[str, Any]:
    torch.set_num_threads(1)  # more of them slow networks this small down
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    with stage("recording demonstrations", console, seconds) as tick:
        episodes = demonstrate(args, tick)
    agent, curve = _learned(args, episodes, console, seconds)
    with stage("judging", console, seconds), closing(args.plan.make()) as env:
        seeds = episode_seeds(args.seed, args.final_episodes, stage=3)
        success = success_rate(agent.fit_to(env, "the agent"), env, seeds)
    result = {
        "success": success,
        "episodes": args.final_episodes,
        "curve": curve,
        "seconds": seconds,
        "minutes": round((time.perf_counter() - start) / 60, 1),
        "command": _command(args),
    }
    agent.save(args.out / "agent.npz", **result)
    (args.out / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return result


def _learned(
    args: Args, episodes: Sequence[Episode], console: Console, seconds: dict[str, float]
) -> tuple[NetworkPolicy, Curve]:
    """The best agent of its evaluations, and what those found."""
    with closing(TrainingRun(args.plan, args.out, episodes)) as training:
        with stage("cloning", console, seconds) as tick:
            training.begin(tick)
        with stage("learning", console, seconds) as tick:
            training.learn(tick)
        return NetworkPolicy.load(args.out / (BEST if args.steps else CLONE)), training.state.curve


def _command(args: Args) -> str:
    changed = {k: v for k, v in vars(args).items() if v != getattr(Args, k, None) and k not in FREE}
    options = " ".join(f"--{k.replace('_', '-')} {v}" for k, v in changed.items())
    return f"asm-gym train {args.task} {options}".strip()


def train_and_report(args: Args, console: Console) -> None:
    """Trains, and says how good the agent is."""
    check(args)
    result = train(args, console)
    console.print(f"success {result['success']:.0%} of {args.final_episodes} episodes: {args.out / 'agent.npz'}")


def main(argv: list[str] | None = None) -> int:
    """Trains, and returns the exit code."""
    return run("train", Args, train_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
