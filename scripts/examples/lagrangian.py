"""An example of an agent that minds ``info["cost"]``: a Lagrange multiplier on the reward, for stable-baselines3.

    r' = r - λ c,   λ ← max(0, λ + η (J - α))      J: mean cost of a step since the last change

The multiplier rises while the robot is in alarm more often than α allows, and falls below it (reward constrained policy
optimisation: Tessler, Mankowitz and Mannor 2019, Eq. 8 and 10).
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.scripts.options import option
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.cost import CostlyReward


class LagrangeMultiplier(BaseCallback):
    """Adapts the ``weight`` of every ``CostlyReward`` that the learner's environments are wrapped in.

    Args:
        limit: α >= 0, cost that a step may have on average.
        rate: η > 0, how fast the multiplier follows.
        every: episodes between two changes.
        initial: λ at the start.

    Attributes:
        value: λ now.
        history: (control steps, mean cost of a step, λ) of each change.
    """

    def __init__(self, limit: float = 0.01, rate: float = 5.0, every: int = 4, initial: float = 0.0) -> None:
        super().__init__()
        if limit < 0 or initial < 0:
            raise ValueError(f"limit and initial must be >= 0, got {limit} and {initial}")
        if not rate > 0 or every < 1:
            raise ValueError(f"rate must be > 0 and every at least 1, got {rate} and {every}")
        self.limit, self.rate, self.every, self.value = limit, rate, every, initial
        self.history: list[tuple[int, float, float]] = []
        self._cost = self._steps = self._ended = 0.0

    def _on_training_start(self) -> None:
        self._pass_on()

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self._cost += sum(info["cost"] for info in infos)
        self._steps += len(infos)
        self._ended += sum(self.locals["dones"])
        if self._ended >= self.every:
            self._change(self._cost / self._steps)
            self._cost = self._steps = self._ended = 0.0
        return True

    def _change(self, mean_cost: float) -> None:
        self.value = max(0.0, self.value + self.rate * (mean_cost - self.limit))
        self.history.append((self.num_timesteps, mean_cost, self.value))
        self.logger.record("safety/cost", mean_cost)
        self.logger.record("safety/multiplier", self.value)
        self._pass_on()

    def _pass_on(self) -> None:
        # It lies under whatever wraps the environment, in other processes perhaps.
        found = self.training_env.env_method("set_wrapper_attr", "weight", self.value, force=False)
        if not all(found):
            raise ValueError("the multiplier needs a CostlyReward in every environment that the agent learns in")


@dataclass(frozen=True)
class Args:
    """PPO that learns to stay out of alarm, by a Lagrange multiplier on the reward: an example to copy."""

    memory: Path = option(positional=True, metavar="MEMORY.asm")
    """A calibrated memory of harmless moving, such as asm-gym reproduce safe_training makes: exploration.asm."""
    task: str = option("Lift", check=task_spec)
    """Name of a task."""
    steps: int = 20_000
    """Control steps."""
    limit: float = 0.01
    """Share of steps that may be spent in alarm."""
    rate: float = 5.0
    """How fast the multiplier follows."""
    seed: int = 0
    """Seed of the agent."""
    out: Path = option(Path("runs/lagrangian"), metavar="FOLDER")
    """Folder of the agent and of the multiplier's history."""


def train(args: Args, console: Console) -> LagrangeMultiplier:
    """Trains; leaves ``agent.zip`` and ``multiplier.json`` in the folder."""
    env_id = task_spec(args.task).id
    multiplier = LagrangeMultiplier(args.limit, args.rate)
    env = CostlyReward(NeuralASMSafety(gym.make(env_id), NeuralASM.load(args.memory), on_alarm="hold"))
    try:
        with stage("learning", console, {}):
            rows = min(1000, args.steps)
            agent = PPO("MlpPolicy", env, n_steps=rows, batch_size=rows // 10 or 2, seed=args.seed, device="cpu")
            agent.learn(args.steps, callback=multiplier)
    finally:
        env.close()
    args.out.mkdir(parents=True, exist_ok=True)
    agent.save(args.out / "agent.zip")
    history = [{"steps": n, "cost": cost, "multiplier": value} for n, cost, value in multiplier.history]
    (args.out / "multiplier.json").write_text(json.dumps(history, indent=1) + "\n", encoding="utf-8")
    return multiplier


def train_and_report(args: Args, console: Console) -> None:
    """Trains, and says where the multiplier ended."""
    multiplier = train(args, console)
    console.print(f"multiplier {multiplier.value:.3g} after {args.steps} steps: {args.out / 'multiplier.json'}")


def main(argv: list[str] | None = None) -> int:
    """Trains, and returns the exit code."""
    return run("lagrangian", Args, train_and_report, argv)


if __name__ == "__main__":
    sys.exit(main())
