"""Ridge regression of values on the inputs of other senses, with penalties by errors in rows of other folds.

    W    = (ZᵀZ/N + λ)⁻¹ ZᵀX/N           of all rows, for the λ that leaves the least in rows of other folds
    R²   = 1 - Σ ε² / N var x            ε: cross-fitted errors
    h    = zᵀ (ZᵀZ/N + λ_h)⁻¹ z          leverage; its median h̃ is cross-fitted

There are five folds over episodes, or over blocks of rows where episodes are few.

Sources: Hoerl and Kennard 1970; for h: Hoaglin and Welsch 1978 (The American Statistician 32).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Places = NDArray[np.intp]

CROSSFIT_FOLDS = 5
ALL_ROWS = CROSSFIT_FOLDS  # index of the equations of all rows, after those without each fold
RIDGE_PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # λ, of standardised inputs
STIFFNESS = 1e-3  # λ_h
WORTHWHILE = 0.5  # share of an arm's squared error below which all inputs predict a torque instead
LEAST_REMAINDER = 1e-4  # of what is left of a standardised number


def folds_of(lengths: Sequence[int]) -> Places:
    """Return the fold (N,) of each row of episodes: whole episodes, or blocks where they are few."""
    if len(lengths) >= CROSSFIT_FOLDS:
        return np.repeat(np.arange(len(lengths)) % CROSSFIT_FOLDS, lengths)
    rows = sum(lengths)
    numbers = np.arange(rows, dtype=np.intp)
    return numbers * CROSSFIT_FOLDS // max(rows, 1)


@dataclass(frozen=True, eq=False)
class FoldEquations:
    """Normal equations of N rows, without the rows of each fold, and at last of all rows.

    Attributes:
        inputs: Z (N, I).
        values: X (N, X), to be predicted.
        fold: (N,) of each row.
        grams: ZᵀZ/N (CROSSFIT_FOLDS + 1, I, I).
        products: ZᵀX/N (CROSSFIT_FOLDS + 1, I, X).
    """

    inputs: Floats
    values: Floats
    fold: Places
    grams: Floats
    products: Floats

    @classmethod
    def of(cls, inputs: Floats, values: Floats, fold: Places) -> Self:
        """Return the equations of rows."""
        return cls(
            inputs=inputs,
            values=values,
            fold=fold,
            grams=_mean_products(inputs, inputs, fold),
            products=_mean_products(inputs, values, fold),
        )

    def weights(self, fold: int, used: Places, targets: Places, penalty: float) -> Floats:
        """Return the weights (U, M) of the inputs ``used`` (U,) for the values ``targets`` (M,)."""
        gram = self.grams[fold][np.ix_(used, used)]
        products = self.products[fold][np.ix_(used, targets)]
        ridge = penalty * np.eye(len(used))
        return np.linalg.solve(gram + ridge, products)

    def errors(self, used: Places, targets: Places, penalty: float) -> Floats:
        """Return the errors (N, M) in each row by the equations without its fold."""
        errors = self.values[:, targets].copy()
        for fold in range(CROSSFIT_FOLDS):
            rows = self.fold == fold
            inputs = self.inputs[rows][:, used]
            errors[rows] -= inputs @ self.weights(fold, used, targets, penalty)
        return errors

    def leverage(self, used: Places) -> Leverage:
        """Return the leverage of rows by the inputs ``used``."""
        size = self.inputs.shape[1]
        among_used = np.ix_(used, used)
        inverses = [regular_inverse(gram[among_used]) for gram in self.grams]
        h = np.zeros(len(self.fold))
        for fold in range(CROSSFIT_FOLDS):
            rows = self.fold == fold
            inputs = self.inputs[rows][:, used]
            h[rows] = quadratic_form(inputs, inverses[fold])

        usual = np.median(h)
        matrix = np.zeros((size, size))
        matrix[among_used] = inverses[ALL_ROWS] / usual
        widening = np.sqrt(np.maximum(1.0, h / usual))
        return Leverage(matrix=matrix, widening=widening)


def _mean_products(inputs: Floats, values: Floats, fold: Places) -> Floats:
    """Return ZᵀX/N without the rows of each fold, and of all rows at last (CROSSFIT_FOLDS + 1, I, X)."""
    products_of_folds = []
    for number in range(CROSSFIT_FOLDS):
        rows = fold == number
        products_of_folds.append(inputs[rows].T @ values[rows])
    products = np.array(products_of_folds)
    total = products.sum(axis=0)
    others = total - products

    all_rows = len(inputs)
    other_rows = all_rows - np.bincount(fold, minlength=CROSSFIT_FOLDS)
    counts = np.maximum(np.append(other_rows, all_rows), 1)
    return np.array([*others, total]) / counts[:, None, None]


class Leverage(NamedTuple):
    """How unlike the rows that were learned from others are."""

    matrix: Floats  # (I, I) zᵀ matrix z is h/h̃
    widening: Floats  # (N,) cross-fitted √max(1, h/h̃)


def regular_inverse(gram: Floats) -> Floats:
    """Return (ZᵀZ/N + λ_h)⁻¹ of ZᵀZ/N (I, I)."""
    stiffness = STIFFNESS * np.eye(len(gram))
    return np.linalg.inv(gram + stiffness).astype(np.float64)


def quadratic_form(z: Floats, matrix: Floats) -> Floats:
    """Return zᵀ M z (N,) of the rows z (N, I)."""
    return ((z @ matrix) * z).sum(axis=1)


class CrossFit:
    """Weights of each value, and its cross-fitted errors.

    Args:
        equations: of the rows.
        by_arm: sets of inputs of each torque that are of a model of the arm.
        groups: (X,) the group of each value, by number.
        withheld: of each group the inputs that it is not predicted from.

    Attributes:
        weights: (X, I).
        errors: (N, X) cross-fitted.
        used: inputs that each value is predicted from.
    """

    def __init__(
        self,
        equations: FoldEquations,
        by_arm: Mapping[int, Sequence[Places]],
        groups: Places,
        withheld: Sequence[Places],
    ) -> None:
        rows, size = equations.inputs.shape
        values = equations.values.shape[1]
        self.equations = equations
        self.weights = np.zeros((values, size))
        self.errors = np.zeros((rows, values))
        self.used: list[Places] = [np.zeros(0, np.intp)] * values
        self._squares = np.full(values, np.inf)  # of these errors
        for value, candidates in by_arm.items():
            for inputs in candidates:
                self._fit(np.array([value]), inputs, worthwhile=1.0)
        for group, withheld_inputs in enumerate(withheld):
            used = np.setdiff1d(np.arange(size), withheld_inputs)
            self._fit(np.flatnonzero(groups == group), used, WORTHWHILE)

    def _fit(self, targets: Places, used: Places, worthwhile: float) -> None:
        """Fit values by the penalty that leaves the least, in place of an earlier fit of which only a share is left."""
        errors = [self.equations.errors(used, targets, penalty) for penalty in RIDGE_PENALTIES]
        squares = (np.array(errors) ** 2).sum(axis=1)  # (P, M)
        improves = squares.min(axis=0) < worthwhile * self._squares[targets]
        best = squares.argmin(axis=0)  # (M,) which penalty
        for n, penalty in enumerate(RIDGE_PENALTIES):
            chosen = np.flatnonzero(improves & (best == n))
            if not len(chosen):
                continue
            values = targets[chosen]
            self.errors[:, values] = errors[n][:, chosen]
            self._squares[values] = squares[n, chosen]
            self.weights[values] = 0.0
            weights = self.equations.weights(ALL_ROWS, used, values, penalty)
            self.weights[np.ix_(values, used)] = weights.T
            for value in values:
                self.used[value] = used

    @property
    def R2(self) -> Floats:  # noqa: N802
        """(X,) share of each value's variance that is predicted in rows of other folds."""
        variance = self.equations.values.var(axis=0)
        unexplained = (self.errors**2).mean(axis=0)
        return 1.0 - unexplained / np.maximum(variance, LEAST_REMAINDER**2)
