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
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Floats
from asm_gym.detection.evidence import TAIL_INDEX
from asm_gym.readings import noise_of, resolution

STUCK = 0.9  # ρ; below 1, as a loose cable lets a reading through now and then
REPETITION_OFFSET = 12.0  # one in 160,000, which among a hundred senses happens once in some thousand rows
RARER = 3.0  # by which n_0 lies above it, or above the largest n of nominal episodes
MOST_BEYOND = 24.0  # largest n - n_0
UNMOVED = 0.5  # noise below this many steps of the resolution leaves a reading where it is
RESTS = 0.5  # a sense that repeats itself this often after a repetition is at rest now and then
RESTLESS = 5.0  # a repetition is assumed no rarer than one in this many times the number of nominal episodes
MOST_READ = 20_000  # largest number of rows from which noise and resolution are estimated


class Repetition(NamedTuple):
    """State of B streams; never changed in place."""

    row: Floats  # (B, X) the last readings; NaN before the first
    again: NDArray[np.bool_]  # (B, X) whether they were repetitions
    unlikely: Floats  # (B, X) n

    @classmethod
    def start(cls, *shape: int) -> Self:
        """Return the state before the first row, for a ``shape`` (B, X)."""
        return cls(np.full(shape, np.nan), np.zeros(shape, np.bool_), np.zeros(shape))

    def followed_by(self, rows: Floats, steps: Floats, most: Floats) -> Repetition:
        """Return the state after rows (B, X), by ``evidence_steps`` and an upper bound of n (X,)."""
        new = Repetition._make(map(np.empty_like, self))
        arguments: list[Any] = [*self, rows, np.arange(rows.shape[1]), steps, most, *new]
        repeated(*arguments)
        return new

    def ratios(self, offset: Floats) -> Floats:
        """Return r (B, X), with n_0 ``offset`` (X,)."""
        return np.where(self.unlikely > 0, np.exp(TAIL_INDEX * (self.unlikely - offset)), 0.0)


def stands_still(streams: Sequence[NDArray[np.floating[Any]]]) -> NDArray[np.bool_]:
    """Return the senses (X,) that repeat themselves at rest, judged by nominal episodes (T, X)."""
    read = np.cumsum([len(stream) for stream in streams])
    enough = streams[: int(np.searchsorted(read, MOST_READ)) + 1]
    X = streams[0].shape[1]
    found = np.zeros(X, np.bool_)
    for i in range(X):
        steps = [resolution(stream[:, i]) for stream in enough]
        step = float(np.median([s for s in steps if s])) if any(steps) else 0.0
        if step and sum(s > 0 for s in steps) >= len(steps) / 2:
            found[i] = np.median([noise_of(stream[:, i]) for stream in enough]) < UNMOVED * step
    return found


def count_repetitions(streams: Sequence[NDArray[np.floating[Any]]], noisy: NDArray[np.bool_]) -> Floats:
    """Return (3, X): -log p after a change and after a repetition, 0 for senses not watched; and n_0 - 3.

    ``streams`` are the senses (T, X) in nominal episodes, ``noisy`` (X,) those with declared noise.
    """
    chances, happened = np.zeros((2, len(noisy))), np.zeros((2, len(noisy)))
    for stream in streams:
        again = stream[1:] == stream[:-1]
        before, now = again[:-1], again[1:]
        chances += [(~before).sum(axis=0), before.sum(axis=0)]
        happened += [(now & ~before).sum(axis=0), (now & before).sum(axis=0)]
    first = (happened[0] + 0.5) / (chances[0] + 1.0)
    # Rest comes by the episode: where n of them never rested, the next may.
    first = np.maximum(first, 1.0 / (RESTLESS * len(streams)))
    # As rare after a repetition as after a change, unless seen to be otherwise.
    p = np.array([first, (happened[1] + first) / (chances[1] + 1.0)])
    watched = (noisy & ~stands_still(streams) & (p[1] < RESTS)) if noisy.any() else happened.sum(axis=0) == 0
    counted = np.where(watched, -np.log(p), 0.0)
    offset, steps = np.full(len(noisy), REPETITION_OFFSET), evidence_steps(counted)
    ordered = sorted(streams, key=len, reverse=True)
    state, unbounded = Repetition.start(len(ordered), len(noisy)), np.full(len(noisy), np.inf)
    for t in range(len(ordered[0])):
        rows = np.array([stream[t] for stream in ordered if t < len(stream)], np.float64)
        state = Repetition._make(part[: len(rows)] for part in state).followed_by(rows, steps, unbounded)
        offset = np.maximum(offset, state.unlikely.max(axis=0))
    return np.concatenate([counted, offset[None]])


def evidence_steps(surprise: Floats) -> Floats:
    """Return (2, 2, X) from -log p (2, X): what a change and a repetition add to n, after a change and a repetition."""
    p = np.exp(-surprise)
    with np.errstate(divide="ignore"):
        steps = np.log([(1.0 - STUCK) / (1.0 - p), STUCK / p])  # (now, before, X)
    found: Floats = np.where(p < STUCK, steps, 0.0).swapaxes(0, 1)
    return np.ascontiguousarray(found)


@compiled
def repeated(
    row: Any, again: Any, unlikely: Any, rows: Any, columns: Any, steps: Any, most: Any, new: Any, now: Any, sum_: Any
) -> None:
    """Write the fields of ``Repetition``, ``new``, ``now`` and ``sum_``, after the ``columns`` (X,) of rows (B, D).

    ``steps`` are ``evidence_steps``, ``most`` (X,) is the upper bound of n.
    """
    for n in range(len(rows)):
        for i in range(len(columns)):
            new[n, i] = rows[n, columns[i]]
            now[n, i] = new[n, i] == row[n, i]
            step = steps[1 if again[n, i] else 0, 1 if now[n, i] else 0, i]
            sum_[n, i] = min(max(unlikely[n, i] + step, 0.0), most[i])
