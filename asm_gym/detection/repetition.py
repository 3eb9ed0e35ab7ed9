"""Repetition: a stuck sense repeats its reading, which a working one seldom does.

    p_i = P(x_t,i = x_{t-1,i}), counted separately after a repetition and after a change
    n_t = max(0, n_{t-1} + log ρ/p) after a repetition, max(0, n_{t-1} + log (1 - ρ)/(1 - p)) after a change,
          and at most n_0 + 24, so that a sense that works again is believed within about ten rows
    n_0 = 15, or where nominal episodes had more, 3 more than their largest: one twentieth as likely
    r_t = exp(ξ_0 (n_t - n_0)) where n_t > 0, else 0                 pooled with the ratios of ``evidence``

n_t is the evidence for "it repeats itself with probability ρ" against "with p" (CUSUM). A sense is not watched if its
noise is too small to change its reading at rest (σ < δ/2, see ``readings``), or if it kept repeating itself in nominal
episodes. If no channel declares its noise, the senses that never repeated themselves are watched.

Source: Page 1954 (Biometrika 41, 100-115).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Floats
from asm_gym.detection.evidence import POWER, TAIL_INDEX, TINY, scale, total
from asm_gym.readings import noise_of, resolution

STUCK_PROBABILITY = 0.9  # ρ; below 1, as a loose cable lets a reading through now and then
REPETITION_OFFSET = 12.0
"""One in 160,000, which among a hundred senses happens once in some thousand rows."""
RARER = 3.0  # by which n_0 lies above it, or above the largest n of nominal episodes
MOST_BEYOND = 24.0  # largest n - n_0
UNMOVED = 0.5  # noise below this many steps of the resolution leaves a reading where it is
RESTS = 0.5  # a sense that repeats itself this often after a repetition is at rest now and then
# A repetition is assumed no rarer than one in this many times the number of nominal episodes.
RESTLESS = 5.0
MOST_READ = 20_000  # largest number of rows from which noise and resolution are estimated

Stream = NDArray[np.floating[Any]]


class RepetitionWeights(NamedTuple):
    """What was learned of X senses' repetitions."""

    columns: NDArray[np.intp]  # (X,) of the senses in a row
    steps: Floats  # (2, 2, X) see ``evidence_steps``
    most: Floats  # (X,) upper bound of n
    offset: Floats  # (X,) n_0
    # (X,) column that is below 0 where there is nothing to sense, so that nothing repeats; or -1
    carried: NDArray[np.intp]


NO_REPETITION = RepetitionWeights(
    columns=np.zeros(0, np.intp),
    steps=np.zeros((2, 2, 0)),
    most=np.zeros(0),
    offset=np.zeros(0),
    carried=np.zeros(0, np.intp),
)
"""What is known of no senses."""


class Repetition(NamedTuple):
    """State of B streams; never changed in place."""

    row: Floats  # (B, X) the last readings; NaN before the first
    again: NDArray[np.bool_]  # (B, X) whether they were repetitions
    unlikely: Floats  # (B, X) n

    @classmethod
    def start(
        cls,
        batch: int,
        senses: int,
    ) -> Repetition:
        """Return the state before the first row."""
        shape = (batch, senses)
        return cls(
            row=np.full(shape, np.nan),
            again=np.zeros(shape, np.bool_),
            unlikely=np.zeros(shape),
        )

    def followed_by(self, rows: Floats, weights: RepetitionWeights) -> Repetition:
        """Return the state after rows (B, D)."""
        after = Repetition.start(len(rows), len(weights.columns))
        step_repetition(weights, self, after, rows)
        return after


def count_repetitions(streams: Sequence[Stream], noisy: NDArray[np.bool_]) -> Floats:
    """Return (3, X): -log p after a change and after a repetition, 0 for senses not watched; and n_0 - 3.

    Args:
        streams: the senses (T, X) in nominal episodes.
        noisy: (X,) those with declared noise.
    """
    senses = len(noisy)
    rows = np.zeros((2, senses))  # after a change, and after a repetition
    repetitions = np.zeros((2, senses))
    for stream in streams:
        is_repeated = stream[1:] == stream[:-1]
        now = is_repeated[1:]
        before = is_repeated[:-1]
        rows += [(~before).sum(axis=0), before.sum(axis=0)]
        repetitions += [(now & ~before).sum(axis=0), (now & before).sum(axis=0)]

    after_change = (repetitions[0] + 0.5) / (rows[0] + 1.0)
    # Rest comes by the episode: where n of them never rested, the next may.
    after_change = np.maximum(after_change, 1.0 / (RESTLESS * len(streams)))
    # As rare after a repetition as after a change, unless seen to be otherwise.
    after_repetition = (repetitions[1] + after_change) / (rows[1] + 1.0)

    is_watched = repetitions.sum(axis=0) == 0
    if noisy.any():
        is_watched = noisy & ~stands_still(streams) & (after_repetition < RESTS)
    p = np.array([after_change, after_repetition])
    surprise = np.where(is_watched, -np.log(p), 0.0)
    return np.vstack([surprise, largest_offset(streams, surprise)])


def stands_still(streams: Sequence[Stream]) -> NDArray[np.bool_]:
    """Return the senses (X,) that repeat themselves at rest, judged by nominal episodes (T, X)."""
    ends = np.cumsum([len(stream) for stream in streams])
    enough = streams[: int(np.searchsorted(ends, MOST_READ)) + 1]
    senses = range(streams[0].shape[1])
    return np.array([_stands_still([stream[:, i] for stream in enough]) for i in senses])


def _stands_still(readings: Sequence[Stream]) -> bool:
    """Return whether one sense's noise, in episodes (T,), is too small to change its reading."""
    resolutions = [resolution(episode) for episode in readings]
    known = [step for step in resolutions if step]
    if not known or len(known) < len(readings) / 2:
        return False
    noise = np.median([noise_of(episode) for episode in readings])
    return bool(noise < UNMOVED * float(np.median(known)))


def largest_offset(streams: Sequence[Stream], surprise: Floats) -> Floats:
    """Return n_0 - 3 (X,): the largest n in nominal episodes (T, X), at least 12; ``surprise`` is -log p (2, X)."""
    senses = surprise.shape[1]
    offset = np.full(senses, REPETITION_OFFSET)
    weights = RepetitionWeights(
        columns=np.arange(senses),
        steps=evidence_steps(surprise),
        most=np.full(senses, np.inf),
        offset=offset,
        carried=np.full(senses, -1, np.intp),
    )
    longest_first = sorted(streams, key=len, reverse=True)
    state = Repetition.start(len(streams), senses)
    for t in range(len(longest_first[0])):
        rows = [stream[t] for stream in longest_first if t < len(stream)]
        running = Repetition._make(part[: len(rows)] for part in state)
        state = running.followed_by(np.array(rows, np.float64), weights)
        offset = np.maximum(offset, state.unlikely.max(axis=0))
    return offset


def evidence_steps(surprise: Floats) -> Floats:
    """Return what a row adds to n (2, 2, X), from -log p (2, X).

    The first axis is whether the reading before was a repetition, the second whether this one is.
    """
    p = np.exp(-surprise)
    with np.errstate(divide="ignore"):
        by_change = (1.0 - STUCK_PROBABILITY) / (1.0 - p)
        steps = np.log([by_change, STUCK_PROBABILITY / p])  # (now, before, X)
    of_watched = np.where(p < STUCK_PROBABILITY, steps, 0.0)
    return np.ascontiguousarray(of_watched.swapaxes(0, 1))


@compiled
def step_repetition(
    weights: RepetitionWeights, before: Repetition, after: Repetition, rows: Any
) -> None:
    """Write the state after rows (B, D)."""
    for n in range(len(rows)):
        for i in range(len(weights.columns)):
            column = weights.columns[i]
            reading = rows[n, column]
            again = reading == before.row[n, i]
            carried = weights.carried[i]
            if carried >= 0 and rows[n, carried] < 0.0:
                again = False
            repeated = before.again[n, i]
            step = weights.steps[int(repeated), int(again), i]
            unlikely = before.unlikely[n, i] + step
            after.row[n, i] = reading
            after.again[n, i] = again
            after.unlikely[n, i] = min(max(unlikely, 0.0), weights.most[i])


@compiled
def pool_repetitions(repetition: RepetitionWeights, unlikely: Any, share: Any) -> None:
    """Pool shares (D,) of a surprise s with the ratios r (X,) of senses that are stuck: (s^p + Σ_i r_i^p)^(1/p)."""
    surprise = total(share)
    greatest = max(surprise, TINY)
    ratios = np.zeros(len(unlikely))
    for i in range(len(ratios)):
        if unlikely[i] > 0:
            beyond = unlikely[i] - repetition.offset[i]
            ratios[i] = np.exp(TAIL_INDEX * beyond)
            greatest = max(greatest, ratios[i])

    of_surprise = (surprise / greatest) ** POWER
    powers = of_surprise
    for i in range(len(ratios)):
        ratios[i] = (ratios[i] / greatest) ** POWER
        powers += ratios[i]
    if not powers > of_surprise:
        return
    pooled = greatest * powers ** (1.0 / POWER)
    pooled /= max(powers, TINY)
    scale(share, pooled * of_surprise / max(surprise, TINY))
    for i in range(len(ratios)):
        column = repetition.columns[i]
        share[column] += pooled * ratios[i]
