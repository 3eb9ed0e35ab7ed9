"""Scores of the literature: errors of one row or a few, relative to usual errors only.

    squares        Σ_i ε_i²
    mahalanobis    ‖M ε‖²                       M whitens the errors of nominal steps
    moving_mean    mean over 5 steps of ε_i²    summed over i
    largest        max_i |ε_i|

Sources: Xu et al. 2025 (RSS) for the moving mean; Haddadin, De Luca and Albu-Schäffer 2017, Eq. 31, for the largest.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array, Arrays, Floats, ModelOutput, Nominal, Place, State
from asm_gym.detection.evidence import whitening
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number

AVERAGED_ROWS = 5  # rows of the moving mean


class Squares:
    """The sum of squared errors, which learns nothing."""

    name = "squares"
    arrays: tuple[str, ...] = ()
    reach = math.inf

    def __init__(self, spec: StreamSpec) -> None:
        self.learned_: Arrays = {}

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        return self

    def restore(self, learned: Arrays) -> Self:
        self.learned_ = learned
        return self

    def start(self, batch: int, errors: int) -> State:
        return ()

    def attribute_step(
        self, state: State, output: ModelOutput, rows: Array, place: Place
    ) -> tuple[State, Floats]:
        return state, place(self.parts(output))

    def reset(self, state: State) -> State:
        return state

    def parts(self, output: ModelOutput) -> Floats:
        """Return each error's share of the score (B, X), >= 0."""
        return np.asarray(output.errors, np.float64) ** 2


class Mahalanobis(Squares):
    """The Mahalanobis distance of errors, squared; ``shrinkage`` is that of ``whitening``."""

    name = "mahalanobis"
    arrays = ("mahalanobis",)

    def __init__(self, spec: StreamSpec, shrinkage: float = 1e-3) -> None:
        super().__init__(spec)
        self.shrinkage = check_number("shrinkage", shrinkage, low=0.0, high=1.0)

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        errors = np.concatenate([r.errors for r in nominal.outputs(nominal.episodes)])
        return self.restore({"mahalanobis": whitening(errors, self.shrinkage)})

    def parts(self, output: ModelOutput) -> Floats:
        white: Floats = np.asarray(output.errors, np.float64) @ self.learned_["mahalanobis"]
        return white**2


class MovingMean(Squares):
    """Squared errors, averaged over the last few rows: the state (B, AVERAGED_ROWS, X), NaN before the first row."""

    name = "moving_mean"

    def start(self, batch: int, errors: int) -> NDArray[np.float64]:
        return np.full((batch, AVERAGED_ROWS, errors), np.nan)

    def attribute_step(
        self, state: State, output: ModelOutput, rows: Array, place: Place
    ) -> tuple[State, Floats]:
        state = np.concatenate([self.parts(output)[:, None], state[:, :-1]], axis=1)
        return state, place(np.nanmean(state, axis=1))


class Largest(Squares):
    """The largest error alone."""

    name = "largest"

    def parts(self, output: ModelOutput) -> Floats:
        sizes = np.abs(np.asarray(output.errors, np.float64))
        return np.where(np.arange(sizes.shape[1]) == sizes.argmax(axis=1)[:, None], sizes, 0.0)
