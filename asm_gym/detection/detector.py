"""The detector: from a model's errors to one number that a threshold can be set on.

    ε_t/σ_t → whitened, bounded → evidence → ratios → pooled s_t      see ``evidence``
    value      s_t / ŝ(c_t)
    log ŝ_t = min(max(w c_t + b, l), h)          Δw ∝ (τ - [log s_t < w c_t + b]) c_tᵀ

Habituation: ŝ is the surprise below which a share τ of nominal rows in such a context stays, as a hand that meets an
object is often wrong about when. Its rule is local, and is the gradient of the quantile loss. l and h are the limits of
nominal episodes, so that a fault cannot excuse itself by changing the context.

Sources: Yu and Dayan 2005 (Neuron 46(4)) for surprise relative to expected uncertainty; Koenker and Bassett 1978 for
the quantile loss; Romano et al. 2019 (NeurIPS) for quantiles of a context under a conformal threshold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Array, Floats, ModelOutput
from asm_gym.detection.evidence import (
    CONTEXT_GAIN,
    POWER,
    TAIL_INDEX,
    TINY,
    Evidence,
    accumulated,
    bounded,
    no_evidence,
    pool,
    strength,
    whitening,
    worst_case,
)
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled

GAINS = (0.8, 0.2, 0.05)
BOUND = 100.0
UNBOUNDED_LOG = np.array([-700.0, 700.0])  # a range of logarithms that bounds nothing
FAINTEST = 1e-9  # smallest s whose logarithm is taken
LEAST = math.log(TINY)
NEGLIGIBLE = -50.0  # logarithm of a share that vanishes beside 1 in double precision
USUAL = 0.95  # τ
MOST_ROWS = 60_000  # largest number of rows, evenly spaced, that teach what is usual in a context
UPDATES, PASSES, FEWEST = 1000, 12, 40  # largest number of batches and of passes, and smallest number of batches
BATCH, RATE = 512, 1e-2
STEPS_PER_NUMBER = 8  # with fewer nominal rows for each number of a context, nothing is learned
EXTREME = 0.005  # share of nominal rows below l, and above h


@compiled
def _step(
    vector: Any,
    running: Any,
    steps: Any,
    errors: Any,
    context: Any,
    whitening: Any,
    ceiling: Any,
    tail: Any,
    context_quantile: Any,
    context_range: Any,
    gains: Any,
    bound: float,
    new: Any,
    recent: Any,
    counted: Any,
    value: Any,
    shares: Any,
) -> None:
    """Write the fields of the new ``Evidence``, the value (B,) and the shares of the errors (B, X)."""
    B, X = errors.shape
    G, C = len(gains), context.shape[1]
    ratios, limited = np.empty((G, X)), np.empty((B, X))  # logarithms of ratios, and bounded errors
    for n in range(B):
        for i in range(X):
            share = errors[n, i] / bound
            limited[n, i] = errors[n, i] / np.sqrt(1.0 + share * share)
            shares[n, i] = 0.0
    whitened = np.empty((B, X))
    np.dot(limited, whitening, whitened)
    for n in range(B):
        counted[n] = steps[n] + 1
        greatest = LEAST
        for g in range(G):
            a = gains[g]
            variance = a / (2.0 - a) * (1.0 - (1.0 - a) ** (2 * (steps[n] + 1)))
            for i in range(X):
                w = vector[n, g, i] + a * (whitened[n, i] - vector[n, g, i])
                new[n, g, i] = w
                ratios[g, i] = tail[g, i] * np.log(w * w / (variance * ceiling[g, i]))
                greatest = max(greatest, ratios[g, i])
        total = 0.0
        for g in range(G):
            for i in range(X):
                below = POWER * (ratios[g, i] - greatest)
                if not below < NEGLIGIBLE:  # NaN goes on, and is an alarm
                    part = np.exp(below)
                    shares[n, i] += part
                    total += part
        drive = context_quantile[2 * C]
        for c in range(C):
            recent[n, c] = running[n, c] + CONTEXT_GAIN * (context[n, c] - running[n, c])
            drive += context[n, c] * context_quantile[c] + recent[n, c] * context_quantile[C + c]
        usual = min(max(drive, context_range[0]), context_range[1])
        value[n] = np.exp(greatest) * total ** (1.0 / POWER) / np.exp(usual)
        for i in range(X):
            shares[n, i] *= value[n] / max(total, TINY)


@dataclass(frozen=True, eq=False)
class Detector:
    """Turns errors into one number."""

    whitening: Floats  # (X, X) M
    ceiling: Floats  # (G, X) q
    tail: Floats  # (G, X) κ, in (0, 1]
    context_quantile: Floats  # (2 C + 1,) weights of log ŝ on the context and its running mean, and a bias
    context_range: Floats  # (2,) limits of log ŝ
    gains: Floats  # (G,) a, each in (0, 1]
    bound: float  # ν > 0

    @classmethod
    def fit(
        cls,
        learned: Sequence[ModelOutput],
        held_out: Sequence[ModelOutput],
        gains: Sequence[float],
        bound: float,
        shrinkage: float,
        rng: np.random.Generator,
        habituates: bool = True,
        tail_index: float = TAIL_INDEX,
    ) -> Self:
        """Fit nominal episodes that the model has learned, and others that it has not."""
        matrix = whitening(bounded(np.concatenate([r.errors for r in learned]), bound), shrinkage)
        a = np.asarray(gains, np.float64)
        ones = np.ones((len(a), len(matrix)))
        plain = cls(matrix, ones, ones, np.zeros(1), UNBOUNDED_LOG, a, bound)
        everything = [*learned, *held_out]
        ceiling, tail = worst_case(np.array([plain.strengths(r)[0].max(axis=0) for r in everything]), tail_index)
        steps, numbers = sum(len(r.errors) for r in everything), 2 * everything[0].contexts.shape[1]
        if not habituates or steps < STEPS_PER_NUMBER * numbers:
            return cls(matrix, ceiling, tail, np.zeros(numbers + 1), np.zeros(2), a, bound)
        stride = -(-steps // MOST_ROWS)
        contexts, levels = [], []
        for r in everything:
            strengths, running = plain.strengths(r)
            contexts.append(np.hstack([r.contexts, running])[::stride].astype(np.float32))
            ratios = ((strengths / ceiling) ** tail).reshape(len(running), -1)
            levels.append(np.log(np.maximum(pool(ratios)[0], FAINTEST))[::stride])
        return cls(matrix, ceiling, tail, *usual_levels(contexts, levels, rng), a, bound)

    @property
    def reach(self) -> float:
        """Largest value in a context of 0: every error at ν for ever, so that |w_i| <= ν Σ_j |M_ji|."""
        most = self.bound * np.abs(self.whitening).sum(axis=0, keepdims=True)
        with np.errstate(over="ignore"):  # a context that hides everything reaches 0
            return float(self._most(most)[0] / np.exp(self.context_quantile[-1]))

    @property
    def reach_of_errors(self) -> Floats:
        """Largest value (X,) in the context of the least surprise, one error alone at ν for ever, the others at 0."""
        least = np.exp(min(self.context_quantile[-1], self.context_range[0]))
        return self._most(self.bound * self.whitening) / least

    def _most(self, evidence: Floats) -> Floats:
        """Return the pooled ratios (N,) of whitened errors (N, X) that last for ever: v_i = w_i² (2 - a) / a."""
        with np.errstate(over="ignore", divide="ignore"):
            strengths = (evidence**2)[:, None, :] * ((2.0 - self.gains) / self.gains)[:, None]  # (N, G, X)
            return pool(((strengths / self.ceiling) ** self.tail).reshape(len(evidence), -1))[0]

    def start(self, batch: int) -> Evidence:
        """Return evidence before the first row."""
        gains, size = self.ceiling.shape
        return no_evidence(batch, gains, size, (len(self.context_quantile) - 1) // 2)

    def step(self, evidence: Evidence, errors: Array, context: Array) -> tuple[Evidence, Floats, Floats]:
        """Return the new evidence, the value (B,), and each error's share of it (B, X); ``context`` is (B, C)."""
        learned = self.whitening, self.ceiling, self.tail, self.context_quantile, self.context_range
        row = np.asarray(errors, np.float64), np.asarray(context, np.float64)
        new = Evidence._make(map(np.empty_like, evidence))
        value, shares = np.empty(len(errors)), np.empty(errors.shape)
        _step(*evidence, *row, *learned, self.gains, self.bound, *new, value, shares)
        return new, value, shares

    def strengths(self, run: ModelOutput) -> tuple[Floats, Floats]:
        """Return v (T, G, X), and the running mean of the contexts (T, C), of a whole episode."""
        whitened = bounded(run.errors, self.bound) @ self.whitening
        vectors, running = accumulated(whitened, np.asarray(run.contexts, np.float64), self.gains)
        whole = Evidence(vectors, running, np.arange(1, len(vectors) + 1))
        return strength(whole, self.gains), whole.context


def usual_levels(contexts: Sequence[Array], levels: Sequence[Array], rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return w and b (C + 1,), and l and h (2,), from contexts (T, C) and log s (T,) of nominal episodes."""
    context, level = np.concatenate(contexts), np.concatenate(levels)
    w, _ = np.split(habituate(context, level, rng), [-1])
    drive = context @ w
    low, high = np.quantile(drive, (EXTREME, 1.0 - EXTREME))
    b = np.quantile(level - np.clip(drive, low, high), USUAL)
    return np.append(w, b).astype(np.float64), np.array([low + b, high + b])


def habituate(context: Array, level: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return w, then b (C + 1,), from contexts (N, C) and log s (N,) of nominal rows."""
    w, b = np.zeros(context.shape[1], np.float32), np.array([np.quantile(level, USUAL)], np.float32)
    weights, bias = Synapse(w), Synapse(b)
    updates = max(FEWEST, min(UPDATES, PASSES * len(level) // BATCH))
    for n, rows in zip(range(updates), shuffled(len(level), BATCH, rng), strict=False):
        c, rate = context[rows], cosine_decay(RATE, n / updates)
        pull = (USUAL - (level[rows] < c @ w + b)).astype(np.float32)
        weights.learn(pull @ c / np.float32(len(rows)), rate)
        bias.learn(pull.mean(keepdims=True), rate)
    return np.concatenate([w, b])
