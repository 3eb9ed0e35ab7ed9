"""Cubic splines: smooth paths through points drawn at random, written like letters.

    p(t) = S(t; knots + wobble) - S(0; …)      S the natural cubic spline through knots that are evenly spaced in time

Beside strokes of lognormal speed they are the simpler movement: already fast when they begin, and of even speed.

Source: de Boor 1978, A Practical Guide to Splines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from asm_gym.episode import Episode
from asm_gym.scripts.reproduce.handwriting import DT, NAMES, NOISE, STEPS, check_letters, pen_spec

KNOTS = 5
REACH = 3.0
"""Knots lie in a cube of twice this size [cm]."""

WOBBLE = 0.1
"""Standard deviation of a knot from writing to writing [cm]."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A skill: where the pen goes through."""

    name: str
    knots: NDArray[np.float64]  # (KNOTS, P) [cm]


def repertoire(count: int, dims: int, rng: np.random.Generator) -> list[Spline]:
    """``count`` splines drawn at random. Raises as ``handwriting.repertoire`` does."""
    check_letters(count)
    return [Spline(name, rng.uniform(-REACH, REACH, (KNOTS, dims))) for name in NAMES[:count]]


def written(spline: Spline, rng: np.random.Generator) -> Episode:
    """The spline written once, from the origin on."""
    knots = spline.knots + WOBBLE * rng.standard_normal(spline.knots.shape)
    path = CubicSpline(np.linspace(0.0, STEPS * DT, KNOTS), knots, bc_type="natural")(np.arange(STEPS + 1) * DT)
    seen = path[1:] - path[0] + NOISE * rng.standard_normal((STEPS, knots.shape[1]))
    stream = np.hstack([seen, np.diff(path, axis=0) / DT])
    return Episode.from_stream(stream, pen_spec(knots.shape[1]), info={"skill": spline.name})


def copybook(splines: Sequence[Spline], each: int, rng: np.random.Generator) -> list[Episode]:
    """``each`` writings of every spline."""
    return [written(s, rng) for s in splines for _ in range(each)]
