"""Completion: predict a sense from all other senses, the command and the row before.

    y_t = [v_t, v_{t-1}, u_t, p_t]      values now and before, the command, products of two slow values
    C   = ⟨y_t y_tᵀ⟩                    learned by coincidence alone (Hebb)
    v̂_M = C_MO (C_OO + λ)⁻¹ y_O         minimises the energy ½ yᵀ (C + λ)⁻¹ y over the missing senses M: precision 0

O is every entry in which no missing sense takes part. Products make curved relations, as between joint angles and the
position of the hand, linear enough.

Sources: Kohonen 1972 (IEEE Trans. Comput. 21(4)) for correlation matrix memories; Lauritzen 1996 for the conditionals
of a Gaussian. C is learned locally; the inverse is not local.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.linear_association import along, gram
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_shapes

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAIRED = 18  # the slowest senses go into products: an arm's joints and its hand
PENALTY = 1e-4  # λ, in units of the variance of a standardised number
MOST_ENTRIES = (
    2048  # largest length of y; wider streams are not completed, as C would outgrow the memory
)
FARTHEST = 30.0  # standardised numbers are clipped to this, so that one broken sense does not spoil all completions

ARRAYS = ("completion_products", "completion_covariance", "completion_centre", "completion_error")


class Filling(NamedTuple):
    """How missing senses are completed."""

    columns: NDArray[np.intp]  # (M,) of the stream
    weights: Floats  # (M, Y) from centred y
    error: Floats  # (M,) standard deviation of the error in nominal rows [unit of each]


@dataclass(frozen=True, eq=False)
class Completion:
    """A correlation memory of a stream."""

    senses: StreamScaler  # how it reads a row
    products: NDArray[np.intp]  # (P, 2) columns that are multiplied
    covariance: Floats  # (Y, Y) C of centred y
    centre: Floats  # (Y,) mean of y
    error: Floats  # (D,) standard deviation of a column's error when its sensor is completed, in spreads; 1 for actions

    @classmethod
    def fit(cls, senses: StreamScaler, streams: Sequence[NDArray[np.floating[Any]]]) -> Self | None:
        """Learn from training episodes (T, D); None for streams that are too wide."""
        spec, D = senses.spec, senses.spec.size
        slowest = senses.slow[
            np.argsort((senses.change / senses.spread)[senses.slow], kind="stable")
        ][:PAIRED]
        first, second = np.triu_indices(len(slowest))
        products = np.stack([slowest[first], slowest[second]], axis=1)
        Y = 2 * len(spec.sensory) + len(spec.motor) + len(products)
        if Y > MOST_ENTRIES:
            return None
        blank, rows = (
            cls(senses, products, np.eye(Y), np.zeros(Y), np.ones(D)),
            sum(map(len, streams)),
        )

        def mean(part: Callable[[Floats], Floats]) -> Floats:
            return np.asarray(sum(part(blank.lift(s)) for s in streams)) / rows

        centre = mean(lambda y: y.sum(axis=0))
        covariance = mean(lambda y: gram(y - centre))
        learned = cls(senses, products, covariance, centre, np.ones(D))
        error = np.ones(D)
        error[spec.sensory] = np.sqrt(mean(lambda y: np.sum(learned.unexplained(y) ** 2, axis=0)))
        return cls(senses, products, covariance, centre, error)

    @classmethod
    def found(cls, learned: Mapping[str, NDArray[Any]], senses: StreamScaler) -> Self | None:
        """Restore what ``named`` returned; None where it is absent. Raises ValueError where it does not fit."""
        if not all(name in learned for name in ARRAYS):
            return None
        products, covariance, centre, error = (
            np.asarray(learned[name], np.float64) for name in ARRAYS
        )
        spec, P = senses.spec, len(products)
        Y = 2 * len(spec.sensory) + len(spec.motor) + P
        check_shapes(learned, dict(zip(ARRAYS, ((P, 2), (Y, Y), (Y,), (spec.size,)), strict=True)))
        if P and not (products.min() >= 0 and products.max() < spec.size):
            raise ValueError("completion_products should be columns of the stream")
        return cls(senses, products.astype(np.intp), covariance, centre, error)

    def named(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        arrays = (
            self.products.astype(np.float32),
            self.covariance.astype(np.float32),
            self.centre,
            self.error,
        )
        return dict(zip(ARRAYS, arrays, strict=True))

    @property
    def spec(self) -> StreamSpec:
        return self.senses.spec

    @cached_property
    def sensors(self) -> tuple[tuple[str, NDArray[np.intp]], ...]:
        """Name and columns of each sensor."""
        return sensors_of(self.spec)

    def lift(self, stream: NDArray[np.floating[Any]]) -> Floats:
        """Return y (T, Y) of the rows (T, D) of an episode; numbers that are not finite count as their mean."""
        x = (np.asarray(stream, np.float64) - self.senses.mean) / self.senses.spread
        x = np.clip(np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0), -FARTHEST, FARTHEST)
        sensory, motor = x[:, self.spec.sensory], x[:, self.spec.motor]
        before = np.concatenate([sensory[:1], sensory[:-1]])
        return np.hstack(
            [sensory, before, motor, x[:, self.products[:, 0]] * x[:, self.products[:, 1]]]
        )

    def involved(self, missing: Mask) -> Mask:
        """Return the mask (Y,) of the entries of y in which columns of ``missing`` (D,) take part."""
        sensory = missing[self.spec.sensory]
        return np.concatenate(
            [sensory, sensory, missing[self.spec.motor], missing[self.products].any(axis=1)]
        )

    def filling(self, missing: Mask) -> Filling:
        """Return how to complete the senses of ``missing`` (D,) from all others."""
        C, (places, W) = self.covariance, self._weights(missing)
        columns = self.spec.sensory[places]
        left = C[places, places] - np.einsum("my,ym->m", W, C[:, places])
        # The error of one missing sensor was measured; that of several follows from C.
        error = np.sqrt(np.maximum(left, 0.0))
        return Filling(
            columns, W, np.maximum(error, self.error[columns]) * self.senses.spread[columns]
        )

    def complete(self, filling: Filling, lifted: Floats) -> Floats:
        """Return the completed senses (T, M) [unit of each] in rows of y (T, Y)."""
        scaler = self.senses
        return scaler.mean[filling.columns] + scaler.spread[filling.columns] * (
            self.centre[self._places(filling.columns)] + (lifted - self.centre) @ filling.weights.T
        )

    def _places(self, columns: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the places of sensory columns in y."""
        return np.searchsorted(self.spec.sensory, columns)

    @cached_property
    def precision(self) -> Floats:
        """P = (C + λ)⁻¹ (Y, Y)."""
        return np.linalg.inv(self.covariance + PENALTY * np.eye(len(self.covariance))).astype(
            np.float64
        )

    def _weights(self, missing: Mask) -> tuple[NDArray[np.intp], Floats]:
        """Return the places (M,) of the senses of ``missing`` (D,) in y, and the weights (M, Y) that complete them.

        With E, every entry in which they take part: C_MO (C_OO + λ)⁻¹ are the rows M of -(P_EE)⁻¹ P_EO. E is short.
        """
        E, P = np.flatnonzero(self.involved(missing)), self.precision
        places = np.flatnonzero(missing[self.spec.sensory])  # sensory entries come first in y
        W = -np.linalg.solve(P[np.ix_(E, E)], P[E])[np.searchsorted(E, places)].astype(np.float64)
        W[:, E] = 0.0
        return places, W

    @cached_property
    def each_alone(self) -> Floats:
        """Weights (S, Y) that complete each sensor alone."""
        W = np.zeros((len(self.spec.sensory), len(self.covariance)))
        for _, columns in self.sensors:
            missing = np.zeros(self.spec.size, bool)
            missing[columns] = True
            places, W_M = self._weights(missing)
            W[places] = W_M
        return W

    def unexplained(self, lifted: Floats) -> Floats:
        """Return the error (T, S), in spreads, of completing each sense's sensor from all else, for y (T, Y)."""
        centred = lifted - self.centre
        return centred[:, : len(self.spec.sensory)] - along(centred, self.each_alone)


def sensors_of(spec: StreamSpec) -> tuple[tuple[str, NDArray[np.intp]], ...]:
    """Return name and columns of each sensor, whose numbers fail together.

    A joint's position and velocity, the wrist's forces and torques, a mean and its peak are one; others are alone.
    """
    found: dict[str, list[int]] = {}
    for channel in spec.channels:
        start = spec.slices[channel.name].start
        if start not in spec.sensory:
            continue
        prefix, name = _split(channel.name)
        for i, label in enumerate(channel.labels):
            element = label[len(channel.name) :]
            if channel.group == "wrench":
                key = f"{prefix}wrist"
            elif name in ("joint_position", "joint_velocity"):
                key = f"{prefix}encoder{element}"
            else:
                key = prefix + name.removesuffix("_peak") + element
            found.setdefault(key, []).append(start + i)
    return tuple((name, np.array(columns, np.intp)) for name, columns in found.items())


def _split(name: str) -> tuple[str, str]:
    """Split the arm's prefix, which a stream of two arms has, from the rest."""
    head, _, tail = name.partition("_")
    return (f"{head}_", tail) if head.startswith("robot") and head[5:].isdigit() else ("", name)
