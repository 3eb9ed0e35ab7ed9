"""What watching costs: ``asm-gym benchmark memory``, against plain torch, and ``asm-gym benchmark safety``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from torch import Tensor

from asm_gym.detection import LATELY, POWER
from asm_gym.episodes import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.collect import collect
from asm_gym.stream import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety

ACTIONS = 7
STEPS = 60


class PlainTorch:
    """One stream watched by the equations of the memory and of its detection, a line of torch each, as one would write.

    Args:
        asm: whose weights it takes.
    """

    def __init__(self, asm: NeuralASM) -> None:
        assert asm.network_ is not None
        assert asm.detector_ is not None
        self.w = {n: torch.tensor(W) for n, W in asm.network_.weights._asdict().items()}
        self.a = {n: torch.tensor(W) for n, W in asm.network_.association._asdict().items()}
        self.pi_z, self.pi_x = asm.prior_precision, asm.sensory_precision
        self.curvature, self.iterations = float(asm.network_.curvature), asm.iterations
        d, s = asm.detector_, asm.senses_
        self.M, self.q, self.gains = (torch.tensor(x, dtype=torch.float32) for x in (d.whitening, d.ceiling, d.gains))
        self.habit, self.bound = torch.tensor(d.habit, dtype=torch.float32), d.bound
        self.mean, self.spread, self.change = (torch.tensor(x) for x in (s.mean, s.spread, s.change))
        self.sensory, self.motor, self.slow = (torch.tensor(i) for i in (asm.spec.sensory, asm.spec.motor, s.slow))
        self.z = torch.zeros(asm.hidden_size)
        self.evidence = torch.zeros(len(self.gains), len(self.sensory))
        self.lately = torch.zeros(asm.hidden_size)
        self.before: Tensor | None = None
        self.earlier: Tensor | None = None
        self.t = 0

    def observe(self, row: NDArray[np.float64]) -> float:
        """The surprise of the next row (D,)."""
        x = torch.from_numpy(row)
        before = x if self.before is None else self.before
        earlier = before if self.earlier is None else self.earlier
        value, step = (x - self.mean) / self.spread, (x - before) / self.change
        last, past = (before - self.mean) / self.spread, ((before - earlier) / self.change)[self.slow]
        u = torch.cat([value[self.motor], torch.ones(1, dtype=x.dtype)]).float()
        delta = step[self.sensory].float()
        senses = torch.cat([value[self.sensory], step[self.slow]]).float()
        inputs = torch.cat([last.float(), delta, past.float(), u])
        w, a = self.w, self.a
        mu = w["W_H"] @ torch.tanh(self.z) + w["W_U"] @ u
        z = mu.clone()
        for _ in range(self.iterations):
            f = torch.tanh(z)
            feedback = w["W_F"].T @ (self.pi_x * (senses - w["W_F"] @ f - w["b_F"]))
            gradient = self.pi_z * (z - mu) - (1 - f * f) * feedback
            z = z - 1.5 / (self.curvature + 0.77 * feedback.abs().max()) * gradient
        units = torch.tanh(a["V"] @ inputs)
        error = delta - a["U"] @ units - a["D"] @ inputs
        error = error * torch.exp(-0.5 * (a["W_S"] @ units + a["b_S"]).clamp(-12.0, 8.0))
        self.t += 1
        whitened = self.M @ (error / torch.sqrt(1 + (error / self.bound) ** 2))
        self.evidence = self.evidence + self.gains[:, None] * (whitened - self.evidence)
        variance = self.gains / (2 - self.gains) * (1 - (1 - self.gains) ** (2 * self.t))
        pooled = ((self.evidence**2 / variance[:, None] / self.q) ** POWER).sum() ** (1 / POWER)
        context = torch.tanh(mu)
        self.lately = self.lately + LATELY * (context - self.lately)
        usual = torch.exp(self.habit[:-1] @ torch.cat([context, self.lately]) + self.habit[-1])
        self.z, self.before, self.earlier = z, x, before
        return float(pooled / usual)


def synthetic(channels: int, episodes: int, skills: int = 1, seed: int = 0) -> list[Episode]:
    """Streams of as many sensory channels in five groups, smooth and noisy, and seven actions."""
    sizes = [len(part) for part in np.array_split(np.arange(channels), 5)]
    spec = StreamSpec(
        (
            *(Channel(f"sense_{g}", n, noise=0.01, group=f"group_{g}") for g, n in enumerate(sizes)),
            Channel("action", ACTIONS, group=MOTOR),
        ),
        dt=0.05,
    )
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(skills, 12, channels))
    made = []
    for n in range(episodes):
        time = np.arange(STEPS)[:, None]
        sources = np.sin(time * rng.uniform(0.05, 0.3, 12) + rng.uniform(0, 6, 12))
        senses = sources @ mixing[n % skills] + 0.01 * rng.normal(size=(STEPS, channels))
        made.append(Episode.from_stream(np.hstack([senses, np.tanh(rng.normal(size=(STEPS, ACTIONS)))]), spec))
    return made


def watching(asm: NeuralASM, episode: Episode, batch: int) -> Callable[[], Any]:
    """Observes the rows of an episode, over and over, in ``batch`` streams at once."""
    rows = [np.repeat(row[None].astype(np.float64), batch, axis=0) for row in episode.stream]
    state, n = asm.initial_state(batch), 0

    def call() -> None:
        nonlocal state, n
        state, _ = asm.observe(state, rows[n % len(rows)])
        n += 1

    return call


def watching_plainly(asm: NeuralASM, episode: Episode) -> Callable[[], Any]:
    """The same in torch, one stream."""
    plain, rows, n = PlainTorch(asm), [row.astype(np.float64) for row in episode.stream], 0

    def call() -> None:
        nonlocal n
        with torch.no_grad():
            plain.observe(rows[n % len(rows)])
        n += 1

    return call


@dataclass
class Memory:
    """What one call of observe() costs, against the same equations written plainly in torch."""

    hidden: int = 256
    """hidden units"""
    channels: int = 60
    """sensory channels"""
    steps: int = 2000
    """calls of each rival"""
    sweep: bool = True
    """also print the cost against hidden units and channels"""

    def run(self, console: Console, take_turns: Callable[..., dict[str, float]]) -> int:
        """Prints the tables."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            asm, episode = self._fitted(self.hidden, self.channels)
            rivals = {
                "asm_gym, one stream": watching(asm, episode, 1),
                "asm_gym, 64 streams": watching(asm, episode, 64),
                "plain torch, one stream": watching_plainly(asm, episode),
            }
            seconds = take_turns(rivals, self.steps, console)
        finally:
            torch.set_num_threads(threads)
        seconds["asm_gym, 64 streams"] /= 64
        title = f"{self.hidden} hidden units, {self.channels} channels, {asm.iterations} iterations: a stream's row"
        table = _table(title, "", "µs", "against torch")
        for name, s in seconds.items():
            table.add_row(name, f"{1e6 * s:.0f}", f"{seconds['plain torch, one stream'] / s:.1f}×")
        console.print(table)
        if self.sweep:
            self._sweep(console, take_turns)
        return 0

    def _sweep(self, console: Console, take_turns: Callable[..., dict[str, float]]) -> None:
        for what, sizes in (("hidden units", (64, 256, 1024, 2048)), ("channels", (15, 30, 60, 120))):
            rivals = {}
            for size in sizes:
                hidden, channels = (size, self.channels) if what == "hidden units" else (self.hidden, size)
                rivals[str(size)] = watching(*self._fitted(hidden, channels), 1)
            table = _table(f"one stream, by {what}", what, "µs", f"against {sizes[0]}")
            seconds = take_turns(rivals, max(1, self.steps // 4), console)
            for name, s in seconds.items():
                table.add_row(name, f"{1e6 * s:.0f}", f"{s / seconds[str(sizes[0])]:.1f}×")
            console.print(table)

    @staticmethod
    def _fitted(hidden: int, channels: int) -> tuple[NeuralASM, Episode]:
        episodes = synthetic(channels, 10)
        return NeuralASM(episodes[0].spec, hidden_size=hidden, epochs=1).fit(episodes[:8]), episodes[-1]


@dataclass
class Safety:
    """What the safety wrapper adds to a control step, at the control rate and within control steps."""

    task: str = "Lift"
    """a task's name"""
    hidden: int = 256
    """hidden units of the memory"""
    steps: int = 400
    """control steps of each rival"""
    monitor_freq: int = 100
    """rows watched a second, where it watches within control steps [Hz]"""

    def run(self, console: Console, take_turns: Callable[..., dict[str, float]]) -> int:
        """Prints the table."""
        plain = self._make(None)
        envs = {"step": plain, "step under the wrapper": NeuralASMSafety(self._make(None), self._memory(None))}
        rate = self.monitor_freq
        watched = NeuralASMSafety(self._make(rate), self._memory(rate), monitor_freq=rate)
        envs |= {f"step, stream at {rate} Hz": self._make(rate), f"step under the wrapper at {rate} Hz": watched}
        action = np.zeros(plain.action_space.shape or (), np.float32)
        for env in envs.values():
            env.reset(seed=0)
        rivals = {name: partial(env.step, action) for name, env in envs.items()}
        seconds = take_turns(rivals, self.steps, console)
        table = _table(f"{self.task}, 20 Hz, {self.hidden} hidden units: a control step", "", "ms", "against step")
        for name, s in seconds.items():
            table.add_row(name, f"{1e3 * s:.2f}", f"{s / seconds['step']:.2f}×")
        console.print(table)
        return 0

    def _make(self, rate: int | None) -> gym.Env[Any, Any]:
        env_id = f"asm_gym/{self.task}-v0"
        return gym.make(env_id, horizon=10**9, stream_freq=rate, disable_env_checker=True)

    def _memory(self, rate: int | None) -> NeuralASM:
        """One that has learned little, and whose threshold is out of reach: the cost is the same."""
        env_id = f"asm_gym/{self.task}-v0"
        episodes = collect(env_id, episodes=4, workers=1, horizon=40, stream_freq=rate)
        asm = NeuralASM(episodes[0].spec, hidden_size=self.hidden, epochs=1).fit(episodes)
        asm.threshold_ = np.inf
        return asm


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title)
    for column in columns:
        table.add_column(column, justify="right" if table.columns else "left", no_wrap=True)
    return table
