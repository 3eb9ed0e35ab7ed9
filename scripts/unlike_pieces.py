"""Which pieces are unlike the others, and what to expect of a kind of move that was not learned from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import alarms_in
from asm_gym.episode import Episode

APART = 2.0
"""Pieces are unlike the others where the least of their maxima is so many times the greatest of all others."""

FEW = 0.25
"""More than this share of all pieces is no exception."""

LISTED = 3


class Part(NamedTuple):
    """An episode, or a piece of one, and where it came from."""

    log: str
    start: float  # [s]
    episode: Episode


def kind_of(log: str) -> str:
    """The folder that a log lies in, or the log where there is none."""
    folder = PurePath(log).parent
    return log if folder == PurePath(".") else folder.as_posix()


def unlike(maxima: NDArray[np.float64]) -> NDArray[np.intp]:
    """Places of the maxima (n,) that stand apart above all others, greatest first; none where there is no such gap."""
    order = np.argsort(maxima)[::-1]
    for k in range(int(FEW * len(maxima)), 0, -1):
        if maxima[order[k - 1]] >= APART * maxima[order[k]]:
            return order[:k]
    return order[:0]


def about_pieces(parts: Sequence[Part], maxima: NDArray[np.float64]) -> list[str]:
    """What is worth saying of those that set the threshold, a line each."""
    odd = unlike(maxima)
    if not len(odd):
        return []
    named = ", ".join(f"{parts[k].log} from {parts[k].start:.0f} s ({maxima[k]:.3g})" for k in odd[:LISTED])
    others = np.delete(maxima, odd).max()
    return [
        f"{len(odd)} of {len(maxima)} pieces are unlike the others, none of which is over {others:.3g}: {named}"
        f"{', …' if len(odd) > LISTED else ''}; look whether they are healthy; "
        "record more of their kind, or ask for a rate that may alarm there"
    ]


def left_out(
    fitting: Sequence[Part], calibration: Sequence[Part], learn: Callable[[list[Episode], list[Episode]], Any]
) -> Mapping[str, str]:
    """What alarms each kind raises in a memory that has learned from all others, in words by kind.

    Args:
        fitting: learned from.
        calibration: that set the threshold.
        learn: makes the memory of both.
    """
    kinds = dict.fromkeys(kind_of(part.log) for part in (*fitting, *calibration))
    said = {}
    for kind in kinds:
        others = [[p.episode for p in parts if kind_of(p.log) != kind] for parts in (fitting, calibration)]
        own = [p.episode for p in (*fitting, *calibration) if kind_of(p.log) == kind]
        try:
            monitor = learn(*others)
        except ValueError as error:
            said[kind] = f"cannot be left out: {error}"
            continue
        values = [monitor.score(episode).value for episode in own]
        dt, rows = own[0].spec.dt, sum(map(len, own))
        alarms = sum(alarms_in(value, monitor.threshold, dt) for value in values)
        over = sum(int((value > monitor.threshold).sum()) for value in values)
        worst = max(float(value.max()) for value in values) / monitor.threshold
        said[kind] = (
            f"{alarms} alarms in {rows * dt / 60:.3g} min, {100 * over / rows:.1f} % of the time in alarm, "
            f"{worst:.2g} thresholds at most"
        )
    return said
