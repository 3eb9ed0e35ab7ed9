"""The memory's question, answered by backpropagation: each group of senses from all others, the past and the command.

    h = tanh(V a_t)    k_g = tanh(W_g h_g)    Δ̂_g, log σ²_g = linear(k_g)        Gaussian log likelihood, early stopping

Units of group g have no synapse from what it does now, as in the memory's association; but there are two layers of
them, every weight is trained by the one gradient, and training ends where fresh episodes gain no more.
Source: Rumelhart et al. 1986; Prechelt 1998 for early stopping.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.detection import ModelOutput
from asm_gym.memory.association import synapses
from asm_gym.memory.linear import check_inputs
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import Lagged, associated, no_context, nothing_before
from asm_gym.monitors.baselines.torch_model import FRESH, TorchModel, steps_of
from asm_gym.scaling import ScaledRows, StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

UPDATES, BATCH = 12_000, 256
CHECK, PATIENCE = 200, 10
"""Updates between two looks at the fresh rows, and how many looks without a gain end the training."""

CLOSEST = 20.0
"""Largest error, in standard deviations, whose full weight training feels."""


class _Module(nn.Module):
    exists: Tensor  # (G each, I) 1 where there is a synapse
    group: Tensor  # (X,)

    def __init__(self, senses: StreamScaler, units: int) -> None:
        super().__init__()
        G = int(senses.groups.max()) + 1
        each = max(1, units // G)
        exists = synapses(senses.groups, senses.changes, senses.inputs, each).V
        self.register_buffer("exists", torch.as_tensor(exists), persistent=False)
        self.register_buffer("group", torch.as_tensor(senses.groups), persistent=False)
        self.V = nn.Parameter(torch.randn(G * each, senses.inputs) / senses.inputs**0.5)
        self.W = nn.Parameter(torch.randn(G, each, each) / each**0.5)
        self.out = nn.Parameter(torch.zeros(2, len(senses.groups), each))
        self.bias = nn.Parameter(torch.zeros(2, len(senses.groups)))

    def forward(self, a: Tensor) -> tuple[Tensor, Tensor]:
        G, each, _ = self.W.shape
        h = torch.tanh(a @ (self.V * self.exists).T).reshape(-1, G, each)
        k = torch.tanh(torch.einsum("bgi,gji->bgj", h, self.W))[:, self.group]  # (B, X, each)
        mean, log_variance = torch.einsum("bxi,nxi->nbx", k, self.out) + self.bias[:, None]
        return mean, log_variance.clamp(-12.0, 8.0)


class MLPAssociation(TorchModel):
    """Two layers of hidden units for each group of senses; it has no context.

    Args:
        spec: the stream it is to expect.
        units: hidden units of each layer, shared out among the groups; by default as many as the memory has.
        learning_rate: of Adam.
    """

    kind = "association_mlp"

    @typed
    def __init__(self, spec: StreamSpec, units: int = 960, learning_rate: float = 3e-4) -> None:
        super().__init__(spec)
        self.units = check_number("units", units, low=1, whole=True)
        self.learning_rate = check_number("learning_rate", learning_rate, above=0.0)
        self.lag = rows_apart(spec.dt)
        self.shortest = 1 + self.lag

    def module(self, senses: StreamScaler) -> nn.Module:
        check_inputs(senses.inputs)
        return _Module(senses, self.units)

    def train(
        self, module: nn.Module, readings: Sequence[ScaledRows], rng: np.random.Generator, tell: Progress
    ) -> None:
        kept = len(readings) // FRESH
        learned = np.concatenate([_both(r, self.lag) for r in readings[kept:]])
        fresh = torch.as_tensor(np.concatenate([_both(r, self.lag) for r in readings[:kept] or readings]))
        X, optimiser = len(self.spec.sensory), torch.optim.Adam(module.parameters(), self.learning_rate)
        best, lasted, kept_weights = float("inf"), 0, copy.deepcopy(module.state_dict())
        for n, rows in enumerate(steps_of(learned, BATCH, UPDATES, rng), 1):
            optimiser.zero_grad()
            _loss(module, rows, X).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            if n % CHECK:
                continue
            tell(n, UPDATES)
            with torch.no_grad():
                now = float(_loss(module, fresh, X))
            if now < best:
                best, lasted, kept_weights = now, 0, copy.deepcopy(module.state_dict())
            else:
                lasted += 1
            if lasted >= PATIENCE:
                break
        module.load_state_dict(kept_weights)

    def start(self, batch: int, told: Sequence[Told] = ()) -> Lagged:
        return nothing_before(batch, self.lag, self.spec.size)

    def advance(self, state: Lagged, rows: NDArray[np.float64]) -> tuple[Lagged, ModelOutput]:
        state, r, known = associated(self.senses_, state, rows)
        mean, log_variance = (y.cpu().numpy() for y in self.module_(torch.as_tensor(r.inputs)))
        error = known * (r.changes - mean) * np.exp(-0.5 * log_variance)
        return state, ModelOutput(error, no_context(rows))


def _both(r: ScaledRows, lag: int) -> NDArray[np.float32]:
    """(T - lag, I + X) what is predicted from, and what is predicted."""
    return np.hstack([r.inputs[lag:], r.changes[lag:]])


def _loss(module: nn.Module, rows: Tensor, changes: int) -> Tensor:
    """The mean over rows (B, I + X) and changes."""
    mean, log_variance = module(rows[:, :-changes])
    normalised = (rows[:, -changes:] - mean) * torch.exp(-0.5 * log_variance)
    error = nn.functional.huber_loss(normalised, torch.zeros_like(mean), reduction="none", delta=CLOSEST)
    loss: Tensor = (error + 0.5 * log_variance).mean()
    return loss
