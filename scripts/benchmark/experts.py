"""How often the scripted experts succeed, hit something or meet a stop: ``asm-gym benchmark experts``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from asm_gym.detection.events import NEAR_STOP
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.policies import make_policy, rollout
from asm_gym.policies.registry import EXPERTS
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.staging import environment
from asm_gym.tasks import ROBOTS
from asm_gym.validation import check_choice

_QUICK = 5

HIT = 60.0
"""Contact [N] above which nobody does it on purpose."""


class Attempt(NamedTuple):
    """What became of one episode."""

    solved: bool  # at some step
    held: bool  # at the last step, too
    steps: int  # until it was solved, or all of them
    force: float  # the largest contact force on an arm [N]
    room: float  # what was left of an arm's joint to its nearest stop, at least [rad]


def room_to_the_stops(env: Any) -> float:
    """How far the arms' joint nearest to one of its stops is from it [rad]; joints without stops are left out."""
    simulation = env.unwrapped.simulation
    names = [name for robot in env.unwrapped.robosuite_env.robots for name in robot.robot_joints]
    arms = [joint for joint in map(simulation.model.joint, names) if simulation.model.jnt_limited[joint.id]]
    angles = np.array([simulation.data.joint(joint.name).qpos[0] for joint in arms])
    low, high = np.array([joint.range for joint in arms]).T
    return float(np.minimum(angles - low, high - angles).min())


def attempt(seed: int, task: str, robot: str) -> Attempt:
    """The scripted expert's episode of ``seed``, which also is the expert's own seed."""
    env: Any = environment(f"asm_gym/{task}-v0", (("robot", robot), ("stream", ())))
    success: list[bool] = []
    force: list[float] = []
    room: list[float] = []

    def note(info: dict[str, Any]) -> None:
        success.append(bool(info["success"]))
        force.append(float(info["contact_force"]))
        room.append(room_to_the_stops(env))

    solved = rollout(env, make_policy("scripted", env, seed=seed), seed, note)
    steps = success.index(True) + 1 if solved else len(success)
    return Attempt(solved, success[-1], steps, float(np.nanmax(force)), min(room))


@dataclass
class Experts:
    """How often each scripted expert succeeds, leaves the task solved, hits something or meets a stop, and how fast."""

    tasks: tuple[str, ...] = tuple(EXPERTS)
    """Names of tasks."""
    robots: tuple[str, ...] = ("Panda",)
    """The arms; two of one kind where the task takes two."""
    episodes: int = 100
    """Episodes of each task and robot."""
    workers: int = 2
    """Processes."""
    seed: int = 0
    """Seed of the episodes."""
    quick: bool = False
    """Five episodes each."""

    def __post_init__(self) -> None:
        for name in self.tasks:
            check_choice("task", name, tuple(EXPERTS))
        for robot in self.robots:
            check_choice("robot", robot, ROBOTS)
        for count in ("episodes", "workers"):
            if getattr(self, count) < 1:
                raise ValueError(f"{count} must be at least 1, got {getattr(self, count)}")

    def run(self, console: Console) -> int:
        """Prints a row for each task and robot."""
        seeds = episode_seeds(self.seed, min(self.episodes, _QUICK) if self.quick else self.episodes)
        rows = []
        for name in self.tasks:
            for robot in self.robots:
                with stage(f"{name}, {robot}", console, {}) as progress:
                    attempts = parallel_map(partial(attempt, task=name, robot=robot), seeds, self.workers, progress)
                rows.append((name, robot, *_row(attempts)))
        headings = ("task", "robot", "solved", "95 %", "held", "steps", "force", "hit", "stop")
        console.print(ConsoleTable(Table(f"scripted experts, seeds of {self.seed}", headings, rows), left=2))
        console.print(
            "held: also at the last step; steps: mean until solved; force: median largest [N]; hit: solved with a "
            f"contact above {HIT:g} N; stop: solved with a joint within {NEAR_STOP:g} rad of its stop"
        )
        return 0


def _row(attempts: list[Attempt]) -> tuple[str, ...]:
    share = Share.of([a.solved for a in attempts])
    low, high = share.interval
    steps = [a.steps for a in attempts if a.solved]
    return (
        f"{share.k} of {share.n}",
        f"{100 * low:.0f} to {100 * high:.0f} %",
        str(sum(a.held for a in attempts)),
        f"{np.mean(steps):.0f}" if steps else "",
        f"{np.median([a.force for a in attempts]):.0f}",
        str(sum(a.solved and a.force > HIT for a in attempts)),
        str(sum(a.solved and a.room < NEAR_STOP for a in attempts)),
    )
