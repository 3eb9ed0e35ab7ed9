"""What the baselines that need torch share: a network trained by backpropagation, kept as arrays."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection.base import Arrays
from asm_gym.episodes import Episode
from asm_gym.memory.learning import shuffled
from asm_gym.monitors.base import Progress
from asm_gym.monitors.model import StreamModel
from asm_gym.scaling import ScaledRows, StreamScaler


class TorchModel(StreamModel):
    """A model that is a torch module.

    Attributes:
        senses_: how it reads a row, which is as the Neural ASM does.
        module_: the network, once it is fitted.
    """

    lag: int = 1
    """How many rows later the change of a row is taken."""

    senses_: StreamScaler
    module_: nn.Module

    @abstractmethod
    def module(self, senses: StreamScaler) -> nn.Module:
        """A fresh network for what is read so."""

    @abstractmethod
    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        """Trains it on whole nominal episodes."""

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams, self.lag)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # as for every other monitor, so that times compare
        try:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(int(rng.integers(2**31)))
                module = self.module(senses)
                self.train(module, [senses.read_episode(s) for s in streams], rng, progress)
        finally:
            torch.set_num_threads(threads)
        standard = {"mean": senses.mean, "spread": senses.spread, "change": senses.change}
        return self.restore({**standard, **{name: tensor.numpy() for name, tensor in module.state_dict().items()}})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler(self.spec, learned["mean"], learned["spread"], learned["change"], self.lag)
        with torch.random.fork_rng(devices=[]):
            module = self.module(senses)
        state = {name: torch.from_numpy(np.array(learned[name], np.float32)) for name in module.state_dict()}
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"the weights of this {self.kind} do not fit: {error}") from error
        self.senses_, self.module_ = senses, module.eval().requires_grad_(False)
        return super().restore(learned, skills)


def adam(module: nn.Module, updates: int, rate: float = 1e-3) -> tuple[torch.optim.Optimizer, Any]:
    """Adam with a cosine decay, the default of those who publish such models."""
    optimiser = torch.optim.Adam(module.parameters(), rate)
    return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)


def descend(loss: Tensor, optimiser: torch.optim.Optimizer, schedule: Any, clip: float = 1.0) -> None:
    """One update, its gradient cut off at ``clip``."""
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_([p for group in optimiser.param_groups for p in group["params"]], clip)
    optimiser.step()
    schedule.step()


def padded(episodes: Sequence[NDArray[np.float32]]) -> tuple[Tensor, Tensor]:
    """Episodes (T, N) side by side (B, longest, N), and 1 where there is a step (B, longest)."""
    longest = max(map(len, episodes))
    rows = np.zeros((len(episodes), longest, episodes[0].shape[1]), np.float32)
    real = np.zeros((len(episodes), longest), np.float32)
    for n, episode in enumerate(episodes):
        rows[n, : len(episode)] = episode
        real[n, : len(episode)] = 1.0
    return torch.from_numpy(rows), torch.from_numpy(real)


def steps_of(rows: NDArray[np.float32], size: int, updates: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """``updates`` random batches of ``rows`` (N, …)."""
    for _, chosen in zip(range(updates), shuffled(len(rows), size, rng), strict=False):
        yield torch.from_numpy(rows[chosen])
