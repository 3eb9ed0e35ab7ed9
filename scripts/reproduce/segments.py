"""Where skills begin in a stream that nobody has labelled, and which of them are the same.

By the memory: where its error leaves what is usual, it asks whether the next few rows are better explained by what it
carries on, or by beginning anew, and takes the better. By the rows alone: where they move further in a step than is
usual. Segments are then clustered by means over some of their rows; there are as many skills as make the clusters stand
apart best.

Sources: Zacks et al. 2007 (Psychological Bulletin 133(2)) for segments between errors of prediction; Rousseeuw 1987 for
the silhouette.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import AgglomerativeClustering
from sklearn.metrics import adjusted_rand_score, silhouette_score

from asm_gym.episode import Episode
from asm_gym.memory.energy import Array
from asm_gym.memory.recall import Recalled, follow
from asm_gym.scripts.reproduce.expression import Memory, Rows, read

SHORTEST = 10
"""Steps between two beginnings at least."""

CONVINCED = 0.5
"""Share of the error of going on that beginning anew must stay below."""

AHEAD = 5
"""Steps by which it is settled whether something has begun."""

NEAR = 3
"""Steps that a beginning may be off to count as found."""

SOURCES = {"state": "memory", "row": "rows alone"}


class Parted(NamedTuple):
    """What is found in a stream of T rows."""

    values: NDArray[np.floating[Any]]  # (T, C) what says which skill runs
    begins: NDArray[np.intp]  # where each segment begins


def parted(memory: Memory, train: Sequence[Episode], stream: Rows, usual: float) -> dict[str, Parted]:
    """What the memory finds, and what the rows alone do, by ``SOURCES``.

    Args:
        train: what the memory has learned from, which says what is usual.
        stream: (T, D) skills one after another.
        usual: quantile of errors, and of how far rows move, within skills, over which another may have begun.
    """
    states, begins = read_on(memory, stream, usual_error(memory, train, usual))
    rows, known = _standard(memory, stream), [_standard(memory, e.stream) for e in train]
    return {"state": Parted(np.tanh(states), begins), "row": Parted(rows, jumps(rows, known, usual))}


def usual_error(memory: Memory, episodes: Sequence[Episode], quantile: float) -> float:
    """What the error of a row stays below in these; their first rows, of which little is known yet, do not count."""
    found = []
    for e in episodes:
        reading = read(memory.reader, e.stream[:, None].astype(np.float64))
        found.append(errors(memory, memory.network.at_rest(1), *reading)[0][SHORTEST:, 0])
    return float(np.quantile(np.concatenate(found), quantile))


def errors(memory: Memory, c: Array, senses: Array, commands: Array) -> tuple[NDArray[np.float64], Recalled]:
    """(T, B) mean square of what was not expected of each row, read after the traces ``c``; and what was."""
    recalled = follow(memory.network, c, senses, commands)
    wrong = np.concatenate([senses - recalled.senses, commands[:, :, :-1] - recalled.commands], axis=2)
    return np.mean(wrong.astype(np.float64) ** 2, axis=2), recalled


def read_on(memory: Memory, stream: Rows, usual: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """The states (T, H) of a stream (T, D), and the steps where something was taken to begin."""
    senses, commands = read(memory.reader, stream[:, None])
    rest = memory.network.at_rest(1)
    c, begins, states = rest, [0], []
    for t in range(len(stream)):
        on, now = errors(memory, c, senses[t : t + 1], commands[t : t + 1])
        if on[0, 0] > usual and t - begins[-1] >= SHORTEST:
            on = errors(memory, c, senses[t : t + 1 + AHEAD], commands[t : t + 1 + AHEAD])[0]
            fresh = read(memory.reader, stream[t : t + 1 + AHEAD, None])  # nothing has moved yet
            anew = errors(memory, rest, *fresh)[0]
            if anew[1:].sum() < CONVINCED * on[1:].sum():
                begins.append(t)
                now = errors(memory, rest, fresh[0][:1], fresh[1][:1])[1]
        c = now.traces
        states.append(now.hidden[0, 0])
    return np.stack(states), np.array(begins)


def jumps(rows: Rows, train: Sequence[Rows], quantile: float) -> NDArray[np.intp]:
    """The steps where rows (T, D) move further than in those of ``train``, each number by what it usually moves."""
    steps = np.concatenate([np.diff(x, axis=0) for x in train])
    usual = np.maximum(steps.std(axis=0), 1e-9)
    most = np.quantile(np.mean((steps / usual) ** 2, axis=1), quantile)
    begins = [0]
    for t in np.flatnonzero(np.mean((np.diff(rows, axis=0) / usual) ** 2, axis=1) > most) + 1:
        if t - begins[-1] >= SHORTEST:
            begins.append(int(t))
    return np.array(begins)


def _standard(memory: Memory, stream: NDArray[np.floating[Any]]) -> Rows:
    """Rows as the memory scales them."""
    return np.asarray((stream - memory.reader.mean) / memory.reader.spread, np.float64)


def unnamed(found: Parted, most: int, *known_by: slice) -> tuple[NDArray[np.intp], int]:
    """(T,) the cluster of each step, and how many there are.

    Args:
        most: skills that are thought possible.
        known_by: the rows by whose means a segment is known; of one that ends before, its last row.
    """
    parts = np.split(found.values, found.begins[1:])
    lengths = [len(part) for part in parts]
    means = [[(part[rows] if len(part[rows]) else part[-1:]).mean(axis=0) for part in parts] for rows in known_by]
    segments = np.hstack([np.stack(each) for each in means])
    best = (-1.0, np.zeros(len(segments), np.intp))
    for count in range(2, min(most, len(segments) - 1) + 1):
        clusters = AgglomerativeClustering(count).fit_predict(segments)
        best = max(best, (float(silhouette_score(segments, clusters)), clusters), key=lambda b: b[0])
    return np.repeat(best[1], lengths), int(best[1].max()) + 1


def judged(found: Parted, named: NDArray[np.intp], skill: NDArray[np.str_], begins: NDArray[np.intp]) -> dict[str, Any]:
    """How well segments and their clusters agree with what ran.

    Args:
        named: (T,) the cluster of each step.
        skill: (T,) what ran.
        begins: where each skill began.
    """
    return {
        "index": float(adjusted_rand_score(skill, named)),
        "found": share_near(begins, found.begins),
        "true": share_near(found.begins, begins),
    }


def share_near(asked: NDArray[np.intp], known: NDArray[np.intp]) -> float:
    """The share of steps that are within ``NEAR`` of a known one."""
    return float(np.mean([np.abs(known - step).min() <= NEAR for step in asked]))
