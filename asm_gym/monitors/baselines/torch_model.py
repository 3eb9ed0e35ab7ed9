"""What the baselines that need torch share: a network trained by backpropagation, kept as arrays."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.data.episode import Episode
from asm_gym.detection.base import Arrays
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import ScaledModel
from asm_gym.scaling import ScaledRows, StreamScaler

EPOCHS, BATCH = 200, 16  # passes at most over whole episodes, and episodes side by side
FRESH = 5  # one in so many episodes is not trained on, but says when to stop

PATIENCE, SLOWER, SLOWEST = 5, 0.3, 3e-5
"""Epochs without a gain after which the step size is cut to a share; below the smallest, training has converged."""


class TorchModel(ScaledModel):
    """A model that is a torch module.

    Attributes:
        module_: the network, once it is fitted.
    """

    module_: nn.Module

    @abstractmethod
    def module(self, senses: StreamScaler) -> nn.Module:
        """Return a fresh network."""

    @abstractmethod
    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, progress: Progress
    ) -> None:
        """Train it on whole nominal episodes."""

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # as for every other monitor, so that times compare
        try:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(int(rng.integers(2**31)))
                module = self.module(senses)
                self.train(module, [senses.read_episode(s) for s in streams], rng, progress)
        finally:
            torch.set_num_threads(threads)
        return self.restore({**senses.arrays, **{name: t.numpy() for name, t in module.state_dict().items()}})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler.of(self.spec, learned)
        with torch.random.fork_rng(devices=[]):
            module = self.module(senses)
        state = {name: torch.from_numpy(np.array(learned[name], np.float32)) for name in module.state_dict()}
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"the weights of this {self.kind} do not fit: {error}") from error
        self.module_ = module.eval().requires_grad_(False)
        return super().restore(learned, skills)


def train_on_episodes(
    module: nn.Module,
    loss: Callable[[NDArray[np.intp], bool], Tensor],
    episodes: int,
    rng: np.random.Generator,
    progress: Progress,
) -> None:
    """Train by Adam, slowed down at every plateau of the fresh loss, until no gain is left; keep the best weights.

    Args:
        module: the network.
        loss: of some episodes, by their numbers, while training or not.
        episodes: how many there are. A fifth is not trained on; with fewer than five all are trained on.
        rng: of the order of episodes.
        progress: called with the epochs done, and the most there can be.
    """
    order = rng.permutation(episodes).astype(np.intp)
    kept = episodes // FRESH
    trained, fresh = order[kept:], order[:kept] if kept else order
    optimiser = torch.optim.Adam(module.parameters(), 1e-3)
    plateaus = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=SLOWER, patience=PATIENCE)
    least, best = math.inf, copy.deepcopy(module.state_dict())
    for epoch in range(EPOCHS):
        progress(epoch, EPOCHS)
        order = rng.permutation(trained)
        for start in range(0, len(order), BATCH):
            descend(loss(order[start : start + BATCH], True), optimiser)
        with torch.no_grad():
            now = float(loss(fresh, False))
        if now < least:
            least, best = now, copy.deepcopy(module.state_dict())
        plateaus.step(now)
        if optimiser.param_groups[0]["lr"] < SLOWEST:
            break
    module.load_state_dict(best)


def adam(module: nn.Module, updates: int, rate: float = 1e-3) -> tuple[torch.optim.Optimizer, Any]:
    """Return Adam and its cosine decay, the default of those who publish such models."""
    optimiser = torch.optim.Adam(module.parameters(), rate)
    return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)


def descend(loss: Tensor, optimiser: torch.optim.Optimizer, schedule: Any = None, clip: float = 1.0) -> None:
    """Update once, with the gradient cut off at ``clip``."""
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_([p for group in optimiser.param_groups for p in group["params"]], clip)
    optimiser.step()
    if schedule is not None:
        schedule.step()


def padded(episodes: Sequence[NDArray[np.float32]]) -> tuple[Tensor, Tensor]:
    """Return episodes (T, N) side by side (B, longest, N), and 1 where there is a step (B, longest)."""
    rows = nn.utils.rnn.pad_sequence([torch.as_tensor(e) for e in episodes], batch_first=True)
    real = nn.utils.rnn.pad_sequence([torch.ones(len(e)) for e in episodes], batch_first=True)
    return rows, real
