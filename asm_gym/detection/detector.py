"""The detector: from a model's errors to one number that an alarm can be set on.

ε_t/σ_t → whitened, bounded → evidence → ratios → pooled s_t          one module each: ``whitening`` to ``evidence``
value      s_t / ŝ(c_t)                                               ŝ: what s seldom exceeds in such a context,
                                                                      see ``habituation``
joined     (value^p + Σ_i r_i^p)^(1/p)                                r_i: of senses that repeat themselves, see
                                                                      ``repetition``
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Array, Arrays, ModelOutput, Nominal, Place
from asm_gym.detection.evidence import CONTEXT_GAIN, POWER, TINY, Evidence, accumulated, no_evidence, pool, strength
from asm_gym.detection.habituation import STEPS_PER_NUMBER, usual_levels
from asm_gym.detection.repetition import (
    MOST_BEYOND,
    REPETITION_OFFSET,
    Repetition,
    count_repetitions,
    evidence_steps,
    improbability,
    repeated,
    unrepeated,
)
from asm_gym.detection.tails import HOURS_QUANTILE, HOURS_TAIL_INDEX, TAIL_INDEX, ceilings, worst_case
from asm_gym.detection.whitening import bounded, whitening
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_flag, check_number, shown, typed

GAINS = (0.8, 0.2, 0.05)
BOUND = 100.0

ANYTHING = np.array([-700.0, 700.0])
"""A range of logarithms that bounds nothing, as in monitors saved before there was one."""

MOST_ROWS = 60_000
"""What is usual in a context is learned from so many rows at most, evenly spaced: more would fill the memory."""

FAINTEST = 1e-9
"""Lower bound of s where its logarithm is taken."""

LEAST = math.log(TINY)
NOTHING = -50.0
"""Logarithm of a share that no double has room for beside 1."""


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
    context_quantile: Any,
    context_range: Any,
    gains: Any,
    bound: float,
) -> Any:
    """All of the above in one go: the fields of the new evidence, the value (B,) and the shares (B, X)."""
    B, X = errors.shape
    G, C = len(gains), context.shape[1]
    new, recent, value = np.empty((B, G, X)), np.empty((B, C)), np.empty(B)
    ratios, shares = np.empty((G, X)), np.zeros((B, X))  # of ratios their logarithms
    whitened = np.dot(errors / np.sqrt(1.0 + (errors / bound) ** 2), whitening)
    for n in range(B):
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
                if not below < NOTHING:  # what is not a number goes on, and is an alarm
                    part = np.exp(below)
                    shares[n, i] += part
                    total += part
        drive = context_quantile[2 * C]
        for c in range(C):
            recent[n, c] = lately[n, c] + CONTEXT_GAIN * (context[n, c] - lately[n, c])
            drive += context[n, c] * context_quantile[c] + recent[n, c] * context_quantile[C + c]
        usual = min(max(drive, context_range[0]), context_range[1])
        value[n] = np.exp(greatest) * total ** (1.0 / POWER) / np.exp(usual)
        for i in range(X):
            shares[n, i] *= value[n] / max(total, TINY)
    return (new, recent, steps + 1), value, shares


@dataclass(frozen=True, eq=False)
class Detector:
    """Turns a model's errors into one number that an alarm can be set on.

    Args:
        whitening: (X, X) M.
        ceiling: (G, X) q.
        tail: (G, X) κ, in (0, 1].
        context_quantile: (2 C + 1,) weights of ŝ, on the context now and lately, and its bias.
        context_range: (2,) what log ŝ stays within, whatever the context.
        gains: (G,) a, each in (0, 1].
        bound: ν > 0.
    """

    whitening: NDArray[np.float64]
    ceiling: NDArray[np.float64]
    tail: NDArray[np.float64]
    context_quantile: NDArray[np.float64]
    context_range: NDArray[np.float64]
    gains: NDArray[np.float64]
    bound: float

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
        """From nominal episodes that the model has learned, and others that it has not."""
        matrix = whitening(bounded(np.concatenate([r.errors for r in learned]), bound), shrinkage)
        a = np.asarray(gains, np.float64)
        ones = np.ones((len(a), len(matrix)))
        plain = cls(matrix, ones, ones, np.zeros(1), ANYTHING, a, bound)
        everything = [*learned, *held_out]
        ceiling, tail = worst_case(np.array([plain.strengths(r)[0].max(axis=0) for r in everything]), tail_index)
        steps, numbers = sum(len(r.errors) for r in everything), 2 * everything[0].contexts.shape[1]
        if not habituates or steps < STEPS_PER_NUMBER * numbers:
            return cls(matrix, ceiling, tail, np.zeros(numbers + 1), np.zeros(2), a, bound)
        apart = -(-steps // MOST_ROWS)
        contexts, levels = [], []
        for r in everything:
            strengths, lately = plain.strengths(r)
            contexts.append(np.hstack([r.contexts, lately])[::apart].astype(np.float32))
            ratios = ((strengths / ceiling) ** tail).reshape(len(lately), -1)
            levels.append(np.log(np.maximum(pool(ratios)[0], FAINTEST))[::apart])
        usual = usual_levels(contexts, levels, rng)
        return cls(matrix, ceiling, tail, usual.weights, usual.span, a, bound)

    @property
    def reach(self) -> float:
        """What the value comes to at most in a context of 0: every error at ν, and for ever.

        |w_i| <= ν Σ_j |M_ji|, so that v_i <= (ν Σ_j |M_ji|)² (2 - a) / a.
        """
        most = (self.bound * np.abs(self.whitening).sum(axis=0)) ** 2 * ((2.0 - self.gains) / self.gains)[:, None]
        with np.errstate(over="ignore"):
            ratios = (most / self.ceiling) ** self.tail  # (G, X)
            return float(pool(ratios.reshape(1, -1))[0][0] / np.exp(self.context_quantile[-1]))

    @property
    def reach_of_errors(self) -> NDArray[np.float64]:
        """(X,) what the value comes to where least is usual, one error alone at ν for ever, and the others at 0."""
        most = (self.bound * self.whitening) ** 2  # (X of the error, X)
        with np.errstate(over="ignore", divide="ignore"):
            ratios = (most[:, None, :] * ((2.0 - self.gains) / self.gains)[:, None] / self.ceiling) ** self.tail
            pooled = pool(ratios.reshape(len(most), -1))[0]
            found: NDArray[np.float64] = pooled / np.exp(min(self.context_quantile[-1], self.context_range[0]))
        return found

    def start(self, batch: int) -> Evidence:
        """No evidence yet."""
        gains, size = self.ceiling.shape
        return no_evidence(batch, gains, size, (len(self.context_quantile) - 1) // 2)

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
            self.context_quantile,
            self.context_range,
            self.gains,
            self.bound,
        )
        return Evidence(*new), value, shares

    def strengths(self, run: ModelOutput) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """v (T, G, X) and the running mean of the contexts (T, C) of a whole episode."""
        whitened = bounded(run.errors, self.bound) @ self.whitening
        vectors, lately = accumulated(whitened, np.asarray(run.contexts, np.float64), self.gains)
        whole = Evidence(vectors, lately, np.arange(1, len(vectors) + 1))
        return strength(whole, self.gains), whole.context


class EvidenceState(NamedTuple):
    """What is carried from step to step, one row a stream; a value, never changed in place."""

    evidence: Evidence
    repetition: Repetition


class EvidenceDetection:
    """The detector on a model's errors, and an eye for senses that are stuck.

    Args:
        spec: the stream that is watched.
        gains: a in (0, 1], weights of the newest step in the accumulated evidence; several, for faults that come as
            a knock and faults that creep.
        bound: ν > 0, how many standard deviations an error counts at most, so that a knock that is soon over counts
            less than what stays.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        habituates: surprise is measured against what is usual in a context. A context knows the policy, so a memory
            that is to watch any policy leaves it out.
        tail_index: ξ_0 in (0, 1]: a ratio falls off as probability to this power. The smaller, the more senses add up.

    Attributes:
        detector_: what turns errors into surprise; None before ``fit``.
    """

    name = "evidence"
    arrays: tuple[str, ...] = ("whitening", "ceiling", "tail", "context_quantile", "context_range", "repetition")

    @typed
    def __init__(
        self,
        spec: StreamSpec,
        gains: Sequence[float] = GAINS,
        bound: float = BOUND,
        shrinkage: float = 1e-3,
        habituates: bool = True,
        tail_index: float = TAIL_INDEX,
    ) -> None:
        try:
            self.spec, self.gains = spec, tuple(check_number("gains", a, above=0.0, high=1.0) for a in gains)
        except ValueError as error:
            raise ValueError(f"gains must be numbers in (0, 1], got {shown(gains)}") from error
        if not self.gains:
            raise ValueError("gains must be numbers in (0, 1], got ()")
        self.bound = check_number("bound", bound, above=0.0)
        self.shrinkage = check_number("shrinkage", shrinkage, low=0.0, high=1.0)
        self.habituates = check_flag("habituates", habituates)
        self.tail_index = check_number("tail_index", tail_index, above=0.0, high=1.0)
        self.learned_: Arrays = {}
        self.detector_: Detector | None = None

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        """Whitening from what the model has learned; its ceilings, and what is usual in a context, from all."""
        learned, fresh = nominal.outputs(nominal.learned), nominal.outputs(nominal.held_out)
        how = self.gains, self.bound, self.shrinkage, rng, self.habituates, self.tail_index
        detector = Detector.fit(learned, fresh, *how)
        senses = self.spec.sensory
        counted = count_repetitions([e.stream[:, senses] for e in nominal.episodes], self.spec.noise[senses] > 0)
        return self.restore({name: getattr(detector, name) for name in self.arrays[:-1]} | {"repetition": counted})

    def fewer(
        self, spec: StreamSpec, left: NDArray[np.intp], widened: NDArray[np.float64], narrower: NDArray[np.float64]
    ) -> EvidenceDetection:
        """The detection on what is ``left`` (X',) of the errors, which became E' = (E + widened) narrower narrowerᵀ."""
        old = self.learned_
        E = np.linalg.inv(old["whitening"] @ old["whitening"])[np.ix_(left, left)]  # ZCA: M = E^(-1/2)
        values, vectors = np.linalg.eigh((E + widened) * np.outer(narrower, narrower))
        kept = {name: old[name][:, left] for name in ("ceiling", "tail", "repetition")}
        usual = {name: old[name] for name in ("context_quantile", "context_range")}
        matrix = (vectors / np.sqrt(values)) @ vectors.T
        return self._anew(spec).restore({"whitening": matrix, **usual, **kept})

    def with_ceilings(self, maxima: Array, anew: bool) -> EvidenceDetection:
        """The same, with q from the largest v in each of N healthy episodes (N, G, X); κ goes by a smaller ξ_0.

        Args:
            anew: no hours told q before, so that κ does not go by it yet.
        """
        tail = np.minimum(self.learned_["tail"] * (HOURS_TAIL_INDEX / self.tail_index if anew else 1.0), 1.0)
        told = {"ceiling": ceilings(maxima, HOURS_QUANTILE), "tail": tail}
        return self._anew(self.spec).restore({**self.learned_, **told})

    def _anew(self, spec: StreamSpec) -> EvidenceDetection:
        return EvidenceDetection(spec, self.gains, self.bound, self.shrinkage, self.habituates, self.tail_index)

    def restore(self, learned: Arrays) -> Self:
        found = {name: learned[name] for name in self.arrays[:-1]}
        X = len(found["whitening"])
        for name, shape in {"whitening": (X, X), **dict.fromkeys(("ceiling", "tail"), (len(self.gains), X))}.items():
            if found[name].shape != shape:
                raise ValueError(f"the {name} of evidence should be of shape {shape}, found {found[name].shape}")
        for name, most in (("ceiling", math.inf), ("tail", 1.0)):
            if not ((found[name] > 0.0) & (found[name] <= most)).all():
                raise ValueError(f"the {name} of evidence must be in (0, {most:g}]")
        detector = Detector(**found, gains=np.array(self.gains), bound=self.bound)
        if not detector.reach > 1.0:  # what is seldom exceeded in nominal episodes
            raise ValueError(f"no error can add up to evidence: at most {detector.reach:g} of what is usual")
        counted, senses = learned["repetition"], len(self.spec.sensory)
        if counted.shape == (2, senses):  # of an older memory
            counted = np.concatenate([counted, np.full((1, senses), REPETITION_OFFSET)])
        if counted.shape != (3, senses) or not ((counted >= 0.0) & np.isfinite(counted)).all():
            raise ValueError(
                f"the repetition of evidence should be (3, {senses}) numbers of at least 0, found {shown(counted)}"
            )
        offset = counted[2]
        self._steps, self._offset, self._most = evidence_steps(counted[:2]), offset, offset + MOST_BEYOND
        self.learned_, self.detector_ = learned, detector
        return self

    @property
    def repeating(self) -> tuple[NDArray[np.float64], ...]:
        """What changes and repetitions add up by (2, 2, X), what they may come to, and what they must exceed (X,)."""
        return self._steps, self._most, self._offset

    @property
    def reach(self) -> float:
        assert self.detector_ is not None
        # Repetitions add to it, in senses that have noise.
        return self.detector_.reach

    def reach_of(self, errors: NDArray[np.intp]) -> NDArray[np.float64]:
        """What some of the errors (N,) alone can make of surprise (N,)."""
        assert self.detector_ is not None
        return self.detector_.reach_of_errors[errors]

    def start(self, batch: int, errors: int) -> EvidenceState:
        assert self.detector_ is not None
        return EvidenceState(self.detector_.start(batch), unrepeated(batch, len(self.spec.sensory)))

    def attribute_step(
        self, state: EvidenceState, output: ModelOutput, rows: NDArray[np.float64], place: Place
    ) -> tuple[EvidenceState, NDArray[np.float64]]:
        assert self.detector_ is not None
        evidence, _, parts = self.detector_.step(state.evidence, *output)
        senses = self.spec.sensory
        repetition = Repetition(*repeated(*state.repetition, rows[:, senses], self._steps, self._most))
        found = place(parts)
        if repetition.unlikely.any():
            ratios = np.zeros_like(found)
            ratios[:, senses] = improbability(repetition, self._offset)
            found = _joined(found, ratios)
        return EvidenceState(evidence, repetition), found

    def reset(self, state: EvidenceState) -> EvidenceState:
        """The state with the evidence so far forgotten; how long it is in the making, and its context, are kept."""
        return EvidenceState(
            state.evidence._replace(vector=np.zeros_like(state.evidence.vector)),
            state.repetition._replace(unlikely=np.zeros_like(state.repetition.unlikely)),
        )


def _joined(found: NDArray[np.float64], ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each number's share (B, D) of what was found and of further ratios, pooled as those are that made it."""
    value = found.sum(axis=1, keepdims=True)
    _, parts = pool(np.hstack([value, ratios]))
    shared: NDArray[np.float64] = found * (parts[:, :1] / np.maximum(value, TINY)) + parts[:, 1:]
    return shared
