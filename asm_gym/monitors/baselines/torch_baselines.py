"""Baselines by torch, trained by backpropagation and kept as arrays: a GRU, and FAIL-Detect's best score.

    GRU      h_t = GRU(h_{t-1}, [v_{t-1}, Δ_{t-1}, u_t])    Δ̂_t, log σ²_t = linear(h_t)    Gaussian log likelihood
    logpZO   ‖z(x)‖²        z where the flow dx/ds = v(x, s), s from 0 to 1, carries x; N(0, I) if nominal

logpZO is averaged there over the last five rows, and calibrated by a band in time; here it has one threshold on that
mean (``moving_mean``). There an embedding of images and the action is scored; here the sensorimotor row. The network
here is smaller: three layers of 512, where the authors train a one-dimensional U-Net of 59 million weights, which takes
longer for a row on a core than the row lasts at 20 Hz.

Sources: Cho et al. 2014 (EMNLP); Malhotra et al. 2015 (ESANN) for the Mahalanobis distance of a recurrent network's
prediction errors; Xu et al. 2025 (RSS), “Can we detect failures without failure data? Uncertainty-aware runtime failure
detection for imitation learning policies”; Lipman et al. 2023 (ICLR) for the flow.
"""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.learning import shuffled
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

EPOCHS = 200  # passes at most over whole episodes
EPISODES_IN_BATCH = 16  # episodes side by side
ONE_IN_FRESH = 5  # one in so many episodes is not trained on, but says when to stop

FIRST_RATE = 1e-3  # first step size
PATIENCE = 5  # epochs without a gain after which the step size is cut
RATE_CUT = 0.3  # share that it is cut to
FINAL_RATE = 3e-5  # step size below which training has converged

FULL_WEIGHT_ERROR = 20.0
"""Largest error in training, in standard deviations, that has its full weight; contacts would drown all else."""

LOG_VARIANCE = (-12.0, 8.0)  # limits of what the GRU predicts

LAYERS = 3  # hidden ones of the flow
ROWS_IN_BATCH = 256  # of a batch of the flow
STAGES = 10  # steps of the flow
# Where standardised numbers are cut off: such networks diverge far from what they have seen.
CLIPPED_AT = 30.0


class TorchModel(ScaledModel):
    """A model that is a torch module."""

    module_: nn.Module  # once it is fitted

    @abstractmethod
    def module(self, senses: StreamScaler) -> nn.Module:
        """Return a fresh network."""

    @abstractmethod
    def train(
        self,
        module: nn.Module,
        readings: Sequence[ScaledRows],
        rng: np.random.Generator,
        progress: Progress,
    ) -> None:
        """Train it on whole nominal episodes."""

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        readings = self.read_nominal(episodes)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # as for every other monitor, so that times compare
        try:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(int(rng.integers(2**31)))
                module = self.module(self.senses_)
                self.train(module, readings, rng, progress)
        finally:
            torch.set_num_threads(threads)
        weights = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
        return self.restore({**self.senses_.arrays, **weights})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler.of(self.spec, learned)
        with torch.random.fork_rng(devices=[]):
            module = self.module(senses)
        names = module.state_dict()
        weights = {name: torch.tensor(learned[name], dtype=torch.float32) for name in names}
        try:
            module.load_state_dict(weights)
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

    A fifth of the ``episodes`` is not trained on, none of fewer than five; ``loss`` is that of some, training or not.
    """
    order = rng.permutation(episodes).astype(np.intp)
    fresh_count = episodes // ONE_IN_FRESH
    trained = order[fresh_count:]
    fresh = order[:fresh_count]
    if not fresh_count:
        fresh = order
    optimiser = torch.optim.Adam(module.parameters(), FIRST_RATE)
    plateaus = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimiser, factor=RATE_CUT, patience=PATIENCE
    )
    least_loss = math.inf
    best_weights = copy.deepcopy(module.state_dict())
    for epoch in range(EPOCHS):
        progress(epoch, EPOCHS)
        order = rng.permutation(trained)
        for start in range(0, len(order), EPISODES_IN_BATCH):
            descend(loss(order[start : start + EPISODES_IN_BATCH], True), optimiser)
        with torch.no_grad():
            fresh_loss = float(loss(fresh, False))
        if fresh_loss < least_loss:
            least_loss = fresh_loss
            best_weights = copy.deepcopy(module.state_dict())
        plateaus.step(fresh_loss)
        if optimiser.param_groups[0]["lr"] < FINAL_RATE:
            break
    module.load_state_dict(best_weights)


def adam(
    module: nn.Module, updates: int, rate: float = FIRST_RATE
) -> tuple[torch.optim.Optimizer, Any]:
    """Return Adam and its cosine decay, the default of those who publish such models."""
    optimiser = torch.optim.Adam(module.parameters(), rate)
    return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)


def descend(
    loss: Tensor, optimiser: torch.optim.Optimizer, schedule: Any = None, clip: float = 1.0
) -> None:
    """Update once, with the gradient cut off at ``clip``."""
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    for group in optimiser.param_groups:
        nn.utils.clip_grad_norm_(group["params"], clip)
    optimiser.step()
    if schedule is not None:
        schedule.step()


def padded(episodes: Sequence[NDArray[np.float32]]) -> tuple[Tensor, Tensor]:
    """Return episodes (T, N) side by side (B, longest, N), and 1 where there is a step (B, longest)."""
    rows = nn.utils.rnn.pad_sequence([torch.as_tensor(e) for e in episodes], batch_first=True)
    real = nn.utils.rnn.pad_sequence([torch.ones(len(e)) for e in episodes], batch_first=True)
    return rows, real


class _GRUState(NamedTuple):
    hidden: NDArray[np.float32]  # (B, H)
    last: NDArray[np.float32]  # (B, S) what was sensed last
    history: RowHistory


class _GRUModule(nn.Module):
    def __init__(self, senses: int, commands: int, changes: int, hidden: int) -> None:
        super().__init__()
        self.cell = nn.GRU(senses + commands, hidden, batch_first=True)
        self.out = nn.Linear(hidden, 2 * changes)

    def forward(
        self, inputs: Tensor, hidden: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        states, _ = self.cell(inputs, hidden)
        mean, log_variance = self.out(states).chunk(2, dim=-1)
        return mean, log_variance.clamp(*LOG_VARIANCE), states


class GRU(TorchModel):
    """A gated recurrent network of ``hidden_size`` H; its context is its hidden state."""

    kind = "gru"

    @typed
    def __init__(self, spec: StreamSpec, hidden_size: int = 128) -> None:
        super().__init__(spec)
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)

    def module(self, senses: StreamScaler) -> nn.Module:
        return _GRUModule(
            senses=senses.size,
            commands=len(self.spec.commanded) + 1,
            changes=len(self.spec.sensory),
            hidden=self.hidden_size,
        )

    def train(
        self,
        module: nn.Module,
        readings: Sequence[ScaledRows],
        rng: np.random.Generator,
        progress: Progress,
    ) -> None:
        inputs = []
        for reading in readings:
            last = np.vstack([reading.senses[:1], reading.senses[:-1]])
            inputs.append(np.hstack([last, reading.commands]))

        def loss(chosen: NDArray[np.intp], training: bool) -> Tensor:
            x, real = padded([inputs[i] for i in chosen])
            changes, _ = padded([readings[i].changes for i in chosen])
            mean, log_variance, _ = module(x)
            error = (changes - mean) * torch.exp(-0.5 * log_variance)
            huber = nn.functional.huber_loss(
                error, torch.zeros_like(mean), reduction="none", delta=FULL_WEIGHT_ERROR
            )
            loss_of_rows = (huber + 0.5 * log_variance).mean(dim=-1)
            return (loss_of_rows * real).sum() / real.sum()

        train_on_episodes(module, loss, len(readings), rng, progress)

    def start(self, batch: int) -> _GRUState:
        rows = np.zeros((batch, self.spec.size))
        return _GRUState(
            hidden=np.zeros((batch, self.hidden_size), np.float32),
            last=self.senses_.read(rows, rows, rows).senses,
            history=super().start(batch),
        )

    def predict(self, state: _GRUState, rows: NDArray[np.float64]) -> tuple[_GRUState, ModelOutput]:
        history, reading, _ = read_next(self.senses_, state.history, rows)
        begun = state.history.steps[:, None] > 0
        last = np.where(begun, state.last, reading.senses)
        inputs = torch.as_tensor(np.hstack([last, reading.commands]))[:, None]
        before = torch.as_tensor(np.ascontiguousarray(state.hidden))[None]
        mean, log_variance, states = self.module_(inputs, before)
        hidden = states.numpy()[:, 0]
        error = reading.whole * (reading.changes - mean.numpy()[:, 0])
        error = error * np.exp(-0.5 * log_variance.numpy()[:, 0])
        return _GRUState(hidden, reading.senses, history), ModelOutput(error, hidden)


class LogpZO(TorchModel):
    """A flow from rows to noise: values, changes and the command; ``width`` is that of each hidden layer."""

    kind = "logpzo"

    @typed
    def __init__(self, spec: StreamSpec, width: int = 512, updates: int = 8000) -> None:
        super().__init__(spec)
        self.width = check_number("width", width, low=1, whole=True)
        self.updates = check_number("updates", updates, low=1, whole=True)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.commanded])

    def module(self, senses: StreamScaler) -> nn.Module:
        size = senses.size + len(self.spec.commanded)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise([size + 1, *[self.width] * LAYERS]):
            layers += [nn.Linear(inputs, outputs), nn.SiLU()]
        return nn.Sequential(*layers, nn.Linear(self.width, size))

    def train(
        self,
        module: nn.Module,
        readings: Sequence[ScaledRows],
        rng: np.random.Generator,
        progress: Progress,
    ) -> None:
        optimiser, schedule = adam(module, self.updates)
        rows = np.concatenate([_features(reading) for reading in readings])
        for n, chosen in zip(
            range(self.updates), shuffled(len(rows), ROWS_IN_BATCH, rng), strict=False
        ):
            progress(n, self.updates)
            x = torch.as_tensor(rows[chosen])
            noise = torch.randn_like(x)
            s = torch.rand(len(x), 1)
            between = (1.0 - s) * x + s * noise
            flow = module(torch.cat([between, s], dim=1))
            loss = ((flow - (noise - x)) ** 2).mean()
            descend(loss, optimiser, schedule)

    def predict(
        self, state: RowHistory, rows: NDArray[np.float64]
    ) -> tuple[RowHistory, ModelOutput]:
        state, reading, _ = read_next(self.senses_, state, rows)
        x = torch.as_tensor(_features(reading))  # (B, N), which the flow makes z
        for stage in range(STAGES):
            s = torch.full((len(x), 1), stage / STAGES)
            x = x + self.module_(torch.cat([x, s], dim=1)) / STAGES
        return state, ModelOutput(x.numpy().astype(np.float64), no_context(rows))


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """Return values, changes of slow channels, and the action (B, N)."""
    features = np.hstack([reading.senses, reading.commands[:, :-1]])
    return np.clip(features, -CLIPPED_AT, CLIPPED_AT)
