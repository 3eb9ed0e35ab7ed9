"""Learning rules: each synapse changes by what its own two ends do, with a step size of its own.

    ΔW ∝ ⟨post preᵀ⟩ over a batch,     step: rate · m / √s       m, s: running mean and mean square of ΔW (Adam)

The step size of a synapse uses that synapse's own history only, so it is local too.

Source: Kingma and Ba 2015 (ICLR) for the step size.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, kernel

Tick = Callable[[], None]
"""Reports progress."""


class Trajectory(NamedTuple):
    """One episode as the memory reads it; float32, standardised.

    ``senses`` and ``commands`` have a row for each of the T steps of the temporal network. At rates above the control
    rate association has more rows, N > T.
    """

    senses: Array  # (T, S)
    commands: Array  # (T, A + 1), the last one a constant 1
    inputs: Array  # (N, I) of association


class Schedule(NamedTuple):
    """Hyperparameters of the temporal network; ``NeuralASM`` explains them."""

    epochs: int
    batch_size: int
    learning_rate: float
    iterations: int
    prior_precision: float
    sensory_precision: float
    free_running_probability: float


def shuffled(count: int, size: int, rng: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    """Yield batches of indices without end, each of ``count`` once before any comes again."""
    while True:
        order = rng.permutation(count)
        yield from (order[start : start + size] for start in range(0, count, size))


def cosine_decay(rate: float, progress: float) -> float:
    """Return ``rate`` at progress 0, falling to zero at progress 1."""
    return 0.5 * rate * (1.0 + float(np.cos(np.pi * progress)))


@kernel
def coincidence(post: Array, pre: Array) -> Array:
    """Return the mean over the batch of ``post`` (B, P) times ``pre`` (B, Q): (P, Q)."""
    out = np.empty((post.shape[1], pre.shape[1]), post.dtype)
    np.dot(post.T, pre, out)
    out /= np.float32(post.shape[0])
    return out


@kernel
def adapt(W: Array, mean: Array, square: Array, change: Array, rate: float, count: int) -> None:
    """Move ``W`` along ``change`` in place; all four have one shape. ``count``: updates so far, this one included."""
    w, m, s, c = W.reshape(-1), mean.reshape(-1), square.reshape(-1), change.reshape(-1)
    m_scale = np.float32(rate / (1.0 - 0.9**count))
    s_scale = np.float32(1.0 / (1.0 - 0.999**count))
    for k in range(w.size):
        m[k] = np.float32(0.9) * m[k] + np.float32(0.1) * c[k]
        s[k] = np.float32(0.999) * s[k] + np.float32(0.001) * c[k] * c[k]
        w[k] += m_scale * m[k] / (np.sqrt(s_scale * s[k]) + np.float32(1e-8))


class Synapse:
    """One weight array with the running moments that set its steps."""

    def __init__(self, W: Array) -> None:
        self.W = W
        self.mean, self.square, self.count = np.zeros_like(W), np.zeros_like(W), 0

    def learn(self, change: Array, rate: float) -> None:
        """Take a step of about ``rate`` a synapse along ``change``, which has the shape of ``W``."""
        if self.W.size:
            self.count += 1
            adapt(self.W, self.mean, self.square, change, rate, self.count)


@kernel
def power_iteration(W: Array, v: Array) -> tuple[float, Array]:
    """Take a step towards ‖W‖² (spectral) and its right singular vector ``v`` (H,); return both, ‖v‖ = 1."""
    v = np.dot(np.dot(W, v), W)
    norm = np.sqrt(np.sum(v * v))
    return norm, v / (norm + np.float32(1e-12))


class Learner:
    """A temporal network that learns: its weights, their running moments, and the norm that inference needs.

    Args:
        weights: the synapses through time, a NamedTuple with an array ``W_F``; changed in place.
        names: of those that are learned.
        schedule: how to learn.
        rng: draws the first direction of the power iteration.

    Attributes:
        norm: ‖W_F‖², spectral.
    """

    def __init__(self, weights: Any, names: Collection[str], schedule: Schedule, rng: np.random.Generator) -> None:
        self.weights, self.schedule = weights, schedule
        self.synapses = {name: Synapse(getattr(weights, name)) for name in names}
        self._direction = rng.standard_normal(weights.W_F.shape[1]).astype(np.float32)
        for _ in range(20):
            self.norm, self._direction = power_iteration(weights.W_F, self._direction)

    def learn(self, change: Any, rate: float) -> None:
        """Move every synapse along its array in ``change``."""
        for name, synapse in self.synapses.items():
            synapse.learn(getattr(change, name), rate)
        # W_F moves little in a step, so one iteration keeps the norm up to date.
        self.norm, self._direction = power_iteration(self.weights.W_F, self._direction)
