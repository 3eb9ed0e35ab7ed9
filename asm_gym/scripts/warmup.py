"""Compile the code of every step once on this machine, so that the first guarded step does not wait for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from asm_gym.compilation import kept_in
from asm_gym.data.episode import Episode
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.guard import Guard
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.row_kernel import observe_rows
from asm_gym.rollouts.parallel import semaphores_needed
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety


@dataclass(frozen=True)
class Args:
    """There are no options."""


def warm_up(args: Args, console: Console) -> None:
    """Compile memory and simulation in two processes (plain ones: the core has no loky), and print where it is kept."""
    start = time.perf_counter()
    with semaphores_needed():
        executor = ProcessPoolExecutor(2, get_context("spawn"))
    with stage("compiling") as progress, executor as processes:
        parts = [processes.submit(_compile_memory), processes.submit(_compile_simulation)]
        for done, part in enumerate(as_completed(parts), 1):
            part.result()
            progress(done, 3)
        _compile_simulation(NeuralASMSafety)
        progress(3, 3)
    seconds = time.perf_counter() - start
    where = kept_in(observe_rows) or "memory only"
    line = f"Compiled after {seconds:.0f} s; kept in {where}"
    console.print(line, soft_wrap=True, markup=False)


def _compile_memory() -> None:
    """Observe, guard, fit and calibrate a little."""
    memory = NeuralASM.pretrained("panda")
    spec = memory.spec
    for batch in (1, 2):
        memory.observe(memory.initial_state(batch), np.zeros((batch, spec.size)))
    guard = Guard(RobotFacts.unknown(spec), memory, GuardOptions("monitor"))
    guard.begin()
    row = np.zeros((1, spec.size), np.float32)
    action = np.zeros((1, spec.motor.size), np.float32)
    guard.judge(SensedRows(row), action)

    spec = StreamSpec((Channel("x", 3, group="joint"), Channel("u", 1, group="action")), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(30, 4)), spec) for _ in range(8)]
    small = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:4])
    small.calibrate(episodes[4:], false_alarm_rate=0.5)


def _compile_simulation(
    wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] = lambda env: env,
) -> None:
    """Take a few steps of an environment in this wrapper; by default in none."""
    if find_spec("robosuite") is None:
        return
    with wrapper(gym.make("asm_gym/Lift-v0")) as env:
        env.reset(seed=0)
        arm: Any = env.unwrapped
        arm.contact_limits = arm.contact_limits or ContactLimits()
        action = np.zeros(env.action_space.shape or (), np.float32)
        for _ in range(3):
            env.step(action)


main = partial(run, "warmup", Args, warm_up)
