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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.linear_association import along, gram
from asm_gym.scaling import StreamScaler
from asm_gym.spec import Channel, StreamSpec
from asm_gym.validation import check_shapes

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAIRED = 18  # the slowest senses go into products: an arm's joints and its hand
PENALTY = 1e-4  # λ, in units of the variance of a standardised number
# largest length of y; wider streams are not completed, as C would outgrow the memory
MOST_ENTRIES = 2048
# standardised numbers are clipped to this, so that one broken sense does not spoil all completions
FARTHEST = 30.0

ARRAYS = (
    "completion_products",
    "completion_covariance",
    "completion_centre",
    "completion_error",
    "completion_usual",
)


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
    # (D,) standard deviation of a column's error when its sensor is completed [spread]; 1: actions
    error: Floats
    usual: Floats  # (3, D) least and greatest value, and most equal readings in a row

    @classmethod
    def fit(cls, senses: StreamScaler, streams: Sequence[NDArray[np.floating[Any]]]) -> Self | None:
        """Learn from training episodes (T, D); None for streams that are too wide."""
        spec = senses.spec
        restlessness = (senses.change / senses.spread)[senses.slow]
        slowest = senses.slow[np.argsort(restlessness, kind="stable")][:PAIRED]
        first, second = np.triu_indices(len(slowest))
        products = np.stack([slowest[first], slowest[second]], axis=1)
        Y = _entries(spec, len(products))
        if Y > MOST_ENTRIES:
            return None
        usual = usual_readings(streams)
        blank = cls(senses, products, np.eye(Y), np.zeros(Y), np.ones(spec.size), usual)
        rows = sum(map(len, streams))

        def mean(part: Callable[[Floats], Floats]) -> Floats:
            return np.asarray(sum(part(blank.lift(s)) for s in streams)) / rows

        centre = mean(lambda y: y.sum(axis=0))
        covariance = mean(lambda y: gram(y - centre))
        learned = replace(blank, covariance=covariance, centre=centre)
        error = np.ones(spec.size)
        error[spec.sensory] = np.sqrt(mean(lambda y: np.sum(learned.unexplained(y) ** 2, axis=0)))
        return replace(learned, error=error)

    @classmethod
    def found(cls, learned: Mapping[str, NDArray[Any]], senses: StreamScaler) -> Self | None:
        """Restore what ``named`` returned; None where it is absent. Raises ValueError where it does not fit."""
        if not all(name in learned for name in ARRAYS):
            return None
        arrays = [np.asarray(learned[name], np.float64) for name in ARRAYS]
        products, covariance, centre, error, usual = arrays
        spec = senses.spec
        Y = _entries(spec, len(products))
        shapes = (len(products), 2), (Y, Y), (Y,), (spec.size,), (3, spec.size)
        check_shapes(learned, dict(zip(ARRAYS, shapes, strict=True)))
        if np.any((products < 0) | (products >= spec.size)):
            raise ValueError("completion_products should be columns of the stream")
        return cls(senses, products.astype(np.intp), covariance, centre, error, usual)

    def named(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {
            "completion_products": self.products.astype(np.float32),
            "completion_covariance": self.covariance.astype(np.float32),
            "completion_centre": self.centre,
            "completion_error": self.error,
            "completion_usual": self.usual,
        }

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
        sensory = x[:, self.spec.sensory]
        before = np.concatenate([sensory[:1], sensory[:-1]])
        first, second = self.products.T
        return np.hstack([sensory, before, x[:, self.spec.commanded], x[:, first] * x[:, second]])

    def involved(self, missing: Mask) -> Mask:
        """Return the mask (Y,) of the entries of y in which columns of ``missing`` (D,) take part."""
        sensory = missing[self.spec.sensory]
        products = missing[self.products].any(axis=1)
        return np.concatenate([sensory, sensory, missing[self.spec.commanded], products])

    def filling(self, missing: Mask) -> Filling:
        """Return how to complete the senses of ``missing`` (D,) from all others."""
        places, W = self._weights(missing)
        columns = self.spec.sensory[places]
        C = self.covariance
        left = C[places, places] - np.einsum("my,ym->m", W, C[:, places])
        # The error of one missing sensor was measured; that of several follows from C.
        error = np.maximum(np.sqrt(np.maximum(left, 0.0)), self.error[columns])
        return Filling(columns, W, error * self.senses.spread[columns])

    def complete(self, filling: Filling, lifted: Floats) -> Floats:
        """Return the completed senses (T, M) [unit of each] in rows of y (T, Y)."""
        columns = filling.columns
        entries = np.searchsorted(self.spec.sensory, columns)
        standard = self.centre[entries] + (lifted - self.centre) @ filling.weights.T
        return self.senses.mean[columns] + self.senses.spread[columns] * standard

    @cached_property
    def precision(self) -> Floats:
        """P = (C + λ)⁻¹ (Y, Y)."""
        penalised = self.covariance + PENALTY * np.eye(len(self.covariance))
        return np.asarray(np.linalg.inv(penalised), np.float64)

    def _weights(self, missing: Mask) -> tuple[NDArray[np.intp], Floats]:
        """Return the places (M,) of the senses of ``missing`` (D,) in y, and the weights (M, Y) that complete them.

        With E, every entry in which they take part: C_MO (C_OO + λ)⁻¹ are the rows M of -(P_EE)⁻¹ P_EO. E is short.
        """
        E = np.flatnonzero(self.involved(missing))
        P = self.precision
        places = np.flatnonzero(missing[self.spec.sensory])  # sensory entries come first in y
        solution = np.linalg.solve(P[np.ix_(E, E)], P[E]).astype(np.float64)
        W = -solution[np.searchsorted(E, places)]
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


def usual_readings(streams: Sequence[NDArray[np.floating[Any]]]) -> Floats:
    """Return least, greatest, and most equal readings in a row (3, D), of episodes (T, D)."""
    least = np.min([stream.min(axis=0) for stream in streams], axis=0)
    most = np.max([stream.max(axis=0) for stream in streams], axis=0)
    longest = np.max([_longest_repeats(stream) for stream in streams], axis=0)
    return np.array([least, most, longest], np.float64)


def _longest_repeats(stream: NDArray[np.floating[Any]]) -> NDArray[np.intp]:
    """Return the most equal readings in a row (D,) of an episode (T, D)."""
    rows = np.arange(1, len(stream))[:, None]
    changed = np.where(stream[1:] != stream[:-1], rows, 0)
    newest_change = np.maximum.accumulate(changed, axis=0)
    return np.max(rows - newest_change, axis=0, initial=0) + 1


def sensors_of(spec: StreamSpec) -> tuple[tuple[str, NDArray[np.intp]], ...]:
    """Return name and columns of each sensor, whose numbers fail together.

    A joint's position and velocity, the wrist's forces and torques, a mean and its peak are one; others are alone.
    """
    sensors: dict[str, list[int]] = {}
    for channel in spec.channels:
        start = spec.slices[channel.name].start
        if start in spec.sensory:
            for i, label in enumerate(channel.labels):
                sensor = _sensor_of(channel, label[len(channel.name) :])
                sensors.setdefault(sensor, []).append(start + i)
    return tuple((name, np.array(columns, np.intp)) for name, columns in sensors.items())


def _sensor_of(channel: Channel, element: str) -> str:
    """Return the name of the sensor that measures an element, such as ``[2]``, of a channel."""
    prefix, name = _split(channel.name)
    if channel.group == "wrench":
        return f"{prefix}wrist"
    if name in ("joint_position", "joint_velocity"):
        return f"{prefix}encoder{element}"
    return prefix + name.removesuffix("_peak") + element


def _split(name: str) -> tuple[str, str]:
    """Split the arm's prefix, which a stream of two arms has, from the rest."""
    head, _, tail = name.partition("_")
    if head.startswith("robot") and head[5:].isdigit():
        return f"{head}_", tail
    return "", name


def _entries(spec: StreamSpec, products: int) -> int:
    """Return the length Y of y."""
    return 2 * len(spec.sensory) + len(spec.commanded) + products
