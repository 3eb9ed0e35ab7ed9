"""``asm-gym benchmark fit``: what learning costs, the memory against a GRU trained by backpropagation through time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.episodes import Episode
from asm_gym.evaluation.tables import Table, console_table
from asm_gym.memory.association import complete, hidden_units
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.monitors.baselines.gru import GRU
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.rollouts.collect import collect
from asm_gym.rollouts.progress import stage

HELD_OUT = 6
"""One in so many episodes is not learned but tested on."""


@dataclass
class Fit:
    """How long a memory takes to learn three skills, and how far off its expectations are, against a GRU."""

    tasks: tuple[str, ...] = ("Lift", "Stack", "PickPlaceCan")
    """Names of tasks."""
    episodes: int = 60
    """Episodes of each task."""
    seed: int = 0
    """Seed of the episodes and of both monitors."""

    def run(self, console: Console) -> int:
        """Prints the table."""
        seconds: dict[str, float] = {}
        episodes: list[Episode] = []
        for task in self.tasks:
            with stage(f"recording {task}", console, seconds) as progress:
                extra = -(-self.episodes // (HELD_OUT - 1))
                env_id = f"asm_gym/{task}-v0"
                episodes += collect(env_id, episodes=self.episodes + extra, seed=self.seed, progress=progress)
        learned = [e for n, e in enumerate(episodes) if n % HELD_OUT]
        held_out = [e for n, e in enumerate(episodes) if not n % HELD_OUT]
        rows: dict[str, tuple[float, float]] = {}
        NeuralASM(episodes[0].spec, epochs=1).fit(learned[:4])  # compiles
        for name in ("neural_asm", "gru"):
            with stage(f"fitting {name}", console, seconds) as progress:
                start = time.process_time()
                fitted: Any = make_monitor(name, episodes[0].spec, seed=self.seed).fit(learned, progress)
                spent = time.process_time() - start
            rows[name] = spent, float(np.median(np.abs(np.concatenate(errors(fitted.model, held_out)))))
        table = Table(
            f"{len(learned)} episodes of {', '.join(self.tasks)}, one core",
            ("", "s", "against the GRU", "median error of a step [sd of the change]"),
            [(name, f"{t:.0f}", f"{t / rows['gru'][0]:.2f}×", f"{off:.3f}") for name, (t, off) in rows.items()],
        )
        console.print(console_table(table))
        console.print(
            "The memory expects each group of senses from what the others do in the same step, the GRU from the past "
            "alone: the errors are of different questions."
        )
        return 0


def errors(model: MemoryModel | GRU, episodes: Sequence[Episode]) -> list[NDArray[np.float32]]:
    """Δ - Δ̂ (T - 2, X) of each episode, in standard deviations of the step from row to row."""
    made = []
    for episode in episodes:
        r = model.senses_.read_episode(episode.stream.astype(np.float64))
        if isinstance(model, MemoryModel):
            w = model.network.association
            expected = complete(hidden_units(r.inputs, w.V), r.inputs, w.U, w.D)
        else:
            before = np.hstack([np.vstack([r.senses[:1], r.senses[:-1]]), r.commands])
            with torch.no_grad():
                expected = model.module_(torch.from_numpy(before)[None])[0].numpy()[0]
        made.append((r.changes - expected)[2:])
    return made
