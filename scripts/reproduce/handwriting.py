"""Handwriting: letters of overlapping strokes, each with a lognormal speed.

    v(t) = Σ_i D_i Λ(t - t_i; μ, σ_i) (cos φ_i(t), sin φ_i(t))
    φ_i(t) = θ_i + Δθ_i ½ (1 + erf((ln(t - t_i) - μ) / (√2 σ_i)))

Λ is the density of the lognormal distribution. A letter is drawn at random, and written a little differently each time.

Source: the sigma-lognormal model, O'Reilly and Plamondon 2009 (Pattern Recognition 42(12)).
"""

from __future__ import annotations

import math
import string
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from asm_gym.data.episode import Episode
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_number

NAMES = string.ascii_lowercase + string.ascii_uppercase[:6]
"""Names of the letters, which look like none of the alphabet."""
STEPS = 60
DT = 1.0 / STEPS  # control period [s]: a letter takes 1 s at normal speed
NOISE = 0.02  # standard deviation of the pen's sensed position [cm]; letters are about 5 cm large
# mean of the logarithm of a stroke's time [ln s]; it is fastest about 0.16 s after its onset
MU = -1.75
WOBBLE = 0.04  # variation of a stroke between writings, as a share of its length and in radians of its direction
STROKES = (2.0, -math.pi, -2.5, -0.02, 0.25), (5.0, math.pi, 2.5, 0.02, 0.4)
"""Bounds of what is drawn of a stroke, as ``Letter`` holds it; its onset goes on by 0.19 s."""
FINE = 8  # samples of the velocity in a step, whose mean is commanded
PEN = StreamSpec(
    (
        Channel("hand_position", 2, "cm", NOISE, "pen", ("x", "y")),
        Channel("pen_command", 2, "cm/s", group=MOTOR, elements=("x", "y")),
    ),
    DT,
    "pen",
)


class Letter(NamedTuple):
    """A skill: overlapping strokes."""

    name: str
    # (S, 5) of each its length [cm], direction and turn [rad], onset [s], and σ
    strokes: NDArray[np.float64]


check_letters = partial(check_number, "letters", low=1, high=len(NAMES), whole=True)


def repertoire(count: int, rng: np.random.Generator) -> list[Letter]:
    """Return ``count`` letters drawn at random, four strokes each; ValueError for more than there are names."""
    check_letters(count)
    strokes = rng.uniform(*STROKES, (count, 4, 5))
    strokes[:, :, 3] = 0.19 * np.arange(4) + strokes[:, :, 3] - 0.05
    return [Letter(name, own) for name, own in zip(NAMES[:count], strokes, strict=True)]


def velocity(letter: Letter, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (T, 2) [cm/s] of the pen at times (T,) [s] since the letter began."""
    total = np.zeros((len(time), 2))
    for length, direction, turn, onset, sigma in letter.strokes:
        since = np.maximum(time - onset, 1e-9)
        place = (np.log(since) - MU) / sigma
        speed = length * np.exp(-0.5 * place**2) / (since * sigma * math.sqrt(2 * math.pi))
        angle = direction + turn * 0.5 * (1 + erf(place / math.sqrt(2)))
        total += speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return total


def written(
    letter: Letter, rng: np.random.Generator, speed: float = 1.0, wobble: float = WOBBLE
) -> Episode:
    """Write the letter once, ``speed`` times as fast as usual."""
    strokes = letter.strokes.copy()
    length, direction, turn, _, onset = wobble * rng.standard_normal(strokes.shape).T
    strokes[:, 0] *= 1 + length
    strokes[:, 1:4] += np.stack([direction, turn, 0.1 * onset], axis=1)
    steps = round(STEPS / speed)
    # the position is the integral, not a sum of samples
    time = (np.arange(FINE * steps) + 0.5) * DT * speed / FINE
    v = speed * velocity(Letter(letter.name, strokes), time).reshape(steps, FINE, 2).mean(axis=1)
    position = np.cumsum(v, axis=0) * DT + NOISE * rng.standard_normal((steps, 2))
    return Episode.from_stream(np.hstack([position, v]), PEN, info={"skill": letter.name})


def copybook(letters: Sequence[Letter], each: int, rng: np.random.Generator) -> list[Episode]:
    """Write every letter ``each`` times."""
    return [written(letter, rng) for letter in letters for _ in range(each)]
