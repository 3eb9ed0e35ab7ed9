"""``asm-gym benchmark memory``: what a row costs, against plain torch and ONNX Runtime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from asm_gym.detection.evidence import CONTEXT_GAIN, POWER
from asm_gym.detection.repetition import evidence_steps
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.episode import Episode
from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.memory.state import UNSURE
from asm_gym.memory.traces import DECAYS
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.benchmark.turns import again, take_turns
from asm_gym.spec import MOTOR, Channel, StreamSpec

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
        d, s = asm.detector_, asm.senses_
        found = d.whitening, d.ceiling, d.tail, d.gains
        self.M, self.q, self.kappa, self.gains = (torch.tensor(x, dtype=torch.float32) for x in found)
        self.usual, self.bound = torch.tensor(d.context_quantile, dtype=torch.float32), d.bound
        self.lowest, self.highest = map(float, d.context_range)
        self.mean, self.spread, self.change = (torch.tensor(x) for x in (s.mean, s.spread, s.change))
        self.sensory, self.motor, self.slow = (torch.tensor(i) for i in (asm.spec.sensory, asm.spec.motor, s.slow))
        self.decays = torch.tensor(DECAYS)
        self.traces = torch.tensor(asm.network_.at_rest(1)).reshape(len(DECAYS), -1)
        self.evidence = torch.zeros(len(self.gains), len(self.sensory))
        self.lately = torch.zeros(asm.hidden_size)
        counted = asm.learned_["repetition"]
        self.steps = torch.tensor(evidence_steps(counted[:2]), dtype=torch.float32)
        self.offset = torch.tensor(counted[2], dtype=torch.float32)
        self.again, self.unlikely = torch.zeros(len(self.sensory), dtype=torch.bool), torch.zeros(len(self.sensory))
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
        mu = w["W_C"] @ self.traces.flatten()
        self.traces = self.decays[:, None] * self.traces + w["gains"][:, None] * torch.cat([senses, u])
        units = torch.tanh(a["V"] @ inputs)
        error = delta - a["U"] @ units - a["D"] @ inputs
        error = error / a["remainder"] * torch.exp(-0.5 * (a["W_S"] @ units + a["b_S"]).clamp(*a["span_S"]))
        again = x[self.sensory] == before[self.sensory]
        if self.before is None:
            error, again = torch.zeros_like(error), torch.zeros_like(again)
        elif self.t == 1:
            error = float(UNSURE) * error
        changed, same = torch.where(self.again, self.steps[1], self.steps[0])
        self.unlikely, self.again = (self.unlikely + torch.where(again, same, changed)).clamp(min=0.0), again
        self.t += 1
        whitened = self.M @ (error / torch.sqrt(1 + (error / self.bound) ** 2))
        self.evidence = self.evidence + self.gains[:, None] * (whitened - self.evidence)
        variance = self.gains / (2 - self.gains) * (1 - (1 - self.gains) ** (2 * self.t))
        ratios = (self.evidence**2 / variance[:, None] / self.q) ** self.kappa
        pooled = (ratios**POWER).sum() ** (1 / POWER)
        context = torch.tanh(mu)
        self.lately = self.lately + CONTEXT_GAIN * (context - self.lately)
        drive = self.usual[:-1] @ torch.cat([context, self.lately]) + self.usual[-1]
        usual = torch.exp(drive.clamp(self.lowest, self.highest))
        self.before, self.earlier = x, before
        repeated = (self.unlikely > 0) * torch.exp(TAIL_INDEX * (self.unlikely - self.offset))
        return float(((pooled / usual) ** POWER + (repeated**POWER).sum()) ** (1 / POWER))


def synthetic(channels: int, episodes: int, skills: int = 1, seed: int = 0, dt: float = 0.05) -> list[Episode]:
    """Streams of as many sensory channels in five groups, smooth and noisy, and seven actions."""
    sizes = [len(part) for part in np.array_split(np.arange(channels), 5)]
    spec = StreamSpec(
        (
            *(Channel(f"sense_{g}", n, noise=0.01, group=f"group_{g}") for g, n in enumerate(sizes)),
            Channel("action", ACTIONS, group=MOTOR),
        ),
        dt=dt,
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


def _fitted(hidden: int, channels: int, skills: int = 1) -> tuple[NeuralASM, Episode]:
    """A memory that has learned little: the cost is the same. It names skills where there are several."""
    episodes = synthetic(channels, max(10, skills + 2), skills)
    asm = NeuralASM(episodes[0].spec, hidden_size=hidden, epochs=1).fit(episodes[:-2])
    if skills > 1:
        asm.name_skills([replace(e, info={"skill": str(n % skills)}) for n, e in enumerate(episodes[:-2])])
    return asm, episodes[-1]


@dataclass
class MemoryCost:
    """What one call of observe() costs, against the same equations written plainly in torch."""

    hidden: int = 256
    """Hidden units."""
    channels: int = 60
    """Sensory channels."""
    steps: int = 2000
    """Calls of each rival."""
    sweep: bool = True
    """Also print the cost against hidden units, channels and named skills."""
    even_if_busy: bool = False
    """Print figures though the machine has too much else to do."""

    def run(self, console: Console) -> int:
        """Prints the tables."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            asm, episode = _fitted(self.hidden, self.channels)
            rivals = {
                "asm_gym, one stream, others between": watching(asm, episode, 1),
                "asm_gym, 64 streams": watching(asm, episode, 64),
                "plain torch, one stream": watching_plainly(asm, episode),
            }
            turns = take_turns(rivals, self.steps, console, self.even_if_busy)
        finally:
            torch.set_num_threads(threads)
        turns.seconds["asm_gym, 64 streams"] /= 64
        title = f"{self.hidden} hidden units, {self.channels} channels: a stream's row, of which nothing is missing"
        # Called again and again while everything is in the cache, as no rival that takes turns is.
        turns.seconds["asm_gym, one stream, warm"] = again(watching(asm, episode, 1), self.steps)
        plain = "plain torch, one stream"
        rows = [
            (name, *(f"{1e6 * turns.quantile(name, q):.0f}" for q in (0.5, 0.99, 0.999)), turns.faster(name, plain))
            for name in turns.seconds
        ]
        console.print(ConsoleTable(Table(title, ("", "µs", "p99", "p99.9", "against torch"), rows)))
        console.print(turns.where())
        if self.sweep:
            self._sweep(console)
        return 0

    def _sweep(self, console: Console) -> None:
        makers: dict[str, tuple[Callable[[int], tuple[NeuralASM, Episode]], tuple[int, ...]]] = {
            "hidden units": (lambda n: _fitted(n, self.channels), (64, 256, 1024, 2048)),
            "channels": (lambda n: _fitted(self.hidden, n), (15, 30, 60, 120)),
            "skills": (lambda n: _fitted(self.hidden, self.channels, n), (2, 8, 32, 128)),
        }
        for what, (make, sizes) in makers.items():
            rivals = {str(size): watching(*make(size), 1) for size in sizes}
            turns = take_turns(rivals, max(1, self.steps // 4), console, self.even_if_busy)
            rows = [(name, f"{1e6 * turns.median(name):.0f}", turns.times(name, str(sizes[0]))) for name in rivals]
            console.print(ConsoleTable(Table(f"one stream, by {what}", (what, "µs", f"against {sizes[0]}"), rows)))
