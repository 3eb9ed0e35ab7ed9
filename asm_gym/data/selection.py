"""Select the recordings that a memory of normal operation learns from, and those that set its threshold."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.logs import Log
from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode, spans
from asm_gym.readings import noise_of
from asm_gym.spec import MOTOR

SHORTEST_S = 0.5
"""Least length of a part between lost rows that is worth learning from [s]."""

AROUND_S = 5.0
"""How near to marked rows nothing is learned from [s]: what led to a stop is no normal motion."""


class NormalEpisodes(NamedTuple):
    """The episodes that are learned from, how many others were left out, by why, and the logs of the first."""

    episodes: list[Episode]
    left_out: Counter[str]
    logs: list[str]


def normal_episodes(logs: Iterable[Log], progress: Callable[[int, int], object] | None = None) -> NormalEpisodes:
    """Return the normal episodes among ``logs``."""
    kept = NormalEpisodes([], Counter(), [])
    for n, (name, episode) in enumerate(logs, 1):
        if progress is not None:
            progress(n, n)  # how many there are is known at the end
        if why := _abnormal(episode):
            kept.left_out[why] += 1
        else:
            kept.episodes.append(episode)
            kept.logs.append(name)
    return kept


def _abnormal(episode: Episode) -> str:
    """Why an episode is not normal, in a word or two; empty where it is."""
    role = episode.label.role if episode.label is not None else ""
    if episode.faults.any() or role == "faulty":
        return "with a fault"
    if role == "harmless":
        return "under a harmless variation"
    return "" if episode.success else "failed"


def without_marked_rows(logs: Iterable[Log]) -> Iterator[Log]:
    """Yield logs, and of those from elsewhere the parts that are not near rows that a label marks."""
    for log in logs:
        episode = log.episode
        if episode.spec.source != "table" or not episode.faults.any():
            yield log
            continue
        near = round(AROUND_S / episode.spec.dt)
        close = np.convolve(episode.faults, np.ones(2 * near + 1), "same") > 0.5
        for start, stop in _long_spans(~close, episode.spec.dt):
            part = replace(episode, stream=episode.stream[start:stop], faults=episode.faults[start:stop])
            yield Log(log.name, part)


def complete_parts(episode: Episode) -> list[Episode]:
    """Return the parts of an episode between lost numbers; those under half a second are left out."""
    known = np.isfinite(episode.stream).all(axis=1)
    if known.all():
        return [episode]
    parts = [slice(start, stop) for start, stop in _long_spans(known, episode.spec.dt)]
    return [Episode.from_stream(episode.stream[part], episode.spec, success=True) for part in parts]


def _long_spans(mask: NDArray[np.bool_], dt: float) -> list[tuple[int, int]]:
    least = max(2, round(SHORTEST_S / dt))
    return [(start, stop) for start, stop in spans(mask) if stop - start >= least]


def with_shared_noise(episodes: list[Episode]) -> list[Episode]:
    """Return episodes of logs whose spec holds the median noise of all of them, and not that of the first."""
    spec = episodes[0].spec
    if spec.source != "table" or len(episodes) == 1:
        return episodes
    noise = np.array([[noise_of(column) for column in e.stream.T] for e in episodes])  # (N, D)
    channels = [
        channel if channel.group == MOTOR else replace(channel, noise=float(np.median(noise[:, place])))
        for channel, place in zip(spec.channels, spec.slices.values(), strict=True)
    ]
    whole = replace(spec, channels=tuple(channels))
    return [replace(episode, spec=whole) for episode in episodes]


def pieces(episode: Episode, seconds: float) -> list[Episode]:
    """Cut an episode into pieces of one length; a rest that is shorter is left out."""
    rows = max(1, round(seconds / episode.spec.dt))
    ends = range(rows, len(episode) + 1, rows)
    return [Episode.from_stream(episode.stream[n - rows : n], episode.spec, success=True) for n in ends]


def split_in_time(logs: list[list[Episode]], calibration_share: float) -> tuple[list[Episode], list[Episode]]:
    """Split the pieces of long logs into heads to learn from and tails to calibrate on, a piece between left out.

    Pieces of one log that follow each other are alike: shuffled, those that set the threshold would lie between those
    that were learned from, and promise too much.

    Raises:
        ValueError: no log is long enough.
    """
    fitting, calibration = list[Episode](), list[Episode]()
    for parts in logs:
        head = math.ceil(len(parts) * (1 - calibration_share))
        fitting += parts[:head]
        calibration += parts[head + 1 :] if len(logs) > 1 or len(parts) > 2 else parts[head:]
    if not fitting or not calibration:
        raise ValueError(f"{len(fitting) + len(calibration)} pieces are too few to learn from and to calibrate on")
    return fitting, calibration


def split_at_random(
    episodes: list[Episode], false_alarm_rate: float, calibration_share: float, seed: int
) -> tuple[list[Episode], list[Episode]]:
    """Split episodes into those to learn from and those to calibrate on.

    Args:
        episodes: all of them.
        false_alarm_rate: that the threshold is to promise.
        calibration_share: of the episodes, in (0, 1), that are not learned from.
        seed: of which are which.

    Raises:
        ValueError: too few of them; the message says how many are needed.
    """
    n, needed = len(episodes), conformal_episodes(false_alarm_rate)
    order = np.random.default_rng(seed).permutation(n)
    calibration = math.floor(n * calibration_share + 1e-9)
    if calibration < needed or calibration == n:
        least = max(2, math.ceil(needed / calibration_share - 1e-9))
        raise ValueError(
            f"a false-alarm rate of {false_alarm_rate:g} needs {least} normal episodes, {needed} of them to "
            f"calibrate on, got {n}: record more, take a higher --false-alarm-rate, or --split long logs"
        )
    return [episodes[i] for i in order[calibration:]], [episodes[i] for i in order[:calibration]]
