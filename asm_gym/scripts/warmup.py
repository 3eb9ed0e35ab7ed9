"""Compile the code of every step once on this machine, so that the first guarded step does not wait for it."""

from __future__ import annotations

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
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety


@dataclass(frozen=True)
class Args:
    """There are no options."""


def warm_up(args: Args, console: Console) -> None:
    """Compile memory and simulation in two processes (plain ones: the core has no loky), and print where it is kept."""
    seconds: dict[str, float] = {}
    with (
        stage("compiling", console, seconds) as progress,
        ProcessPoolExecutor(2, get_context("spawn")) as processes,
    ):
        for done, part in enumerate(as_completed(map(processes.submit, (_learn, _step))), 1):
            part.result()
            progress(done, 3)
        _step(NeuralASMSafety)
        progress(3, 3)
    where = kept_in(observe_rows) or "memory only"
    console.print(
        f"Compiled after {sum(seconds.values()):.0f} s; kept in {where}",
        soft_wrap=True,
        markup=False,
    )


def _learn() -> None:
    asm = NeuralASM.pretrained("panda")
    for batch in (1, 2):
        asm.observe(asm.initial_state(batch), np.zeros((batch, asm.spec.size)))
    guard = Guard(RobotFacts.unknown(asm.spec), asm, GuardOptions("monitor"))
    guard.begin()
    nothing = np.zeros((1, asm.spec.motor.size), np.float32)
    guard.judge(SensedRows(np.zeros((1, asm.spec.size), np.float32)), nothing)
    spec = StreamSpec((Channel("x", 3, group="joint"), Channel("u", 1, group="action")), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(30, 4)), spec) for _ in range(8)]
    small = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:4])
    small.calibrate(episodes[4:], false_alarm_rate=0.5)


def _step(around: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] = lambda env: env) -> None:
    if find_spec("robosuite"):
        with around(gym.make("asm_gym/Lift-v0")) as env:
            env.reset(seed=0)
            arm: Any = env.unwrapped
            arm.contact_limits = arm.contact_limits or ContactLimits()
            for _ in range(3):
                env.step(np.zeros(env.action_space.shape or (), np.float32))


main = partial(run, "warmup", Args, warm_up)
