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
STEPS = 60  # rows of a letter
DT = 1.0 / STEPS  # control period [s]: a letter takes 1 s at normal speed
NOISE = 0.02  # standard deviation of the pen's sensed position [cm]; letters are about 5 cm large
# mean of the logarithm of a stroke's time [ln s]; it is fastest about 0.16 s after its onset
MU = -1.75
# variation of a stroke between writings: share of its length, and radians of its direction
WOBBLE = 0.04
# bounds of a stroke's columns in ``Letter``; of the onset, bounds of its delay
LEAST_STROKE = (2.0, -math.pi, -2.5, -0.02, 0.25)
MOST_STROKE = (5.0, math.pi, 2.5, 0.02, 0.4)
STROKES = 4  # of a letter
FIRST_ONSET = -0.05  # mean onset of the first stroke [s]
ONSET_STEP = 0.19  # mean time from the onset of a stroke to that of the next [s]
FINE = 8  # samples of the velocity in a step, whose mean is commanded
POSITION = Channel("hand_position", 2, "cm", NOISE, "pen", ("x", "y"))
COMMAND = Channel("pen_command", 2, "cm/s", group=MOTOR, elements=("x", "y"))
PEN = StreamSpec((POSITION, COMMAND), DT, "pen")


class Letter(NamedTuple):
    """A skill: overlapping strokes.

    Attributes:
        name: one of ``NAMES``.
        strokes: (S, 5) length [cm], direction [rad], turn [rad], onset [s] and σ of each stroke.
    """

    name: str
    strokes: NDArray[np.float64]


check_letters = partial(check_number, "letters", low=1, high=len(NAMES), whole=True)


def repertoire(count: int, rng: np.random.Generator) -> list[Letter]:
    """Return ``count`` letters drawn at random; ValueError for more than there are names."""
    check_letters(count)
    strokes = rng.uniform(LEAST_STROKE, MOST_STROKE, (count, STROKES, 5))
    delays = strokes[:, :, 3]
    regular_onsets = ONSET_STEP * np.arange(STROKES)
    strokes[:, :, 3] = regular_onsets + delays + FIRST_ONSET
    names = NAMES[:count]
    return list(map(Letter, names, strokes))


def velocity(letter: Letter, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (T, 2) [cm/s] of the pen at times (T,) [s] since the letter began."""
    total = np.zeros((len(time), 2))
    for length, direction, turn, onset, sigma in letter.strokes:
        since = np.maximum(time - onset, 1e-9)
        deviation = (np.log(since) - MU) / sigma
        bell = length * np.exp(-0.5 * deviation**2)
        area = since * sigma * math.sqrt(2 * math.pi)
        speed = bell / area
        angle = direction + turn * 0.5 * (1 + erf(deviation / math.sqrt(2)))
        heading = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        total += speed[:, None] * heading
    return total


def written(
    letter: Letter, rng: np.random.Generator, speed: float = 1.0, wobble: float = WOBBLE
) -> Episode:
    """Write the letter once, ``speed`` times as fast as usual, with strokes that vary by ``wobble``."""
    strokes = letter.strokes.copy()
    changes = wobble * rng.standard_normal(strokes.shape)
    strokes[:, 0] *= 1 + changes[:, 0]
    strokes[:, 1:3] += changes[:, 1:3]
    strokes[:, 3] += 0.1 * changes[:, 4]

    # A command is the mean velocity of its step, so that the position is the integral.
    steps = round(STEPS / speed)
    samples = np.arange(FINE * steps)
    time = (samples + 0.5) * DT * speed / FINE
    velocities = velocity(Letter(letter.name, strokes), time)
    velocities_by_step = velocities.reshape(steps, FINE, 2)
    commands = speed * velocities_by_step.mean(axis=1)  # (T, 2)
    position = np.cumsum(commands, axis=0) * DT
    sensed = position + NOISE * rng.standard_normal((steps, 2))
    stream = np.hstack([sensed, commands])
    return Episode.from_stream(stream, PEN, info={"skill": letter.name})


def copybook(letters: Sequence[Letter], each: int, rng: np.random.Generator) -> list[Episode]:
    """Write every letter ``each`` times."""
    return [written(letter, rng) for letter in letters for _ in range(each)]
