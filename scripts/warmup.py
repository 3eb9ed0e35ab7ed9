"""Compile the code of every step once on this machine, so that the first guarded step does not wait for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
from rich.console import Console

from asm_gym.compilation import kept_in
from asm_gym.data.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.row_kernel import expect_rows
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety


@dataclass(frozen=True)
class Args:
    """There are no options."""


def warm_up(args: Args, console: Console) -> None:
    """Observe, learn and guard a little, and print where the compiled code is kept."""
    seconds: dict[str, float] = {}
    for name, work in {"memory": _observe, "learning": _learn, "simulation and guard": _guard}.items():
        with stage(name, console, seconds) as progress:
            work(progress)
    where = kept_in(expect_rows) or "memory only"
    console.print(f"Compiled after {sum(seconds.values()):.0f} s; kept in {where}", soft_wrap=True, markup=False)


def _observe(progress: Progress) -> None:
    asm = NeuralASM.pretrained("panda")
    for batch in (1, 2):
        asm.observe(asm.initial_state(batch), np.zeros((batch, asm.spec.size)))
        progress(batch, 2)


def _learn(progress: Progress) -> None:
    spec = StreamSpec((Channel("x", 3, group="joint"), Channel("u", 1, group="action")), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(30, 4)), spec) for _ in range(8)]
    small = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:4], progress)
    small.calibrate(episodes[4:], false_alarm_rate=0.5)


def _guard(progress: Progress) -> None:
    if not find_spec("robosuite"):
        return
    with NeuralASMSafety(gym.make("asm_gym/Lift-v0")) as guarded:
        guarded.reset(seed=0)
        for step in range(3):
            guarded.step(np.zeros(guarded.action_space.shape or (), np.float32))
            progress(step + 1, 3)


main = partial(run, "warmup", Args, warm_up)
