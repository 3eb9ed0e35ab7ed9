"""Speeds as ratios against a rival in the same run.

Machines differ and are noisy: rivals take turns, step by step, and the medians of their turns are compared.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from rich.console import Console

import asm_gym  # noqa: F401  (registers the environments)
from asm_gym.envs.backend import import_robosuite
from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.scripts.benchmark.memory import MemoryCost
from asm_gym.scripts.benchmark.safety import Safety
from asm_gym.scripts.benchmark.turns import BusyError, take_turns
from asm_gym.scripts.benchmark.vector import vector_table
from asm_gym.scripts.cli import usage
from asm_gym.scripts.command import BAD_NEWS, DONE, exit_code, run
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice, check_number


@dataclass
class Env:
    """An environment's steps and resets, against robosuite's own and against MuJoCo alone."""

    task: str = "Lift"
    """Name of the task."""
    robot: str = "Panda"
    """The arm, and its twin where the task takes two."""
    controller: str = "OSC_POSE"
    """The arm's controller."""
    steps: int = 400
    """Control steps of each rival."""
    resets: int = 10
    """Resets of each rival."""
    members: tuple[int, ...] = (1, 2, 4, 8, 16)
    """How many environments side by side, on threads and in processes; none for no such table."""
    seed: int = 0
    """Seed of the actions."""
    even_if_busy: bool = False
    """Print figures though the machine has too much else to do."""

    def __post_init__(self) -> None:
        for n in self.members:
            check_number("members", n, low=1, high=256, whole=True)

    def run(self, console: Console) -> int:
        """Prints the tables."""
        steps = take_turns(self._rivals(), self.steps, console, self.even_if_busy)
        table = Table(
            f"{self.task}, {self.robot}, {self.controller}, 20 Hz: median of {self.steps} control steps",
            ("", "ms", "steps/s", "against robosuite", "against mj_step"),
            [
                (
                    name,
                    f"{1e3 * steps.median(name):.2f}",
                    f"{1 / steps.median(name):.0f}",
                    steps.faster(name, "robosuite"),
                    steps.times(name, "mj_step only"),
                )
                for name in steps.seconds
            ],
        )
        console.print(ConsoleTable(table))
        resets, default = (
            take_turns(self._resets(), self.resets, console, self.even_if_busy),
            "robosuite, hard (its default)",
        )
        rows = [(name, f"{1e3 * resets.median(name):.1f}", resets.faster(name, default)) for name in resets.seconds]
        console.print(ConsoleTable(Table(f"median of {self.resets} resets", ("", "ms", "against robosuite"), rows)))
        if self.members:
            vector = vector_table(self._made, self.members, max(1, self.steps // 4), console, self.even_if_busy)
            console.print(ConsoleTable(vector))
        console.print(steps.where())
        return DONE

    def _made(self, **kwargs: Any) -> gym.Env[Any, Any]:
        kwargs |= {"robot": self.robot, "controller": self.controller, "horizon": 10**9}
        return gym.make(f"asm_gym/{self.task}-v0", disable_env_checker=True, **kwargs)

    def _make(self, **kwargs: Any) -> Any:
        env = self._made(**kwargs).unwrapped
        env.reset(seed=self.seed)
        return env

    def _robosuite(self, **kwargs: Any) -> Any:
        robosuite = import_robosuite()
        configuration = robosuite.load_composite_controller_config(robot=self.robot)
        if self.controller != "OSC_POSE":
            part = robosuite.load_part_controller_config(default_controller=self.controller)
            configuration["body_parts"]["arms"] = {"right": part | {"gripper": {"type": "GRIP"}}}
        arms = task_spec(self.task).arms
        env = robosuite.make(
            self.task,
            robots=[self.robot] * arms,
            controller_configs=[configuration] * arms,
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            reward_shaping=True,
            ignore_done=True,
            **kwargs,
        )
        env.reset()
        return env

    def _rivals(self) -> dict[str, Callable[[], Any]]:
        ours, bare = self._make(), self._make(stream=(), sensor_noise=0.0)
        theirs, wrapped = self._robosuite(), self._wrapped()
        rng = np.random.default_rng(self.seed)
        size = ours.action_space.shape[0]

        def drive(step: Callable[[Any], Any]) -> Callable[[], Any]:
            # Held for a while, as a policy's actions are: noise alone would keep the arm in place.
            actions = np.repeat(rng.uniform(-0.3, 0.3, (2 + self.steps // 20, size)), 20, axis=0).astype(np.float32)
            turns = iter(actions)
            return lambda: step(next(turns))

        floor = self._make()

        def physics() -> None:
            mujoco.mj_step(floor.simulation.model, floor.simulation.data, floor.substeps)

        return {
            "asm_gym": drive(ours.step),
            "asm_gym, no stream": drive(bare.step),
            "robosuite": drive(theirs.step),
            "robosuite GymWrapper": drive(wrapped.step),
            "mj_step only": physics,
        }

    def _wrapped(self) -> Any:
        from robosuite.wrappers import GymWrapper

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it makes its spaces with the wrong dtype, and Gymnasium says so
            wrapped = GymWrapper(self._robosuite())
        wrapped.reset()
        return wrapped

    def _resets(self) -> dict[str, Callable[[], Any]]:
        ours, seeds = self._make(), iter(range(10**6))
        return {
            "asm_gym, unseeded": ours.reset,
            "asm_gym, seeded": lambda: ours.reset(seed=next(seeds)),
            "robosuite, hard (its default)": self._robosuite().reset,
            "robosuite, hard_reset=False": self._robosuite(hard_reset=False).reset,
        }


BENCHMARKS: dict[str, type[Any]] = {
    "env": Env,
    "memory": MemoryCost,
    "safety": Safety,
}


def measure(args: Any, console: Console) -> int:
    """Runs the one that was asked for."""
    try:
        code: int = args.run(console)
    except BusyError as busy:
        console.print(str(busy))
        return BAD_NEWS
    return code


def main(argv: list[str] | None = None) -> int:
    """Runs one benchmark, and returns the exit code."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage("asm-gym benchmark WHAT", {n: (k.__doc__ or "").partition("\n")[0] for n, k in BENCHMARKS.items()}))
        return DONE

    def chosen() -> int:
        check_choice("benchmark", name, BENCHMARKS)
        return run(f"benchmark {name}", BENCHMARKS[name], measure, rest)

    return exit_code("benchmark", chosen)


if __name__ == "__main__":
    sys.exit(main())
