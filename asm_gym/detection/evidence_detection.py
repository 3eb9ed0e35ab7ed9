"""The detection of the memory: the detector on its errors, and evidence that senses are stuck.

joined     (value^p + Σ_i r_i^p)^(1/p)         value: of ``detector``; r_i: of senses that repeat themselves,
                                               see ``repetition``
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array, Arrays, Floats, ModelOutput, Nominal, Place
from asm_gym.detection.detector import BOUND, GAINS, Detector
from asm_gym.detection.evidence import (
    HOURS_QUANTILE,
    HOURS_TAIL_INDEX,
    POWER,
    TAIL_INDEX,
    Evidence,
    ceilings,
)
from asm_gym.detection.repetition import (
    MOST_BEYOND,
    RARER,
    Repetition,
    RepetitionWeights,
    count_repetitions,
    evidence_steps,
    pool_repetitions,
)
from asm_gym.scaling import carried_columns
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
        repetition_: turns repeated readings into evidence; None before ``fit``.
    """

    name = "evidence"
    power = POWER  # p
    arrays: tuple[str, ...] = (
        "whitening",
        "ceiling",
        "tail",
        "context_quantile",
        "context_range",
        "repetition",
    )

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
        self.spec = spec
        self.gains = tuple(check_number("each of gains", a, above=0.0, high=1.0) for a in gains)
        if not self.gains:
            raise ValueError("gains must be numbers in (0, 1], got ()")
        self.bound = check_number("bound", bound, above=0.0)
        self.shrinkage = check_number("shrinkage", shrinkage, low=0.0, high=1.0)
        self.habituates = check_flag("habituates", habituates)
        self.tail_index = check_number("tail_index", tail_index, above=0.0, high=1.0)
        self.learned_: Arrays = {}
        self.detector_: Detector | None = None
        self.repetition_: RepetitionWeights | None = None

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        """Fit the whitening to learned episodes, and ceilings and contexts to all."""
        learned = nominal.outputs(nominal.learned)
        everything = [*learned, *nominal.outputs(nominal.held_out)]
        detector = Detector.white(learned, self.gains, self.bound, self.shrinkage)
        detector = detector.with_worst_case(everything, self.tail_index)
        if self.habituates:
            detector = detector.habituated(everything, rng)

        senses = self.spec.sensory
        streams = [episode.stream[:, senses] for episode in nominal.episodes]
        arrays = {name: getattr(detector, name) for name in self.arrays[:-1]}
        arrays["repetition"] = count_repetitions(streams, self.spec.noise[senses] > 0)
        return self.restore(arrays)

    def with_ceilings(self, maxima: Array, is_first: bool) -> EvidenceDetection:
        """Return a copy with q from the largest v (N, G, X) in healthy episodes.

        The first time, κ changes to that of a smaller ξ_0.
        """
        tail = self.learned_["tail"]
        if is_first:
            tail = tail * (HOURS_TAIL_INDEX / self.tail_index)
        ceiling = ceilings(maxima, HOURS_QUANTILE)
        learned = {**self.learned_, "ceiling": ceiling, "tail": np.minimum(tail, 1.0)}
        return copy.copy(self).restore(learned)

    def restore(self, learned: Arrays) -> Self:
        """Take over what another has learned. Raises ValueError where it does not fit."""
        detector = self._detector_of(learned)
        repetition = self._repetition_of(learned["repetition"])
        self.learned_ = learned
        self.detector_ = detector
        self.repetition_ = repetition
        return self

    def _detector_of(self, learned: Arrays) -> Detector:
        """Return the detector of learned arrays. Raises ValueError where they do not fit."""
        arrays = {name: np.array(learned[name], np.float64) for name in self.arrays[:-1]}
        errors = len(arrays["whitening"])
        each = (len(self.gains), errors)
        check_shapes(arrays, {"whitening": (errors, errors), "ceiling": each, "tail": each})
        for name, most in (("ceiling", math.inf), ("tail", 1.0)):
            array = arrays[name]
            if not ((array > 0.0) & (array <= most)).all():
                raise ValueError(f"the {name} of evidence must be in (0, {most:g}]")

        detector = Detector(**arrays, gains=np.array(self.gains), bound=self.bound)
        if not detector.reach > 1.0:  # what is seldom exceeded in nominal episodes
            raise ValueError(
                f"no error can add up to evidence: at most {detector.reach:g} of what is usual"
            )
        return detector

    def _repetition_of(self, counted: NDArray[Any]) -> RepetitionWeights:
        """Return what ``count_repetitions`` counted. Raises ValueError where it does not fit."""
        shape = (3, len(self.spec.sensory))
        if counted.shape != shape or not ((counted >= 0.0) & np.isfinite(counted)).all():
            raise ValueError(
                f"the repetition of evidence should be {shape} numbers of at least 0, "
                f"found {short_repr(counted)}"
            )
        offset = counted[2] + RARER
        return RepetitionWeights(
            columns=self.spec.sensory,
            steps=evidence_steps(counted[:2]),
            most=offset + MOST_BEYOND,
            offset=offset,
            carried=carried_columns(self.spec)[self.spec.sensory],
        )

    @property
    def fitted_detector(self) -> Detector:
        """The detector, after ``fit``."""
        assert self.detector_ is not None
        return self.detector_

    @property
    def fitted_repetition(self) -> RepetitionWeights:
        """What turns repeated readings into evidence, after ``fit``."""
        assert self.repetition_ is not None
        return self.repetition_

    @property
    def reach(self) -> float:
        """Largest surprise by errors in a context of 0; repetitions may add to it."""
        return self.fitted_detector.reach

    def reach_of(self, errors: NDArray[np.intp]) -> Floats:
        """Return the largest surprise (N,) by each of the errors (N,) alone."""
        return self.fitted_detector.reach_of_errors[errors]

    def start(self, batch: int, errors: int) -> EvidenceState:
        """Return the state before the first row."""
        return EvidenceState(
            evidence=self.fitted_detector.start(batch),
            repetition=Repetition.start(batch, len(self.spec.sensory)),
        )

    def attribute_step(
        self, state: EvidenceState, output: ModelOutput, rows: Floats, place: Place
    ) -> tuple[EvidenceState, Floats]:
        """Return the new state, and each number's share (B, D) of the surprise at the next rows (B, D)."""
        weights = self.fitted_repetition
        evidence, error_shares = self.fitted_detector.step(state.evidence, output)
        repetition = state.repetition.followed_by(rows, weights)
        shares = place(error_shares)
        for share, unlikely in zip(shares, repetition.unlikely, strict=True):
            pool_repetitions(weights, unlikely, share)
        return EvidenceState(evidence=evidence, repetition=repetition), shares

    def reset(self, state: EvidenceState) -> EvidenceState:
        """Return the state without its evidence; its number of rows and its context are kept."""
        evidence, repetition = state
        return EvidenceState(
            evidence=evidence._replace(vector=np.zeros_like(evidence.vector)),
            repetition=repetition._replace(unlikely=np.zeros_like(repetition.unlikely)),
        )
