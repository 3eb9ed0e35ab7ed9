"""``asm-gym benchmark fit``: what learning costs, the memory against a GRU trained by backpropagation through time."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.episode import Episode
from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.memory.association import complete, hidden_units
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.monitors.baselines.gru import GRU
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.rollouts.collect import collect
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.benchmark.turns import check_quiet, machine
from asm_gym.validation import check_number

HELD_OUT = 6
"""One in so many episodes is not learned but tested on."""


@dataclass
class FitCost:
    """How long a memory takes to learn some skills, and how far off its expectations are, against a GRU."""

    tasks: tuple[str, ...] = ("Lift", "Stack", "PickPlaceCan")
    """Names of tasks."""
    episodes: int = 60
    """Episodes of each task to learn from."""
    recorded: int | None = None
    """Episodes of each task to record; the others repeat them with sensor noise of their own, for what learning costs
    depends on how many there are. All by default."""
    rival: bool = True
    """Also fit the GRU."""
    seed: int = 0
    """Seed of the episodes and of both monitors."""
    even_if_busy: bool = False
    """Print figures though the machine has too much else to do."""

    def __post_init__(self) -> None:
        check_number("episodes", self.episodes, low=1, whole=True)
        if self.recorded is not None:
            check_number("recorded", self.recorded, low=1, high=self.episodes, whole=True)

    def run(self, console: Console) -> int:
        """Prints the table."""
        recorded = self.recorded or self.episodes
        seconds: dict[str, float] = {}
        learned: list[Episode] = []
        held_out: list[Episode] = []
        for task in self.tasks:
            with stage(f"recording {task}", console, seconds) as progress:
                extra = -(-recorded // (HELD_OUT - 1))
                made = collect(f"asm_gym/{task}-v0", episodes=recorded + extra, seed=self.seed, progress=progress)
            held_out += made[::HELD_OUT]
            learned += repeated([e for n, e in enumerate(made) if n % HELD_OUT], self.episodes, self.seed)
        rows: dict[str, tuple[float, float]] = {}
        NeuralASM(learned[0].spec, epochs=1).fit(learned[:4])  # compiles
        shares = []
        for name in ("neural_asm", "gru") if self.rival else ("neural_asm",):
            with stage(f"fitting {name}", console, seconds) as progress:
                start, wall = time.process_time(), time.perf_counter()
                fitted: Any = make_monitor(name, learned[0].spec, seed=self.seed).fit(learned, progress)
                spent = time.process_time() - start
                shares.append(spent / (time.perf_counter() - wall))
            rows[name] = spent, float(np.median(np.abs(np.concatenate(errors(fitted.model, held_out)))))
        share = min(shares)
        if not self.even_if_busy:
            check_quiet(share, os.getloadavg()[0], os.cpu_count() or 1)
        against = {name: (f"{t / rows['gru'][0]:.2f}×",) if self.rival else () for name, (t, _) in rows.items()}
        table = Table(
            f"{len(learned)} episodes of {', '.join(self.tasks)}, {sum(map(len, learned))} rows, one core",
            ("", "s", *(("against the GRU",) if self.rival else ()), "median error of a step [sd of the change]"),
            [(name, f"{t:.0f}", *against[name], f"{off:.3f}") for name, (t, off) in rows.items()],
        )
        console.print(ConsoleTable(table))
        if recorded < self.episodes:
            console.print(f"Of each task {recorded} episodes were recorded; the others repeat them with other noise.")
        console.print(
            "The memory expects each group of senses from what the others do in the same step, the GRU from the past "
            "alone: the errors are of different questions."
        )
        console.print(machine(share))
        return 0


def repeated(episodes: Sequence[Episode], count: int, seed: int) -> list[Episode]:
    """``count`` episodes: these, and then these again and again, each with sensor noise of its own."""
    rng, made = np.random.default_rng(seed), list(episodes[:count])
    while len(made) < count:
        again = episodes[len(made) % len(episodes)]
        noise = (rng.normal(size=again.stream.shape) * again.spec.noise).astype(np.float32)
        made.append(replace(again, stream=again.stream + noise))
    return made


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
