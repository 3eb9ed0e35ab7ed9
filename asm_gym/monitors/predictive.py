"""Monitors that predict: a model's errors, judged by the detection that all of them share."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.detector import TINY, Detector, Evidence, Run, pool
from asm_gym.detection.repetition import Repetition, count_repetitions, improbability, repeated, unrepeated
from asm_gym.monitors.base import State
from asm_gym.monitors.monitor import CalibratedMonitor, Progress, require, side_by_side
from asm_gym.stream import StreamSpec

GAINS = (0.8, 0.2, 0.05)
BOUND = 20.0

FOUND = ("whitening", "ceiling", "tail", "habit")
"""What the detector has learned."""

HELD_OUT = 5
"""One in so many training episodes is not learned by the model, but shows how surprised it usually is."""


class PredictiveState(NamedTuple):
    """What is carried from step to step, one row a stream; a value, never changed in place."""

    model: State
    evidence: Evidence
    repetition: Repetition


class PredictiveMonitor(CalibratedMonitor):
    """A model of the stream, the detector of ``asm_gym.detection`` on its errors, and an eye for stuck senses.

    Args:
        spec: the stream it watches.
        gains: a in (0, 1], weights of the newest step in the accumulated evidence; several, for faults that come as
            a knock and faults that creep.
        bound: ν > 0, how many standard deviations an error counts at most, so that a knock that is soon over counts
            less than what stays.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        seed: of whatever learning draws.

    Attributes:
        detector_: what turns errors into surprise; None before ``fit``.
    """

    hyperparameters: ClassVar[tuple[str, ...]] = ("gains", "bound", "shrinkage", "seed")
    shortest = 2

    def __init__(
        self,
        spec: StreamSpec,
        gains: Sequence[float] = GAINS,
        bound: float = BOUND,
        shrinkage: float = 1e-3,
        seed: int = 0,
    ) -> None:
        super().__init__(spec, seed)
        require("gains", gains, len(gains) > 0 and all(0.0 < a <= 1.0 for a in gains), "numbers in (0, 1]")
        require("bound", bound, 0.0 < bound < math.inf, "positive and finite")
        require("shrinkage", shrinkage, 0.0 <= shrinkage <= 1.0, "in [0, 1]")
        self.gains, self.bound, self.shrinkage = tuple(map(float, gains)), float(bound), float(shrinkage)
        self.detector_: Detector | None = None

    @abstractmethod
    def learn_model(
        self, streams: Sequence[NDArray[np.float32]], rng: np.random.Generator, progress: Progress
    ) -> dict[str, NDArray[Any]]:
        """What the model is to know of nominal streams, (T, D) each."""

    @abstractmethod
    def build_model(self) -> None:
        """Makes what ``predict`` needs out of ``learned_``."""

    @abstractmethod
    def start_model(self, batch: int) -> State:
        """The model's state before the first row."""

    @abstractmethod
    def predict(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[Any], NDArray[Any]]:
        """The next rows (B, D): the model's new state, its errors (B, X), and the context (B, C) it found itself in.

        Errors are in standard deviations where the model knows them; C may be 0.
        """

    @property
    def judged(self) -> NDArray[np.intp]:
        """(X,) the column of the stream that each error belongs to."""
        return self.spec.sensory

    def learn(self, streams: Sequence[NDArray[np.float32]], progress: Progress) -> dict[str, NDArray[Any]]:
        rng = np.random.default_rng(self.seed)
        order = rng.permutation(len(streams))
        held_out = [streams[i] for i in order[: len(streams) // HELD_OUT]]
        learned = [streams[i] for i in order[len(held_out) :]]
        self.learned_ = self.learn_model(learned, rng, progress)
        self.build_model()
        certain = [Run(r.errors, r.contexts[:, :0]) for r in self._runs(learned)]
        runs = self._runs(held_out or learned)
        detector = Detector.fit(certain, runs, self.gains, self.bound, self.shrinkage, rng)
        senses = self.spec.sensory
        repetition = count_repetitions([s[:, senses] for s in streams], self.spec.noise[senses] > 0)
        return {**self.learned_, **{name: getattr(detector, name) for name in FOUND}, "repetition": repetition}

    def build(self) -> None:
        missing = [name for name in (*FOUND, "repetition") if name not in self.learned_]
        if missing:
            raise ValueError(f"the checkpoint has no {', '.join(missing)}: an older asm-gym wrote it, so fit it anew")
        self.build_model()
        found = {name: self.learned_[name] for name in FOUND}
        self.detector_ = Detector(**found, gains=np.array(self.gains), bound=self.bound)
        self._places = np.zeros((len(self.judged), self.spec.size))
        self._places[np.arange(len(self.judged)), self.judged] = 1.0

    def start(self, batch: int) -> PredictiveState:
        assert self.detector_ is not None
        none = unrepeated(batch, len(self.spec.sensory))
        return PredictiveState(self.start_model(batch), self.detector_.start(batch), none)

    def shares(self, state: PredictiveState, rows: NDArray[np.float64]) -> tuple[PredictiveState, NDArray[np.float64]]:
        assert self.detector_ is not None
        model, errors, context = self.predict(state.model, rows)
        evidence, _, parts = self.detector_.step(state.evidence, errors, context)
        senses = self.spec.sensory
        repetition = Repetition(*repeated(*state.repetition, rows[:, senses], self.learned_["repetition"]))
        found = self.attribute(parts)
        if repetition.unlikely.any():
            ratios = np.zeros_like(found)
            ratios[:, senses] = improbability(repetition)
            found = _joined(found, ratios)
        return PredictiveState(model, evidence, repetition), found

    def reset_evidence(self, state: PredictiveState) -> PredictiveState:
        """The state with the evidence so far forgotten, after an alarm that was acted on; the model goes on."""
        evidence, repetition = state.evidence, state.repetition
        return state._replace(
            evidence=evidence._replace(vector=np.zeros_like(evidence.vector)),
            repetition=repetition._replace(unlikely=np.zeros_like(repetition.unlikely)),
        )

    resynchronise = reset_evidence  # what it was called before; goes once the wrappers ask for the new name

    def attribute(self, parts: NDArray[np.float64]) -> NDArray[np.float64]:
        """(B, D) each number's share, from each error's (B, X)."""
        return parts @ self._places

    def _runs(self, streams: Sequence[NDArray[np.float32]]) -> list[Run]:
        """What the model says of whole episodes."""
        runs: dict[int, Run] = {}

        def advance(state: State, rows: NDArray[np.float64]) -> tuple[State, Run]:
            state, errors, context = self.predict(state, rows)
            return state, Run(errors, context)

        for group, steps in side_by_side(streams, self.start_model, advance):
            for n, i in enumerate(group):
                mine = steps[: len(streams[i])]
                runs[i] = Run(np.array([s.errors[n] for s in mine]), np.array([s.contexts[n] for s in mine]))
        return [runs[i] for i in range(len(streams))]


def _joined(found: NDArray[np.float64], ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each number's share (B, D) of what was found and of further ratios, pooled as those are that made it."""
    value = found.sum(axis=1, keepdims=True)
    _, parts = pool(np.hstack([value, ratios]))
    shared: NDArray[np.float64] = found * (parts[:, :1] / np.maximum(value, TINY)) + parts[:, 1:]
    return shared
