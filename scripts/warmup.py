"""Compiles what runs in every step, once on this machine, so that the first guarded step does not wait for it."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from asm_gym.compilation import kept_in
from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.fused import _observe
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety


@dataclass(frozen=True)
class Args:
    """What compiles takes no options."""


def learn() -> None:
    """What ``fit`` and ``calibrate`` call."""
    spec = StreamSpec((Channel("x", 3, group="joint"), Channel("u", 1, group="action")), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(30, 4)), spec) for _ in range(8)]
    small = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:4])
    small.calibrate(episodes[4:], false_alarm_rate=0.5)


def watch() -> None:
    """What ``observe`` of a shipped memory calls, of one stream and of several."""
    asm = NeuralASM.pretrained("panda")
    for batch in (1, 2):
        asm.observe(asm.initial_state(batch), np.zeros((batch, asm.spec.size)))


def simulate(guarded: bool = False) -> None:
    """What a step of an environment of this package calls."""
    env: gym.Env[Any, Any] = gym.make("asm_gym/Lift-v0")
    with NeuralASMSafety(env, on_overrun="ignore") if guarded else env:
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.zeros(env.unwrapped.action_space.shape or (), np.float32))


@contextmanager
def beside(function: str) -> Iterator[None]:
    """Another process runs a function of this module meanwhile; what it fails at is compiled here, and says so."""
    command = [sys.executable, "-c", f"from asm_gym.scripts.warmup import {function}; {function}()"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
        process.wait()
    finally:
        process.kill()


def warm_up(args: Args, console: Console) -> None:
    """Compiles each part, the simulation on another core, and says where it is kept."""
    simulated = find_spec("robosuite") is not None
    start = time.perf_counter()

    def timed(name: str, part: Callable[[], None]) -> None:
        with stage(f"compiling {name}", console, {}) as progress:
            part()
            progress(1, 1)

    with beside("simulate") if simulated else nullcontext():
        timed("watching", watch)
        timed("learning", learn)
    if simulated:
        timed("guarded steps of robosuite", partial(simulate, guarded=True))
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    say(f"Compiled after {time.perf_counter() - start:.0f} s; kept in {kept_in(_observe) or 'memory only'}")


def main(argv: list[str] | None = None) -> int:
    """Compiles, and returns the exit code."""
    return run("warmup", Args, warm_up, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
