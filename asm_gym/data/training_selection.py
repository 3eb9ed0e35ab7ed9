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

SHORTEST_PART_S = 0.5  # least length of a part between lost rows that is worth learning from [s]
# How near to marked rows nothing is learned from [s]: what led to a stop is not normal.
FAULT_MARGIN_S = 5.0
SHARE_ROUNDING = 1e-9  # share of an episode that is rounding error


def normal_episodes(
    logs: Iterable[Log],
    between_marks: bool = False,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> tuple[list[Episode], Counter[str]]:
    """Return the normal episodes among logs, and how many others were left out, by why.

    Args:
        logs: in their order.
        between_marks: a table with marked rows is not left out, but learned from where no marked
            row is near.
        progress: is called with the number of logs so far.

    Raises:
        ValueError: logs are copies of each other, or of different scale.
    """
    kept: list[Log] = []
    left_out = Counter[str]()
    for n, log in enumerate(logs, 1):
        progress(n, n)  # how many there are is known at the end
        episode = log.episode
        is_marked = bool(episode.faults.any())
        is_faulty = episode.label is not None and episode.label.role == "faulty"
        if between_marks and is_marked and episode.spec.source == "table":
            for number, part in enumerate(_unmarked_parts(episode)):
                kept.append(Log(f"{log.name} part {number}", part))
        elif is_marked or is_faulty:
            left_out["with a fault"] += 1
        elif not episode.success:
            left_out["failed"] += 1
        else:
            kept.append(log)
    episodes = [log.episode for log in kept]
    refuse_unlike(episodes, [log.name for log in kept])
    return episodes, left_out


def _unmarked_parts(episode: Episode) -> list[Episode]:
    """Return the parts of an episode with no marked row near."""
    margin = round(FAULT_MARGIN_S / episode.spec.dt)  # [rows]
    window = np.ones(2 * margin + 1)
    marked_near = np.convolve(episode.faults, window, "same")
    return _parts(episode, marked_near <= 0.5)


def complete_parts(episode: Episode) -> list[Episode]:
    """Return the parts of an episode between lost numbers, but for those under half a second."""
    is_complete = np.asarray(np.isfinite(episode.stream).all(axis=1))
    if is_complete.all():
        return [episode]
    return _parts(episode, is_complete)


def _parts(episode: Episode, wanted: NDArray[np.bool_]) -> list[Episode]:
    """Return the stretches of rows that are wanted (T,), but for short ones."""
    least = max(2, round(SHORTEST_PART_S / episode.spec.dt))
    stretches = [_stretch(episode, start, stop) for start, stop in spans(wanted)]
    return [stretch for stretch in stretches if len(stretch) >= least]


def _stretch(episode: Episode, start: int, stop: int) -> Episode:
    """Return some rows of an episode as one of their own, with the schema of their log."""
    info = {key: value for key, value in episode.info.items() if key == LOG_SCHEMA}
    rows = episode.stream[start:stop]
    return Episode.from_stream(rows, episode.spec, success=True, info=info)


def pieces(episode: Episode, seconds: float) -> list[Episode]:
    """Cut an episode into pieces of one length; a rest that is shorter is left out."""
    rows = max(1, round(seconds / episode.spec.dt))
    ends = range(rows, len(episode) + 1, rows)
    return [_stretch(episode, end - rows, end) for end in ends]


def without_repeats(logs: list[list[Episode]]) -> tuple[list[list[Episode]], int]:
    """Return the parts of logs without those whose rows are those of another, and how many these are.

    A quantised arm at rest says the same in many of them, which are no evidence of their own.
    """
    known: set[bytes] = set()
    kept = []
    for parts in logs:
        own = []
        for part in parts:
            rows = part.stream.tobytes()
            if rows not in known:
                known.add(rows)
                own.append(part)
        kept.append(own)
    repeats = sum(map(len, logs)) - sum(map(len, kept))
    return [own for own in kept if own], repeats


def split_in_time(
    logs: list[list[Episode]], calibration_share: float
) -> tuple[list[Episode], list[Episode]]:
    """Split the pieces of long logs into heads to learn from, and tails to calibrate on.

    A piece between them is left out, but for that of a single log of two. Shuffled, pieces that
    follow each other would promise too much.

    Raises:
        ValueError: no log is long enough.
    """
    fitting: list[Episode] = []
    calibration: list[Episode] = []
    for parts in logs:
        head_end = math.ceil(len(parts) * (1 - calibration_share))
        tail_start = head_end + 1
        if len(logs) == 1 and len(parts) <= 2:
            tail_start = head_end
        fitting += parts[:head_end]
        calibration += parts[tail_start:]
    if not fitting or not calibration:
        count = len(fitting) + len(calibration)
        raise ValueError(f"{count} pieces are too few to learn from and to calibrate on")
    return fitting, calibration


def split_at_random(
    episodes: list[Episode], needed: int, calibration_share: float, seed: int
) -> tuple[list[Episode], list[Episode]]:
    """Split episodes by a seed into those to learn from, and a share (0, 1) to calibrate on.

    Raises:
        ValueError: fewer than ``needed`` would be left to calibrate on.
    """
    size = len(episodes)
    calibration_size = math.floor(size * calibration_share + SHARE_ROUNDING)
    if calibration_size < needed or calibration_size == size:
        whole_share = needed / calibration_share
        least = max(2, math.ceil(whole_share - SHARE_ROUNDING))
        raise ValueError(
            f"this false-alarm rate needs {least} normal episodes, {needed} of them to "
            f"calibrate on, got {size}: record more, take a higher --false-alarm-rate, or "
            "--split long logs"
        )
    order = np.random.default_rng(seed).permutation(size)
    shuffled = [episodes[k] for k in order]
    return shuffled[calibration_size:], shuffled[:calibration_size]
