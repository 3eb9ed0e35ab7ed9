"""The detection of the memory: the detector on its errors, and evidence that senses are stuck.

joined     (value^p + Σ_i r_i^p)^(1/p)         value: of ``detector``; r_i: of senses that repeat themselves,
                                               see ``repetition``
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array, Arrays, Floats, ModelOutput, Nominal, Place
from asm_gym.detection.detector import BOUND, GAINS, Detector
from asm_gym.detection.evidence import HOURS_QUANTILE, HOURS_TAIL_INDEX, TAIL_INDEX, TINY, Evidence, ceilings, pool
from asm_gym.detection.repetition import MOST_BEYOND, RARER, Repetition, count_repetitions, evidence_steps
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_flag, check_number, check_shapes, short_repr, typed


class EvidenceState(NamedTuple):
    """State of B streams; never changed in place."""

    evidence: Evidence
    repetition: Repetition


class EvidenceDetection:
    """The detector on a model's errors, and evidence that senses are stuck.

    Args:
        spec: the stream.
        gains: a in (0, 1], weights of the newest row in the accumulated evidence, for sudden and slow faults.
        bound: ν > 0, standard deviations to which an error is bounded.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        habituates: whether surprise is relative to what is usual in a context; a memory for any policy does without.
        tail_index: ξ_0 in (0, 1]: a ratio falls off as probability to this power. The smaller, the more senses add up.

    Attributes:
        detector_: turns errors into surprise; None before ``fit``.
        repeating: evidence steps (2, 2, X) of repetitions, their upper bound (X,) and offset (X,), after ``fit``.
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
        self.spec, self.gains = spec, tuple(check_number("each of gains", a, above=0.0, high=1.0) for a in gains)
        if not self.gains:
            raise ValueError("gains must be numbers in (0, 1], got ()")
        self.bound = check_number("bound", bound, above=0.0)
        self.shrinkage = check_number("shrinkage", shrinkage, low=0.0, high=1.0)
        self.habituates = check_flag("habituates", habituates)
        self.tail_index = check_number("tail_index", tail_index, above=0.0, high=1.0)
        self.learned_: Arrays = {}
        self.detector_: Detector | None = None

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        """Fit the whitening to learned episodes, and ceilings and contexts to all."""
        learned, fresh = nominal.outputs(nominal.learned), nominal.outputs(nominal.held_out)
        how = self.gains, self.bound, self.shrinkage, rng, self.habituates, self.tail_index
        detector = Detector.fit(learned, fresh, *how)
        senses = self.spec.sensory
        counted = count_repetitions([e.stream[:, senses] for e in nominal.episodes], self.spec.noise[senses] > 0)
        return self.restore({name: getattr(detector, name) for name in self.arrays[:-1]} | {"repetition": counted})

    def with_ceilings(self, maxima: Array, anew: bool) -> EvidenceDetection:
        """Return a copy with q from the largest v (N, G, X) in healthy episodes, and κ ``anew`` by a smaller ξ_0."""
        tail = np.minimum(self.learned_["tail"] * (HOURS_TAIL_INDEX / self.tail_index if anew else 1.0), 1.0)
        how = self.gains, self.bound, self.shrinkage, self.habituates, self.tail_index
        learned = {**self.learned_, "ceiling": ceilings(maxima, HOURS_QUANTILE), "tail": tail}
        return EvidenceDetection(self.spec, *how).restore(learned)

    def restore(self, learned: Arrays) -> Self:
        """Take over what another has learned. Raises ValueError where it does not fit."""
        found = {name: learned[name] for name in self.arrays[:-1]}
        X = len(found["whitening"])
        check_shapes(found, {"whitening": (X, X), "ceiling": (len(self.gains), X), "tail": (len(self.gains), X)})
        for name, most in (("ceiling", math.inf), ("tail", 1.0)):
            if not ((found[name] > 0.0) & (found[name] <= most)).all():
                raise ValueError(f"the {name} of evidence must be in (0, {most:g}]")
        detector = Detector(**found, gains=np.array(self.gains), bound=self.bound)
        if not detector.reach > 1.0:  # what is seldom exceeded in nominal episodes
            raise ValueError(f"no error can add up to evidence: at most {detector.reach:g} of what is usual")
        counted, shape = learned["repetition"], (3, len(self.spec.sensory))
        if counted.shape != shape or not ((counted >= 0.0) & np.isfinite(counted)).all():
            raise ValueError(
                f"the repetition of evidence should be {shape} numbers of at least 0, found {short_repr(counted)}"
            )
        offset = counted[2] + RARER
        self.repeating = evidence_steps(counted[:2]), offset + MOST_BEYOND, offset
        self.learned_, self.detector_ = learned, detector
        return self

    @property
    def fitted_detector(self) -> Detector:
        """The detector, after ``fit``."""
        assert self.detector_ is not None
        return self.detector_

    @property
    def reach(self) -> float:
        """Largest surprise by errors in a context of 0; repetitions may add to it."""
        return self.fitted_detector.reach

    def reach_of(self, errors: NDArray[np.intp]) -> Floats:
        """Return the largest surprise (N,) by each of the errors (N,) alone."""
        return self.fitted_detector.reach_of_errors[errors]

    def start(self, batch: int, errors: int) -> EvidenceState:
        """Return the state before the first row."""
        return EvidenceState(self.fitted_detector.start(batch), Repetition.start(batch, len(self.spec.sensory)))

    def attribute_step(
        self, state: EvidenceState, output: ModelOutput, rows: Floats, place: Place
    ) -> tuple[EvidenceState, Floats]:
        """Return the new state, and each number's share (B, D) of the surprise at the next rows (B, D)."""
        evidence, _, parts = self.fitted_detector.step(state.evidence, *output)
        senses, (steps, most, offset) = self.spec.sensory, self.repeating
        repetition = state.repetition.followed_by(rows[:, senses], steps, most)
        found = place(parts)
        if repetition.unlikely.any():
            ratios = np.zeros_like(found)
            ratios[:, senses] = repetition.ratios(offset)
            found = _joined(found, ratios)
        return EvidenceState(evidence, repetition), found

    def reset(self, state: EvidenceState) -> EvidenceState:
        """Return the state without its evidence; its number of rows and its context are kept."""
        return EvidenceState(
            state.evidence._replace(vector=np.zeros_like(state.evidence.vector)),
            state.repetition._replace(unlikely=np.zeros_like(state.repetition.unlikely)),
        )


def _joined(found: Floats, ratios: Floats) -> Floats:
    """Return each number's share (B, D) of its surprise so far pooled with further ratios."""
    value = found.sum(axis=1, keepdims=True)
    _, parts = pool(np.hstack([value, ratios]))
    return found * (parts[:, :1] / np.maximum(value, TINY)) + parts[:, 1:]
