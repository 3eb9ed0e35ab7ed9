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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import torch
import tyro
from rich.console import Console

from asm_gym.data.datasets import read_dataset
from asm_gym.episode import Episode, load_episode
from asm_gym.policies.network import NetworkPolicy, describe
from asm_gym.rollouts.collect import check as check_policy
from asm_gym.rollouts.collect import collect_to
from asm_gym.rollouts.parallel import THIS_PROCESS, ParallelConfig, Progress
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import claimed
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.learners import ALGORITHMS
from asm_gym.rollouts.training.recurrent import RECURRENT, clone_recurrent
from asm_gym.rollouts.training.run import BEST, CLONE, Plan, TrainingRun, success_rate
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.command import at_least, run
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

KEPT = ("env_id", "algorithm", "robot", "demonstrations", "dataset", "cloning_updates", "seed")
"""What must not change while a run goes on."""
FREE = ("task", "out", "quick", "parallel")
"""What is left out of the command that is noted down."""

Curve = tuple[tuple[int, float], ...]
"""Control steps, and the share of successes after them."""


@dataclass(frozen=True)
class Args:
    """An agent for a task."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")] = "Lift"
    """Name of a task, or any Gymnasium id with Box spaces."""
    algorithm: str = "sac"
    """sac, td3 or ppo; or gru, a recurrent clone, with steps 0."""
    robot: str | None = None
    """The arm; the task's own by default."""
    steps: int = 20_000
    """Control steps of its own that the agent learns from; 0 for a clone."""
    demonstrations: int = 200
    """Episodes of the scripted expert to begin with; 0 for none."""
    dataset: Path | None = None
    """Minari dataset of demonstrations, in place of the scripted expert's."""
    cloning_updates: int = 15_000
    """Updates of the actor on demonstrations, before it acts."""
    evaluate_every: int = 5_000
    """Control steps between evaluations."""
    evaluation_episodes: int = 40
    """Episodes of each evaluation."""
    final_episodes: int = 100
    """Episodes of the last evaluation, on other seeds."""
    checkpoint_every: int = 2_500
    """Control steps between checkpoints: what a kill loses at most. PPO's wait for the end of its rollout."""
    parallel: tyro.conf.OmitArgPrefixes[ParallelConfig] = THIS_PROCESS
    """Who records demonstrations; learning is done by one process."""
    seed: int = 0
    """Seed of all that is drawn."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/train")
    """Folder of the run."""
    quick: bool = False
    """Few demonstrations, few steps: to see that everything runs."""

    def __post_init__(self) -> None:
        check_choice("algorithm", self.algorithm, (*ALGORITHMS, RECURRENT))
        if self.task not in gym.registry:
            task_spec(self.task)
        at_least(1, self, "cloning_updates", "evaluate_every", "evaluation_episodes", "final_episodes")
        at_least(1, self, "checkpoint_every")
        at_least(0, self, "steps", "demonstrations")
        if not self.steps and not self.demonstrations and self.dataset is None:
            raise ValueError("there is nothing to learn from: neither steps nor demonstrations")
        if self.algorithm == RECURRENT and self.steps:
            raise ValueError(f"{RECURRENT} learns from demonstrations alone: steps must be 0, got {self.steps}")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        return replace(
            self,
            steps=min(300, self.steps),
            demonstrations=min(4, self.demonstrations),
            cloning_updates=200,
            evaluate_every=150,
            evaluation_episodes=1,
            final_episodes=2,
            checkpoint_every=100,
        )

    @property
    def env_id(self) -> str:
        return self.task if self.task in gym.registry else task_spec(self.task).id

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
    learn = _cloned if args.algorithm == RECURRENT else _learned
    agent, curve = learn(args, episodes, console, seconds)
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


def _cloned(
    args: Args, episodes: Sequence[Episode], console: Console, seconds: dict[str, float]
) -> tuple[NetworkPolicy, Curve]:
    """A recurrent clone, which nothing evaluates on the way."""
    with stage("cloning", console, seconds) as tick, closing(args.plan.make()) as env:
        agent = clone_recurrent(episodes, args.cloning_updates, args.seed, tick)
        agent.trained_in = describe(env)
    return agent, ()


def _command(args: Args) -> str:
    changed = {k: v for k, v in vars(args).items() if v != getattr(Args, k, None) and k not in FREE}
    options = " ".join(f"--{k.replace('_', '-')} {v}" for k, v in changed.items())
    return f"asm-gym train {args.task} {options}".strip()


def train_and_report(args: Args, console: Console) -> None:
    """Trains, and says how good the agent is."""
    args = args.scaled()
    check(args)
    result = train(args, console)
    console.print(f"success {result['success']:.0%} of {args.final_episodes} episodes: {args.out / 'agent.npz'}")


def main(argv: list[str] | None = None) -> int:
    """Trains, and returns the exit code."""
    return run("train", Args, train_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
