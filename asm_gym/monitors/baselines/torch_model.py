"""What the baselines that need torch share: a network trained by backpropagation, kept as arrays."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.learning import shuffled
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.scaling import ScaledRows, StreamScaler


class TorchModel(StreamModel):
    """A model that is a torch module.

    Attributes:
        senses_: how it reads a row, which is as the Neural ASM does.
        module_: the network, once it is fitted.
    """

    device: str = "cpu"
    """Where it learns and predicts, in PyTorch's words; no file keeps it."""

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

    def to(self, device: str) -> Self:
        """Learns and predicts there from now on, as in ``cuda``. Raises ValueError where there is no such device."""
        try:
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError) as error:  # a build without CUDA asserts
            raise ValueError(f"device {device!r} cannot be used: {str(error).splitlines()[0]}") from error
        self.device = device
        if hasattr(self, "module_"):
            self.module_.to(device)
        return self

    def placed(self) -> AbstractContextManager[Any]:
        """In which tensors are made on the device; nothing on a CPU, where the context would cost every call."""
        return nullcontext() if self.device == "cpu" else torch.device(self.device)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # as for every other monitor, so that times compare
        try:
            with torch.random.fork_rng(devices=[]), self.placed():
                torch.manual_seed(int(rng.integers(2**31)))
                module = self.module(senses)
                self.train(module, [senses.read_episode(s) for s in streams], rng, progress)
        finally:
            torch.set_num_threads(threads)
        weights = {name: tensor.cpu().numpy() for name, tensor in module.state_dict().items()}
        return self.restore({**senses.arrays, **weights})

    def predict(self, state: Any, rows: NDArray[np.float64]) -> tuple[Any, ModelOutput]:
        with self.placed():
            return self.advance(state, rows)

    @abstractmethod
    def advance(self, state: Any, rows: NDArray[np.float64]) -> tuple[Any, ModelOutput]:
        """As ``Model.predict``: on from the state by rows (B, D)."""

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler.of(self.spec, learned)
        with torch.random.fork_rng(devices=[]), self.placed():
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


FRESH = 5
"""One in so many episodes is not trained on, but says when to stop."""

PATIENCE, SLOWER, SLOWEST = 5, 0.3, 3e-5
"""Epochs without a gain after which the step size is cut to a share; below the smallest, training has converged."""


def parted(episodes: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which episodes to train on, and which say when to stop; all of them do where they are too few to part."""
    order = rng.permutation(episodes).astype(np.intp)
    kept = episodes // FRESH
    return order[kept:], order[:kept] if kept else order


def converge(
    module: nn.Module,
    epoch: Callable[[torch.optim.Optimizer], None],
    fresh: Callable[[], Tensor],
    most: int,
    tell: Callable[[int, int], object],
    rate: float = 1e-3,
) -> None:
    """Adam, slowed down at every plateau of the fresh loss, until the smallest step brings no gain; keeps the best.

    Args:
        epoch: trains once on everything.
        fresh: the loss in episodes that are not trained on.
        most: epochs.
    """
    optimiser = torch.optim.Adam(module.parameters(), rate)
    plateaus = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=SLOWER, patience=PATIENCE)
    best, kept = math.inf, copy.deepcopy(module.state_dict())
    for n in range(most):
        tell(n, most)
        epoch(optimiser)
        with torch.no_grad():
            now = float(fresh())
        if now < best:
            best, kept = now, copy.deepcopy(module.state_dict())
        plateaus.step(now)
        if optimiser.param_groups[0]["lr"] < SLOWEST:
            break
    module.load_state_dict(kept)


def descend(loss: Tensor, optimiser: torch.optim.Optimizer, schedule: Any = None, clip: float = 1.0) -> None:
    """One update, its gradient cut off at ``clip``."""
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_([p for group in optimiser.param_groups for p in group["params"]], clip)
    optimiser.step()
    if schedule is not None:
        schedule.step()


def padded(episodes: Sequence[NDArray[np.float32]]) -> tuple[Tensor, Tensor]:
    """Episodes (T, N) side by side (B, longest, N), and 1 where there is a step (B, longest)."""
    longest = max(map(len, episodes))
    rows = np.zeros((len(episodes), longest, episodes[0].shape[1]), np.float32)
    real = np.zeros((len(episodes), longest), np.float32)
    for n, episode in enumerate(episodes):
        rows[n, : len(episode)] = episode
        real[n, : len(episode)] = 1.0
    return torch.as_tensor(rows), torch.as_tensor(real)


def steps_of(rows: NDArray[np.float32], size: int, updates: int, rng: np.random.Generator) -> Iterator[Tensor]:
    """``updates`` random batches of ``rows`` (N, …)."""
    for _, chosen in zip(range(updates), shuffled(len(rows), size, rng), strict=False):
        yield torch.as_tensor(rows[chosen])
