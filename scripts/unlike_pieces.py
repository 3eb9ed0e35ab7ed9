"""Name the pieces of logs that are unlike the others, and say what to expect of a kind of move that was not learned."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import alarms_in
from asm_gym.episode import Episode

LEAST_RATIO = 2.0
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
    """Return the folder that a log lies in, or the log where there is none."""
    folder = PurePath(log).parent
    return log if folder == PurePath(".") else folder.as_posix()


def unlike(maxima: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the places of the maxima (n,) that are far above all others, greatest first."""
    order = np.argsort(maxima)[::-1]
    for k in range(int(FEW * len(maxima)), 0, -1):
        if maxima[order[k - 1]] >= LEAST_RATIO * maxima[order[k]]:
            return order[:k]
    return order[:0]


def about_pieces(parts: Sequence[Part], maxima: NDArray[np.float64]) -> list[str]:
    """Return a line about the pieces that set the threshold and are unlike the others; none where there are none."""
    odd = unlike(maxima)
    if not len(odd):
        return []
    named = ", ".join(f"{parts[k].log} from {parts[k].start:.0f} s ({maxima[k]:.3g})" for k in odd[:LISTED])
    return [
        f"{len(odd)} of {len(maxima)} pieces are unlike the others, none of which is over "
        f"{np.delete(maxima, odd).max():.3g}: {named}{', …' if len(odd) > LISTED else ''}; look whether they are "
        "healthy; record more of their kind, or ask for a rate that may alarm there"
    ]


def left_out(
    fitting: Sequence[Part], calibration: Sequence[Part], learn: Callable[[list[Episode], list[Episode]], Any]
) -> Mapping[str, str]:
    """Return, by kind, the alarms that it raises in a memory that has learned from all others, in words.

    Args:
        fitting: learned from.
        calibration: that set the threshold.
        learn: makes the memory of both.
    """
    said = {}
    for kind in dict.fromkeys(kind_of(part.log) for part in (*fitting, *calibration)):
        others = [[p.episode for p in parts if kind_of(p.log) != kind] for parts in (fitting, calibration)]
        own = [p.episode for p in (*fitting, *calibration) if kind_of(p.log) == kind]
        try:
            monitor = learn(*others)
        except ValueError as error:
            said[kind] = f"cannot be left out: {error}"
            continue
        dt, ratios = own[0].spec.dt, [monitor.score(episode).value / monitor.threshold for episode in own]
        every = np.concatenate(ratios)
        said[kind] = (
            f"{sum(alarms_in(ratio, 1.0, dt) for ratio in ratios)} alarms in {len(every) * dt / 60:.3g} min, "
            f"{100 * np.mean(every > 1.0):.1f} % of the time in alarm, {every.max():.2g} thresholds at most"
        )
    return said
