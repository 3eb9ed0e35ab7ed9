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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.base import Array, Floats, ModelOutput
from asm_gym.detection.evidence import (
    CONTEXT_GAIN,
    POWER,
    TINY,
    Evidence,
    accumulated,
    add_evidence,
    average,
    bounded,
    pool,
    scale,
    strength,
    whitening,
    worst_case,
)
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled

GAINS = (0.8, 0.2, 0.05)
BOUND = 100.0
LEAST_POOLED = 1e-9  # smallest s whose logarithm is taken
LOG_TINY = math.log(TINY)
NEGLIGIBLE = -50.0  # logarithm of a share that vanishes beside 1 in double precision
USUAL_QUANTILE = 0.95  # τ
MOST_ROWS = 60_000  # largest number of rows, evenly spaced, that teach what is usual in a context
MOST_UPDATES = 1000  # largest number of batches
MOST_PASSES = 12  # largest number of passes
FEWEST_UPDATES = 40  # smallest number of batches
HABITUATION_BATCH = 512
HABITUATION_RATE = 1e-2
ROWS_PER_NUMBER = 8  # with fewer nominal rows for each number of a context, nothing is learned
EXTREME_SHARE = 0.005  # share of nominal rows below l, and above h


class Detector(NamedTuple):
    """Turns errors into one number; C numbers of context, G gains, X errors."""

    whitening: Floats  # (X, X) M
    ceiling: Floats  # (G, X) q
    tail: Floats  # (G, X) κ, in (0, 1]
    context_quantile: Floats
    """(2 C + 1,) weights of log ŝ on the context and its running mean, and a bias."""
    context_range: Floats  # (2,) limits of log ŝ
    gains: Floats  # (G,) a, each in (0, 1]
    bound: float  # ν > 0

    @classmethod
    def white(
        cls, learned: Sequence[ModelOutput], gains: Sequence[float], bound: float, shrinkage: float
    ) -> Detector:
        """Return the detector of white errors, by those of nominal episodes that the model has learned."""
        errors = np.concatenate([run.errors for run in learned])
        matrix = whitening(bounded(errors, bound), shrinkage)
        ones = np.ones((len(gains), len(matrix)))
        return cls(
            whitening=matrix,
            ceiling=ones,
            tail=ones,
            context_quantile=np.zeros(2 * learned[0].contexts.shape[1] + 1),
            context_range=np.zeros(2),
            gains=np.asarray(gains, np.float64),
            bound=bound,
        )

    def with_worst_case(
        self,
        runs: Sequence[ModelOutput],
        tail_index: float,
    ) -> Detector:
        """Return the detector with q and κ of nominal episodes, by ξ_0."""
        maxima = [self.strengths(run)[0].max(axis=0) for run in runs]
        ceiling, tail = worst_case(np.array(maxima), tail_index)
        return self._replace(ceiling=ceiling, tail=tail)

    def habituated(
        self,
        runs: Sequence[ModelOutput],
        rng: np.random.Generator,
    ) -> Detector:
        """Return the detector that knows what is usual in each context of nominal episodes; the same for too few."""
        rows = sum(len(run.errors) for run in runs)
        if rows < ROWS_PER_NUMBER * (len(self.context_quantile) - 1):
            return self
        stride = math.ceil(rows / MOST_ROWS)
        contexts = []
        levels = []
        for run in runs:
            strengths, running = self.strengths(run)
            pooled, _ = pool(self.ratios(strengths))
            context = np.hstack([run.contexts, running])
            level = np.log(np.maximum(pooled, LEAST_POOLED))
            contexts.append(context[::stride].astype(np.float32))
            levels.append(level[::stride])
        quantile, limits = usual_levels(contexts, levels, rng)
        return self._replace(context_quantile=quantile, context_range=limits)

    @property
    def reach(self) -> float:
        """Largest value in a context of 0: every error at ν for ever, so that |w_i| <= ν Σ_j |M_ji|."""
        largest = self.bound * np.abs(self.whitening).sum(axis=0, keepdims=True)
        usual = self.context_quantile[-1]
        with np.errstate(over="ignore"):  # a context that hides everything reaches 0
            reach = self._lasting(largest)[0] / np.exp(usual)
        return float(reach)

    @property
    def reach_of_errors(self) -> Floats:
        """Largest value (X,) in the context of the least surprise, one error alone at ν for ever, the others at 0."""
        usual = self.context_quantile[-1]
        least = min(usual, self.context_range[0])
        return self._lasting(self.bound * self.whitening) / np.exp(least)

    def _lasting(self, whitened: Floats) -> Floats:
        """Return the pooled ratios (N,) of whitened errors (N, X) that last for ever: v_i = w_i² (2 - a) / a."""
        with np.errstate(over="ignore", divide="ignore"):
            scales = (2.0 - self.gains) / self.gains
            strengths = (whitened**2)[:, None] * scales[:, None]  # (N, G, X)
            return pool(self.ratios(strengths))[0]

    def ratios(self, strengths: Floats) -> Floats:
        """Return r (N, G X) of v (N, G, X)."""
        ratios = (strengths / self.ceiling) ** self.tail
        return ratios.reshape(len(strengths), -1)

    def start(self, batch: int) -> Evidence:
        """Return evidence before the first row."""
        gains, errors = self.ceiling.shape
        context_size = (len(self.context_quantile) - 1) // 2
        return Evidence.start(batch, gains, errors, context_size)

    def step(self, evidence: Evidence, output: ModelOutput) -> tuple[Evidence, Floats]:
        """Return the evidence after a row of B streams, and each error's share (B, X) of the value."""
        errors = np.asarray(output.errors, np.float64)
        contexts = np.asarray(output.contexts, np.float64)
        after = self.start(len(errors))
        shares = np.empty(errors.shape)
        step_evidence(self, evidence, after, ModelOutput(errors, contexts), shares)
        return after, shares

    def strengths(self, run: ModelOutput) -> tuple[Floats, Floats]:
        """Return v (T, G, X), and the running mean of the contexts (T, C), of a whole episode."""
        whitened = bounded(run.errors, self.bound) @ self.whitening
        contexts = np.asarray(run.contexts, np.float64)
        vectors, running = accumulated(whitened, contexts, self.gains)
        rows = np.arange(1, len(vectors) + 1)
        episode = Evidence(vector=vectors, context=running, steps=rows)
        return strength(episode, self.gains), running


_NO_ERRORS = np.zeros((0, 0))
NO_DETECTOR = Detector(
    whitening=_NO_ERRORS,
    ceiling=_NO_ERRORS,
    tail=_NO_ERRORS,
    context_quantile=np.zeros(1),
    context_range=np.zeros(2),
    gains=np.zeros(0),
    bound=BOUND,
)
"""A detector of no errors."""


@compiled
def step_evidence(
    detector: Detector, before: Evidence, after: Evidence, output: ModelOutput, shares: Any
) -> None:
    """Write the new evidence, and each error's share (B, X) of the value."""
    limited = bounded(output.errors, detector.bound)
    whitened = np.dot(limited, detector.whitening)
    ratios = np.empty(detector.ceiling.shape)
    for n in range(len(shares)):
        share = shares[n]
        after.steps[n] = before.steps[n] + 1
        add_evidence(detector.gains, before.vector[n], after.vector[n], whitened[n])
        greatest = write_ratios(detector, after.vector[n], after.steps[n], ratios)
        powers = write_shares(ratios, greatest, share)

        usual = usual_level(detector, before.context[n], after.context[n], output.contexts[n])
        value = powers ** (1.0 / POWER) * np.exp(greatest) / np.exp(usual)
        value_of_a_power = value / max(powers, TINY)
        scale(share, value_of_a_power)


@inner
def write_ratios(
    detector: Detector,
    vector: Any,
    steps: int,
    ratios: Any,
) -> float:
    """Write log r (G, X) = κ log(v/q) after so many rows; return the largest."""
    greatest = LOG_TINY
    for g in range(len(detector.gains)):
        ceiling = detector.ceiling[g]
        tail = detector.tail[g]
        gain = detector.gains[g]
        variance = gain / (2.0 - gain) * (1.0 - (1.0 - gain) ** (2 * steps))
        for i in range(len(tail)):
            squared = vector[g, i] ** 2
            ratio = tail[i] * np.log(squared / (variance * ceiling[i]))
            ratios[g, i] = ratio
            greatest = max(greatest, ratio)
    return greatest


@inner
def write_shares(
    ratios: Any,
    greatest: float,
    shares: Any,
) -> float:
    """Write Σ_g (r/r_max)^p of each error (X,), from logarithms (G, X); return the sum of all."""
    total = 0.0
    shares.fill(0.0)
    for g in range(len(ratios)):
        for i in range(len(shares)):
            below = POWER * (ratios[g, i] - greatest)
            if not below < NEGLIGIBLE:  # NaN goes on, and is an alarm
                part = np.exp(below)
                shares[i] += part
                total += part
    return total


@inner
def usual_level(
    detector: Detector,
    before: Any,
    after: Any,
    context: Any,
) -> float:
    """Write the running mean (C,) of the context (C,); return log ŝ = min(max(w c + b, l), h)."""
    average(before, after, context, CONTEXT_GAIN)
    weights = detector.context_quantile
    size = len(context)
    drive = weights[2 * size]
    for c in range(size):
        now = context[c] * weights[c]
        drive += now + after[c] * weights[size + c]
    limits = detector.context_range
    return min(max(drive, limits[0]), limits[1])


def usual_levels(
    contexts: Sequence[Array], levels: Sequence[Array], rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return w and b (C + 1,), and l and h (2,), from contexts (T, C) and log s (T,) of nominal episodes."""
    context = np.concatenate(contexts)
    level = np.concatenate(levels)
    weights = habituate(context, level, rng)[:-1]  # its bias is set anew, within the limits
    drive = context @ weights
    limits = np.quantile(drive, (EXTREME_SHARE, 1.0 - EXTREME_SHARE))
    limited = np.clip(drive, limits[0], limits[1])
    bias = np.quantile(level - limited, USUAL_QUANTILE)
    quantile = np.append(weights, bias)
    return quantile.astype(np.float64), limits + bias


def habituate(
    context: Array,
    level: Array,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Return w, then b (C + 1,), from contexts (N, C) and log s (N,) of nominal rows."""
    usual = np.quantile(level, USUAL_QUANTILE)
    weights = Synapse(np.zeros(context.shape[1], np.float32))
    bias = Synapse(np.array([usual], np.float32))
    updates = max(FEWEST_UPDATES, min(MOST_UPDATES, MOST_PASSES * len(level) // HABITUATION_BATCH))
    batches = shuffled(len(level), HABITUATION_BATCH, rng)
    for n, rows in zip(range(updates), batches, strict=False):
        rate = cosine_decay(HABITUATION_RATE, n / updates)
        inputs = context[rows]
        below = level[rows] < inputs @ weights.W + bias.W
        pull = (USUAL_QUANTILE - below).astype(np.float32)
        weights.learn(pull @ inputs / np.float32(len(rows)), rate)
        bias.learn(pull.mean(keepdims=True), rate)
    return np.concatenate([weights.W, bias.W])
