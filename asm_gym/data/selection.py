"""Select the recordings that a memory of normal operation learns from, and those that set its threshold."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.data.log_comparison import refuse_unlike
from asm_gym.data.logs import Log
from asm_gym.data.schema import LOG_SCHEMA
from asm_gym.readings import spans

SHORTEST_S = 0.5  # least length of a part between lost rows that is worth learning from [s]
AROUND_S = 5.0  # how near to marked rows nothing is learned from [s]: what led to a stop is no normal motion


def normal_episodes(
    logs: Iterable[Log],
    between_marks: bool = False,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> tuple[list[Episode], Counter[str]]:
    """Return the normal episodes among logs, and how many others were left out, by why.

    ``progress`` is called with the number of logs so far. A table with marked rows is left out, or with
    ``between_marks`` learned from where none of them is near.

    Raises:
        ValueError: logs are copies of each other, or of different scale.
    """
    kept: list[Episode] = []
    names: list[str] = []
    left_out = Counter[str]()
    for n, (name, episode) in enumerate(logs, 1):
        progress(n, n)  # how many there are is known at the end
        role = ""
        if episode.label is not None:
            role = episode.label.role
        if between_marks and episode.spec.source == "table" and episode.faults.any():
            near = round(AROUND_S / episode.spec.dt)
            close = np.convolve(episode.faults, np.ones(2 * near + 1), "same") > 0.5
            parts = _parts(episode, ~close)
            kept += parts
            names += [f"{name} part {part}" for part in range(len(parts))]
        elif episode.faults.any() or role == "faulty":
            left_out["with a fault"] += 1
        elif not episode.success:
            left_out["failed"] += 1
        else:
            kept.append(episode)
            names.append(name)
    refuse_unlike(kept, names)
    return kept, left_out


def complete_parts(episode: Episode) -> list[Episode]:
    """Return the parts of an episode between lost numbers; those under half a second are left out."""
    known = np.asarray(np.isfinite(episode.stream).all(axis=1))
    return [episode] if known.all() else _parts(episode, known)


def _parts(episode: Episode, wanted: NDArray[np.bool_]) -> list[Episode]:
    """The stretches of rows that are wanted (T,), but for short ones."""
    least = max(2, round(SHORTEST_S / episode.spec.dt))
    return [
        _stretch(episode, start, stop) for start, stop in spans(wanted) if stop - start >= least
    ]


def _stretch(episode: Episode, start: int, stop: int) -> Episode:
    """Return some rows of a log as an episode of their own."""
    info = {key: value for key, value in episode.info.items() if key == LOG_SCHEMA}
    return Episode.from_stream(episode.stream[start:stop], episode.spec, success=True, info=info)


def pieces(episode: Episode, seconds: float) -> list[Episode]:
    """Cut an episode into pieces of one length; a rest that is shorter is left out."""
    rows = max(1, round(seconds / episode.spec.dt))
    ends = range(rows, len(episode) + 1, rows)
    return [_stretch(episode, end - rows, end) for end in ends]


def split_in_time(
    logs: list[list[Episode]], calibration_share: float
) -> tuple[list[Episode], list[Episode]]:
    """Split the pieces of long logs into heads to learn from and tails to calibrate on, a piece between left out.

    Shuffled, pieces that follow each other would promise too much. Raises ValueError where no log is long enough.
    """
    fitting, calibration = list[Episode](), list[Episode]()
    for parts in logs:
        head = math.ceil(len(parts) * (1 - calibration_share))
        fitting += parts[:head]
        calibration += parts[head + 1 :] if len(logs) > 1 or len(parts) > 2 else parts[head:]
    if not fitting or not calibration:
        raise ValueError(
            f"{len(fitting) + len(calibration)} pieces are too few to learn from and to calibrate on"
        )
    return fitting, calibration


def split_at_random(
    episodes: list[Episode], needed: int, calibration_share: float, seed: int
) -> tuple[list[Episode], list[Episode]]:
    """Split episodes by a seed into those to learn from, and a share (0, 1) to calibrate on.

    Raises ValueError where fewer than ``needed`` would be left to calibrate on.
    """
    n = len(episodes)
    order = np.random.default_rng(seed).permutation(n)
    calibration = math.floor(n * calibration_share + 1e-9)
    if calibration < needed or calibration == n:
        least = max(2, math.ceil(needed / calibration_share - 1e-9))
        raise ValueError(
            f"this false-alarm rate needs {least} normal episodes, {needed} of them to "
            f"calibrate on, got {n}: record more, take a higher --false-alarm-rate, or --split long logs"
        )
    return [episodes[i] for i in order[calibration:]], [episodes[i] for i in order[:calibration]]
