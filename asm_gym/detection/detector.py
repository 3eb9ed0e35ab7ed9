"""From prediction errors to evidence, and from evidence to an alarm.

    whitened   e_t = M ε_t/σ_t,   M = ((1 - λ) C + λ tr(C)/X I)^(-½),   C = E[(ε/σ)(ε/σ)ᵀ] over nominal steps
    bounded    ẽ_i = e_i / √(1 + e_i²/ν²)                               |ẽ_i| < ν, however large e_i
    evidence   w_t = (1 - a) w_{t-1} + a ẽ_t,   w_0 = 0
               v_i = w_i² (2 - a) / (a (1 - (1 - a)^{2t}))              nominal mean 1 for white errors, for every t
    ratio      r_i = (v_i/q_i)^κ_i                                      q_i: what v_i stays below in 90 % of episodes
    pooled     s_t = (Σ_i r_i^p)^(1/p)                                  κ_i = min(1, ξ_0/ξ_i), ξ_i: the tail of v_i
    value      s_t / ŝ(c_t)                                             ŝ: what s seldom exceeds in a context like this
    alarm      value > the ⌈(n + 1)(1 - rate)⌉-th smallest of the maxima of n nominal episodes

Each number is measured against what it does in nominal episodes at its worst, so that a wrist that is often surprised
by contact does not drown an encoder that never is; p lets the most surprising one count, and several add up. Beyond q
the maxima of episodes fall off as v^(-1/ξ): a ratio of 10 happens to a wrist now and then, to an encoder never. The
exponent κ makes the same ratio as rare for the one as for the other.

Sources: Kessy et al. 2018 (ZCA whitening); Lange et al. 1989 (errors weighted as under a t distribution); Lowry et al.
1992 (multivariate EWMA chart, its exact variance at start-up); Hill 1975 (the index ξ of a tail); Vovk et al. 2005 and
Angelopoulos and Bates 2023 (split conformal prediction).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.habituation import habituate
from asm_gym.detection.repetition import LIGHT

Array = NDArray[np.floating[Any]]

POWER = 8
"""p."""

LATELY = 0.2
"""Weight of the newest step in the running mean of the context."""

WORST = 0.9
"""Share of nominal episodes whose maximum of v stays below q; those above tell how far it goes."""

DOUBT = 10
"""How many maxima beyond q a tail must show of its own to count as much as what is common among all."""

TINY = float(np.finfo(np.float64).tiny)

FAINTEST = 1e-9
"""Lower bound of s where its logarithm is taken."""


def whitening(errors: Array, shrinkage: float = 0.01) -> NDArray[np.float64]:
    """The symmetric (ZCA) matrix M (X, X) that makes ``errors`` (N, X) white; of all, it turns them the least.

    Args:
        errors: normalised errors of nominal steps; their mean is taken to be 0, as that of a prediction should be.
        shrinkage: λ in [0, 1], towards equal variance and no correlation. Above 0 a channel that is constant, or a
            copy of another, is no trouble.
    """
    if not 0.0 <= shrinkage <= 1.0:
        raise ValueError(f"shrinkage must be in [0, 1], got {shrinkage}")
    exact = np.asarray(errors, np.float64)
    covariance = exact.T @ exact / len(exact)  # (X, X)
    scale = float(np.trace(covariance)) / len(covariance)
    target = (scale if scale > 0 else 1.0) * np.eye(len(covariance))
    values, vectors = np.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * target)
    matrix: NDArray[np.float64] = (vectors / np.sqrt(values)) @ vectors.T
    return matrix


def bounded(errors: Array, bound: float) -> NDArray[np.float64]:
    """Errors pulled in one by one: none counts more than ν = ``bound`` standard deviations."""
    exact = np.asarray(errors, np.float64)
    pulled: NDArray[np.float64] = exact / np.sqrt(1.0 + (exact / bound) ** 2)
    return pulled


class Evidence(NamedTuple):
    """What the last steps of each stream in a batch have added up to; never changed in place."""

    vector: NDArray[np.float64]  # (B, G, X) w_t, for each of G gains
    context: NDArray[np.float64]  # (B, C) running mean of the contexts
    steps: NDArray[np.int64]  # (B,) t, how many steps are in it


def no_evidence(batch: int, gains: int, size: int, context: int = 0) -> Evidence:
    """w_0 for ``batch`` streams of ``size`` errors."""
    return Evidence(np.zeros((batch, gains, size)), np.zeros((batch, context)), np.zeros(batch, np.int64))


def accumulate(evidence: Evidence, whitened: Array, context: Array, gains: Array) -> Evidence:
    """w_t from w_{t-1} and the whitened errors e_t (B, X); a gain a in (0, 1] of 1 forgets all but this step."""
    vector = evidence.vector + gains[:, None] * (whitened[:, None, :] - evidence.vector)
    return Evidence(vector, evidence.context + LATELY * (context - evidence.context), evidence.steps + 1)


def strength(evidence: Evidence, gains: Array) -> NDArray[np.float64]:
    """v (B, G, X): the squared evidence in each error, with a nominal mean of 1."""
    variance = gains / (2.0 - gains) * (1.0 - (1.0 - gains) ** (2 * evidence.steps[:, None]))  # (B, G) of each w_t,i
    squared: NDArray[np.float64] = evidence.vector**2 / variance[:, :, None]
    return squared


def pool(ratios: Array, power: float = POWER) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(Σ_i r_i^p)^(1/p) (B,), and each one's part of it (B, X), which add up to it; r >= 0."""
    greatest = np.maximum(ratios.max(axis=1, keepdims=True), np.finfo(float).tiny)
    powers = (ratios / greatest) ** power
    total = powers.sum(axis=1, keepdims=True)
    pooled = greatest * total ** (1.0 / power)
    return pooled[:, 0], pooled * (powers / np.maximum(total, np.finfo(float).tiny))


def worst_case(maxima: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """q and κ, of the shape of one episode's maxima, from those of N nominal episodes (N, …)."""
    ceiling = np.maximum(np.quantile(maxima, WORST, axis=0), FAINTEST)
    beyond = np.log(np.maximum(maxima / ceiling, 1.0))
    total, count = beyond.sum(axis=0), (beyond > 0).sum(axis=0)
    common = np.median(total / np.maximum(count, 1))  # Hill's estimate of ξ is total / count
    index = (total + DOUBT * common) / (count + DOUBT)
    return ceiling, LIGHT / np.maximum(index, LIGHT)


@compiled
def _step(
    vector: Any,
    lately: Any,
    steps: Any,
    errors: Any,
    context: Any,
    whitening: Any,
    ceiling: Any,
    tail: Any,
    habit: Any,
    gains: Any,
    bound: float,
) -> Any:
    """All of the above in one go: the fields of the new evidence, the value (B,) and the shares (B, X)."""
    B, X = errors.shape
    G, C = len(gains), context.shape[1]
    new, recent, value = np.empty((B, G, X)), np.empty((B, C)), np.empty(B)
    ratios, shares = np.empty((G, X)), np.zeros((B, X))
    whitened = np.dot(errors / np.sqrt(1.0 + (errors / bound) ** 2), whitening)
    for n in range(B):
        greatest = TINY
        for g in range(G):
            a = gains[g]
            variance = a / (2.0 - a) * (1.0 - (1.0 - a) ** (2 * (steps[n] + 1)))
            for i in range(X):
                w = vector[n, g, i] + a * (whitened[n, i] - vector[n, g, i])
                new[n, g, i] = w
                ratios[g, i] = (w * w / variance / ceiling[g, i]) ** tail[g, i]
                greatest = max(greatest, ratios[g, i])
        total = 0.0
        for g in range(G):
            for i in range(X):
                part = (ratios[g, i] / greatest) ** POWER
                shares[n, i] += part
                total += part
        drive = habit[2 * C]
        for c in range(C):
            recent[n, c] = lately[n, c] + LATELY * (context[n, c] - lately[n, c])
            drive += context[n, c] * habit[c] + recent[n, c] * habit[C + c]
        value[n] = greatest * total ** (1.0 / POWER) / np.exp(drive)
        for i in range(X):
            shares[n, i] *= value[n] / max(total, TINY)
    return (new, recent, steps + 1), value, shares


class Run(NamedTuple):
    """What a model said of one nominal episode."""

    errors: Array  # (T, X) normalised
    contexts: Array  # (T, C) what the model took to be going on; C may be 0


@dataclass(frozen=True, eq=False)
class Detector:
    """Turns a model's errors into one number that an alarm can be set on.

    Args:
        whitening: (X, X) M.
        ceiling: (G, X) q.
        tail: (G, X) κ, in (0, 1].
        habit: (2 C + 1,) weights of ŝ, on the context now and lately, and its bias.
        gains: (G,) a, each in (0, 1].
        bound: ν > 0.
    """

    whitening: NDArray[np.float64]
    ceiling: NDArray[np.float64]
    tail: NDArray[np.float64]
    habit: NDArray[np.float64]
    gains: NDArray[np.float64]
    bound: float

    @classmethod
    def fit(
        cls,
        learned: Sequence[Run],
        held_out: Sequence[Run],
        gains: Sequence[float],
        bound: float,
        shrinkage: float,
        rng: np.random.Generator,
    ) -> Self:
        """From nominal episodes that the model has learned, and others that it has not.

        How surprise depends on context is taken from those held out, for a model is too sure of what it has seen.
        """
        matrix = whitening(bounded(np.concatenate([r.errors for r in learned]), bound), shrinkage)
        a = np.asarray(gains, np.float64)
        ones = np.ones((len(a), len(matrix)))
        plain = cls(matrix, ones, ones, np.zeros(1), a, bound)
        ceiling, tail = worst_case(np.array([plain._strengths(r)[0].max(axis=0) for r in (*learned, *held_out)]))
        contexts, levels = [], []
        for r in held_out or learned:
            strengths, lately = plain._strengths(r)
            contexts.append(np.hstack([r.contexts, lately]).astype(np.float32))
            ratios = ((strengths / ceiling) ** tail).reshape(len(lately), -1)
            levels.append(np.log(np.maximum(pool(ratios)[0], FAINTEST)))
        habit = habituate(np.concatenate(contexts), np.concatenate(levels), rng)
        return cls(matrix, ceiling, tail, habit.astype(np.float64), a, bound)

    def start(self, batch: int) -> Evidence:
        """No evidence yet."""
        gains, size = self.ceiling.shape
        return no_evidence(batch, gains, size, (len(self.habit) - 1) // 2)

    def step(
        self, evidence: Evidence, errors: Array, context: Array
    ) -> tuple[Evidence, NDArray[np.float64], NDArray[np.float64]]:
        """The new evidence, the value (B,), and each error's share of it (B, X).

        Args:
            errors: (B, X) normalised.
            context: (B, C).
        """
        new, value, shares = _step(
            *evidence,
            np.asarray(errors, np.float64),
            np.asarray(context, np.float64),
            self.whitening,
            self.ceiling,
            self.tail,
            self.habit,
            self.gains,
            self.bound,
        )
        return Evidence(*new), value, shares

    def _strengths(self, run: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """v (T, G, X) and the running mean of the contexts (T, C) of a whole episode."""
        evidence = no_evidence(1, len(self.gains), len(self.whitening), run.contexts.shape[1])
        whitened = bounded(run.errors, self.bound) @ self.whitening
        strengths, lately = [], []
        for e, c in zip(whitened, run.contexts, strict=True):
            evidence = accumulate(evidence, e[None], c[None], self.gains)
            strengths.append(strength(evidence, self.gains)[0])
            lately.append(evidence.context[0])
        return np.array(strengths), np.array(lately)


def conformal_episodes(rate: float) -> int:
    """How many nominal episodes a false-alarm rate needs at least: ⌈1/rate⌉ - 1."""
    if not 0.0 < rate < 1.0:
        raise ValueError(f"false_alarm_rate must be in (0, 1), got {rate}")
    return math.ceil(1.0 / rate - 1e-9) - 1


def conformal_threshold(maxima: Array, rate: float) -> float:
    """The q that the maximum of a fresh nominal episode exceeds with a probability of at most ``rate``.

    The guarantee is over the draw of both the n calibration episodes and the fresh one, and needs no more than that
    they are exchangeable.

    Args:
        maxima: (n,) the largest value in each nominal episode.
        rate: P(any alarm in a nominal episode).
    """
    n, needed = len(maxima), conformal_episodes(rate)
    if n < needed:
        raise ValueError(f"a false alarm rate of {rate} needs at least {needed} nominal episodes, got {n}")
    rank = math.ceil((n + 1) * (1.0 - rate) - 1e-9)  # (n + 1)(1 - rate) is often whole, but not in floating point
    return float(np.sort(maxima)[rank - 1])
