"""Repetition: a sense with noise never says the same twice, to the last digit, unless it is stuck.

    p_i = P(x_t,i = x_{t-1,i}), counted apart for senses that repeated themselves the time before and that did not
    n_t = (1 - a) n_{t-1} - [x_t = x_{t-1}] log p                    how unlikely the last repetitions were
    r_t = exp(ξ_0 (n_t - n_0)) where n_t > 0, else 0                 beside the ratios of ``tails``, with their ξ_0

What predicts a change finds nothing odd in one that is just 0. Yet where the senses are noisy, the density of what
comes next has no mass on any one number, and a repetition is as surprising as it was rare. A sense that is read more
slowly than the stream, or rounded, repeats itself in nominal episodes too, and then counts for nothing. One whose noise
nobody declared is watched where it never repeated itself in any nominal episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.tails import TAIL_INDEX

FADING = 0.2
"""a."""

REPETITION_OFFSET = 12.0
"""n_0: one in 160,000, which among a hundred senses happens once in some thousand steps."""


class Repetition(NamedTuple):
    """What is carried from row to row, one entry a stream; a value, never changed in place."""

    row: NDArray[np.float64]  # (B, X) what the senses said last; not a number before the first
    again: NDArray[np.bool_]  # (B, X) whether that was a repetition
    unlikely: NDArray[np.float64]  # (B, X) n


def unrepeated(batch: int, size: int) -> Repetition:
    """Before the first row, of ``size`` senses."""
    shape = batch, size
    return Repetition(np.full(shape, np.nan), np.zeros(shape, np.bool_), np.zeros(shape))


def count_repetitions(streams: Sequence[NDArray[np.floating[Any]]], noisy: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(2, X) -log p of a repetition, after none and after one; 0 for senses that may well stand still.

    Args:
        streams: (T, X) the senses in nominal episodes.
        noisy: (X,) which are known to have noise. Of the others, one that ever repeats itself may well stand still.
    """
    chances, happened = np.zeros((2, len(noisy))), np.zeros((2, len(noisy)))
    for stream in streams:
        again = stream[1:] == stream[:-1]
        before, now = again[:-1], again[1:]
        chances += [(~before).sum(axis=0), before.sum(axis=0)]
        happened += [(now & ~before).sum(axis=0), (now & before).sum(axis=0)]
    first = (happened[0] + 0.5) / (chances[0] + 1.0)
    # As rare after a repetition as after none, until seen to be otherwise.
    p = np.array([first, (happened[1] + first) / (chances[1] + 1.0)])
    counted: NDArray[np.float64] = np.where(noisy | (happened.sum(axis=0) == 0), -np.log(p), 0.0)
    return counted


def improbability(repetition: Repetition) -> NDArray[np.float64]:
    """r (B, X)."""
    unlikely = repetition.unlikely
    ratio: NDArray[np.float64] = np.where(unlikely > 0, np.exp(TAIL_INDEX * (unlikely - REPETITION_OFFSET)), 0.0)
    return ratio


@compiled
def repeated(row: Any, again: Any, unlikely: Any, rows: Any, surprise: Any) -> Any:
    """The fields of a ``Repetition`` after the next rows (B, X), of ``surprise`` (2, X) as counted."""
    B, X = rows.shape
    now, faded = np.zeros((B, X), np.bool_), np.empty((B, X))
    for n in range(B):
        for i in range(X):
            now[n, i] = rows[n, i] == row[n, i]
            faded[n, i] = (1.0 - FADING) * unlikely[n, i]
            if now[n, i]:
                faded[n, i] += surprise[1 if again[n, i] else 0, i]
    return rows, now, faded
