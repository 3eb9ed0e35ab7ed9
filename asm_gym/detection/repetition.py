"""Repetition: a sense that is stuck says the same again and again, as a working one seldom does.

    p_i = P(x_t,i = x_{t-1,i}), counted apart for senses that repeated themselves the time before and that did not
    n_t = max(0, n_{t-1} + log ρ/p) after a repetition, max(0, n_{t-1} + log (1 - ρ)/(1 - p)) after a change,
          and at most n_0 + 24, so that a sense that works again is believed again within some ten rows
    r_t = exp(ξ_0 (n_t - n_0)) where n_t > 0, else 0                 beside the ratios of ``tails``, with their ξ_0

What predicts a change finds nothing odd in one that is just 0. Yet noise carries a working sensor from one of its
readings to another, by steps of its resolution, and how seldom it stays is counted in nominal episodes. n_t is the
evidence for "it repeats itself with probability ρ" against "with p", begun anew wherever that is best (Page 1954,
Biometrika 41, 100-115). A sense that repeats itself as often as not, being read more slowly than the stream or coarsely
rounded, then counts for little or nothing, and none for more than it came to in nominal episodes. Where nobody
declared the noise of any sense, those are watched that never repeated themselves in any of them.

An arm that stands still repeats its digits, and is healthy: a sense whose noise does not carry it from one of its
readings to the next (σ < δ/2, see ``readings``), or that went on repeating itself in nominal episodes, is not watched
here. If such a sense is stuck, the others say so: what they do asks for a change that does not come.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.readings import noise_of, resolution

STUCK = 0.9
"""ρ: below 1, for a cable that is loose lets a reading through now and then."""

REPETITION_OFFSET = 12.0
"""n_0: one in 160,000, which among a hundred senses happens once in some thousand steps."""

UNMOVED = 0.5
"""Noise of fewer steps than this leaves a reading where it is."""

RESTS = 0.5
"""A sense that repeats itself again as often as that, once it has begun to, stands still now and then."""

RESTLESS = 5.0
"""A repetition is no rarer than one in so many times the number of nominal episodes: of ninety, two are enough."""

MOST_READ = 20_000
"""Rows from which noise and resolution are told."""

MOST_BEYOND = 24.0
"""How far n may pass n_0: what is stuck for an hour is no more stuck than what is stuck for a second."""


class Repetition(NamedTuple):
    """What is carried from row to row, one entry a stream; a value, never changed in place."""

    row: NDArray[np.float64]  # (B, X) what the senses said last; not a number before the first
    again: NDArray[np.bool_]  # (B, X) whether that was a repetition
    unlikely: NDArray[np.float64]  # (B, X) n


def unrepeated(batch: int, size: int) -> Repetition:
    """Before the first row, of ``size`` senses."""
    shape = batch, size
    return Repetition(np.full(shape, np.nan), np.zeros(shape, np.bool_), np.zeros(shape))


def stands_still(streams: Sequence[NDArray[np.floating[Any]]]) -> NDArray[np.bool_]:
    """(X,) which senses repeat themselves where the robot is at rest, by their readings in nominal episodes (T, X)."""
    enough: list[NDArray[np.floating[Any]]] = []
    for stream in streams:
        enough.append(stream)
        if sum(map(len, enough)) >= MOST_READ:
            break
    X = streams[0].shape[1]
    found = np.zeros(X, np.bool_)
    for i in range(X):
        steps = [resolution(stream[:, i]) for stream in enough]
        step = float(np.median([s for s in steps if s])) if any(steps) else 0.0
        if step and sum(s > 0 for s in steps) >= len(steps) / 2:
            found[i] = np.median([noise_of(stream[:, i]) for stream in enough]) < UNMOVED * step
    return found


def count_repetitions(streams: Sequence[NDArray[np.floating[Any]]], noisy: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(3, X) -log p of a repetition, after none and after one, 0 for senses that may well stand still; and n_0.

    Args:
        streams: (T, X) the senses in nominal episodes.
        noisy: (X,) which are known to have noise; the others may well stand still, as a command at its limit does.
            Where none is known to have any, nobody said which: then those that never repeat themselves are watched.
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
    # As rare after a repetition as after none, until seen to be otherwise.
    p = np.array([first, (happened[1] + first) / (chances[1] + 1.0)])
    watched = (noisy & ~stands_still(streams) & (p[1] < RESTS)) if noisy.any() else happened.sum(axis=0) == 0
    counted = np.where(watched, -np.log(p), 0.0)
    offset, steps = np.full(len(noisy), REPETITION_OFFSET), evidence_steps(counted)
    ordered = sorted(streams, key=len, reverse=True)
    state, unbounded = unrepeated(len(ordered), len(noisy)), np.full(len(noisy), np.inf)
    for t in range(len(ordered[0])):
        rows = np.array([stream[t] for stream in ordered if t < len(stream)], np.float64)
        row, again, unlikely = (part[: len(rows)] for part in state)
        state = Repetition(*repeated(row, again, unlikely, rows, steps, unbounded))
        offset = np.maximum(offset, state.unlikely.max(axis=0))
    return np.concatenate([counted, offset[None]])


def evidence_steps(surprise: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2, X) what a change and a repetition add to n, after none and after one.

    Args:
        surprise: (2, X) -log p. Nothing is learned from a sense that repeats itself more often than a stuck one.
    """
    p = np.exp(-surprise)
    with np.errstate(divide="ignore"):
        steps = np.log([(1.0 - STUCK) / (1.0 - p), STUCK / p])  # (now, before, X)
    found: NDArray[np.float64] = np.where(p < STUCK, steps, 0.0).swapaxes(0, 1)
    return np.ascontiguousarray(found)


def improbability(repetition: Repetition, offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """r (B, X), with n_0 (X,)."""
    unlikely = repetition.unlikely
    ratio: NDArray[np.float64] = np.where(unlikely > 0, np.exp(TAIL_INDEX * (unlikely - offset)), 0.0)
    return ratio


@compiled
def repeated(row: Any, again: Any, unlikely: Any, rows: Any, steps: Any, most: Any) -> Any:
    """The fields of a ``Repetition`` after the next rows (B, X), with ``evidence_steps`` and the most n (X,) may be."""
    B, X = rows.shape
    now, evidence = np.zeros((B, X), np.bool_), np.zeros((B, X))
    for n in range(B):
        for i in range(X):
            now[n, i] = rows[n, i] == row[n, i]
            step = steps[1 if again[n, i] else 0, 1 if now[n, i] else 0, i]
            evidence[n, i] = min(max(unlikely[n, i] + step, 0.0), most[i])
    return rows, now, evidence
