"""What arms are made of, as inputs of a linear model: friction by speed, and weight by the sines of angles.

    tanh(v/w s)       w ∈ {0.01, 0.1, 1}, of each speed v of spread s
    sin, cos          of angles q, of q_2 + q_3, …, and products of two of them

Motor current is torque plus what the sign of the speed says, and weight is a sum of products of sines of angles along
the chain: a linear model can say neither without. Source: Stribeck friction smoothed by tanh: Makkar et al. 2005.
"""

from __future__ import annotations

import re
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.coverage import POSITION, SPEED
from asm_gym.data.units import ratio
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]

_FORCE = re.compile(r"(.*[^a-z])?(efforts?|torques?|currents?|curr|tau|iq)([^a-z].*)?")
_TOLD = re.compile(r"(.*[^a-z])?(target|desired|computed)([^a-z].*)?")

WIDTHS = (0.01, 0.1, 1.0)
"""w, shares of a speed's spread."""

MOST_ANGLES = 12
"""More are no arm's: their products would be too many."""

CHAIN = 3
"""Angles from the second on that are added up: shoulder, elbow and wrist often turn about parallel axes."""


class Derived(NamedTuple):
    """What is made of speeds and angles.

    Attributes:
        speeds: (S,) senses that are speeds, or whose changes are.
        from_steps: they are those of positions.
        angles: (J,) senses that are angles, along the chain.
        radians: (J,) in one of their units.
        pairs: (2, P) of sines and cosines of single angles, that are multiplied.
        sources: (M, X) which senses each is made of.
    """

    speeds: NDArray[np.intp]
    from_steps: bool
    angles: NDArray[np.intp]
    radians: Floats
    pairs: NDArray[np.intp]
    sources: NDArray[np.bool_]

    @classmethod
    def of(cls, spec: StreamSpec, friction: bool, body: bool) -> Self:
        """What a stream has by the names of its channels."""
        place = {int(column): k for k, column in enumerate(spec.sensory)}
        moving, from_steps = speeds(spec) if friction else (np.zeros(0, np.intp), False)
        columns = _named(spec, POSITION) if body else np.zeros(0, np.intp)
        columns = columns if len(columns) <= MOST_ANGLES else columns[:0]
        units = {
            i: c.unit for c, s in zip(spec.channels, spec.slices.values(), strict=True) for i in range(s.start, s.stop)
        }
        radians = np.array([ratio(units[int(i)], "rad") or 1.0 for i in columns])
        S, J = len(moving), len(columns)
        pairs = np.array(np.triu_indices(2 * J), np.intp) if J else np.zeros((2, 0), np.intp)
        own = np.eye(J, dtype=np.bool_)
        ends = range(2, min(J, CHAIN + 1))
        sums = np.array([[1 <= k <= n for k in range(J)] for n in ends], np.bool_).reshape(len(ends), J)
        single = np.vstack([own, own])
        of_angles = np.vstack([single, sums, sums, single[pairs[0]] | single[pairs[1]]])
        sources = np.zeros((S * len(WIDTHS) + len(of_angles), len(spec.sensory)), np.bool_)
        at = [place[int(i)] for i in moving]
        for w in range(len(WIDTHS)):
            sources[w * S + np.arange(S), at] = True
        angles = np.array([place[int(i)] for i in columns], np.intp)
        sources[S * len(WIDTHS) :, angles] = of_angles
        return cls(np.array(at, np.intp), from_steps, angles, radians, pairs, sources)

    def __call__(self, values: Floats, steps: Floats, spread: Floats) -> Floats:
        """(N, M) of values (N, X) in their units, standardised changes (N, X), and the values' spread (X,)."""
        speed = steps[:, self.speeds] if self.from_steps else values[:, self.speeds] / spread[self.speeds]
        parts = [np.tanh(speed / width) for width in WIDTHS]
        if len(self.angles):
            q = values[:, self.angles] * self.radians
            single = np.hstack([np.sin(q), np.cos(q)])
            sums = np.cumsum(q[:, 1 : CHAIN + 1], axis=1)[:, 1:]
            products = single[:, self.pairs[0]] * single[:, self.pairs[1]]
            parts += [single, np.sin(sums), np.cos(sums), products]
        return np.hstack(parts)


def _named(spec: StreamSpec, pattern: re.Pattern[str]) -> NDArray[np.intp]:
    """Columns of senses whose channel is called so."""
    named = zip(spec.channels, spec.slices.values(), strict=True)
    found = [np.arange(s.start, s.stop) for c, s in named if pattern.fullmatch(c.name.lower())]
    every = np.concatenate([*found, np.zeros(0, np.intp)])
    own: NDArray[np.intp] = np.intersect1d(every, spec.sensory).astype(np.intp)
    return own


def speeds(spec: StreamSpec) -> tuple[NDArray[np.intp], bool]:
    """Columns of the stream that are speeds; or of positions, and that their changes are."""
    for pattern, from_steps in ((SPEED, False), (POSITION, True)):
        found = _named(spec, pattern)
        if len(found):
            return found, from_steps
    return np.zeros(0, np.intp), False


def forces(spec: StreamSpec) -> NDArray[np.intp]:
    """Columns of senses that are measured torques or currents by their names, and no targets of them."""
    return np.setdiff1d(_named(spec, _FORCE), _named(spec, _TOLD)).astype(np.intp)


def motion(spec: StreamSpec) -> NDArray[np.intp]:
    """Columns of senses that are positions or speeds by their names."""
    found: NDArray[np.intp] = np.union1d(_named(spec, POSITION), _named(spec, SPEED)).astype(np.intp)
    return found
