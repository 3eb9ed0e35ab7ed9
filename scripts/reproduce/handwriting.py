"""Handwriting: letters of overlapping strokes, each with a lognormal speed.

    v(t) = Σ_i D_i Λ(t - t_i; μ, σ_i) (cos φ_i(t) cos ψ_i, sin φ_i(t) cos ψ_i, sin ψ_i)
    φ_i(t) = θ_i + Δθ_i ½ (1 + erf((ln(t - t_i) - μ) / (√2 σ_i)))

Λ is the density of the lognormal distribution; in two dimensions ψ = 0. A letter is drawn at random, and written a
little differently each time.

Source: the sigma-lognormal model, O'Reilly and Plamondon 2009 (Pattern Recognition 42(12)).
"""

from __future__ import annotations

import math
import string
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from asm_gym.episode import Episode
from asm_gym.spec import MOTOR, Channel, StreamSpec

NAMES = string.ascii_lowercase + string.ascii_uppercase[:6]
"""Names of the letters, which look like none of the alphabet."""

STEPS = 60
DT = 1.0 / STEPS
"""Control period [s]: a letter takes 1 s at normal speed."""

NOISE = 0.02
"""Standard deviation of the pen's sensed position [cm]; letters are about 5 cm large."""

MU = -1.75
"""Mean of the logarithm of a stroke's time [ln s]; it is fastest about 0.16 s after its onset."""

WOBBLE = 0.04
"""Variation of a stroke between writings, as a share of its length and in radians of its direction."""


@dataclass(frozen=True)
class Stroke:
    """A stroke: length [cm], direction and turn [rad], rise out of the plane [rad], onset [s], and σ."""

    length: float
    direction: float
    turn: float
    rise: float
    onset: float
    sigma: float


@dataclass(frozen=True)
class Letter:
    """A skill: overlapping strokes."""

    name: str
    strokes: tuple[Stroke, ...]


def pen_spec(dims: int) -> StreamSpec:
    """Return the stream of a pen in ``dims`` dimensions: its position and commanded velocity."""
    if dims not in (2, 3):
        raise ValueError(f"a pen moves in 2 or 3 dimensions, got {dims}")
    axes = tuple("xyz"[:dims])
    position = Channel("hand_position", dims, "cm", NOISE, "pen", axes)
    return StreamSpec((position, Channel("pen_command", dims, "cm/s", group=MOTOR, elements=axes)), DT, "pen")


def repertoire(count: int, dims: int, rng: np.random.Generator) -> list[Letter]:
    """Return ``count`` letters drawn at random, four strokes each.

    Raises:
        ValueError: there are none, or more than there are names.
    """
    check_letters(count)
    return [Letter(name, tuple(_stroke(n, dims, rng) for n in range(4))) for name in NAMES[:count]]


def check_letters(*counts: int, least: int = 1) -> None:
    """Raise ValueError for fewer letters than ``least``, or more than there are names."""
    for count in counts:
        if not least <= count <= len(NAMES):
            raise ValueError(f"a repertoire has {least} to {len(NAMES)} skills, got {count}")


def wide_enough(hidden: int, channels: int) -> None:
    """Raise ValueError where a network has fewer hidden units than numbers to predict."""
    if hidden < channels:
        raise ValueError(f"hidden must be at least the number of channels, {channels}, got {hidden}")


def velocity(letter: Letter, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (T, 3) [cm/s] of the pen at times (T,) [s] since the letter began."""
    total = np.zeros((len(time), 3))
    for s in letter.strokes:
        since = np.maximum(time - s.onset, 1e-9)
        place = (np.log(since) - MU) / s.sigma
        speed = s.length * np.exp(-0.5 * place**2) / (since * s.sigma * math.sqrt(2 * math.pi))
        angle = s.direction + s.turn * 0.5 * (1 + erf(place / math.sqrt(2)))
        flat = math.cos(s.rise)
        total += speed[:, None] * np.stack([flat * np.cos(angle), flat * np.sin(angle), np.sin(s.rise) + 0 * angle], 1)
    return total


def written(letter: Letter, dims: int, rng: np.random.Generator, speed: float = 1.0, wobble: float = WOBBLE) -> Episode:
    """Write the letter once, ``speed`` times as fast as usual."""
    strokes = tuple(_wobbly(s, wobble, dims, rng) for s in letter.strokes)
    steps = round(STEPS / speed)
    fine = 8  # the position is the integral of the velocity, not of its samples
    time = (np.arange(fine * steps) + 0.5) * DT * speed / fine
    v = speed * velocity(replace(letter, strokes=strokes), time)[:, :dims].reshape(steps, fine, dims).mean(axis=1)
    position = np.cumsum(v, axis=0) * DT + NOISE * rng.standard_normal((steps, dims))
    return Episode.from_stream(np.hstack([position, v]), pen_spec(dims), info={"skill": letter.name})


def copybook(
    letters: Sequence[Letter], each: int, dims: int, rng: np.random.Generator, speeds: Sequence[float] = (1.0,)
) -> list[Episode]:
    """Write every letter ``each`` times at every speed."""
    return [written(letter, dims, rng, speed) for letter in letters for speed in speeds for _ in range(each)]


def _stroke(number: int, dims: int, rng: np.random.Generator) -> Stroke:
    return Stroke(
        length=float(rng.uniform(2.0, 5.0)),
        direction=float(rng.uniform(-math.pi, math.pi)),
        turn=float(rng.uniform(-2.5, 2.5)),
        rise=float(rng.uniform(-1.0, 1.0)) if dims == 3 else 0.0,
        onset=0.19 * number + float(rng.uniform(-0.02, 0.02)) - 0.05,
        sigma=float(rng.uniform(0.25, 0.4)),
    )


def _wobbly(s: Stroke, wobble: float, dims: int, rng: np.random.Generator) -> Stroke:
    length, direction, turn, rise, onset = wobble * rng.standard_normal(5)
    return replace(
        s,
        length=s.length * (1 + length),
        direction=s.direction + direction,
        turn=s.turn + turn,
        rise=s.rise + rise if dims == 3 else 0.0,
        onset=s.onset + 0.1 * onset,
    )
