"""Compare logs with each other before they are learned from: copies, and columns of another scale.

    scale of a log    s = std of the numbers of a channel, m = 95 % quantile of |x|
    another scale     both the medians of s and of m are FACTOR times larger in some logs than in others

Radians beside degrees differ 57 times, metres beside millimetres 1,000 times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.data.log_column import LogColumn
from asm_gym.data.reader_notes import listed
from asm_gym.data.schema import LOG_ORIGIN, LOG_SCHEMA, LogSchema

Floats = NDArray[np.float64]

FACTOR = 20.0  # logs of one robot differ less in the range and in the spread of a column
STANDS = 10.0  # noises that a channel must spread over to be compared: a still arm has no scale
KNOWN_FACTORS = {
    "degrees beside radians": 180 / np.pi,
    "units beside thousandths": 1000.0,
}


class _OtherScale(NamedTuple):
    """A channel of which some logs have another scale."""

    column: LogColumn
    factor: float
    logs: list[int]

    def __str__(self) -> str:
        """Return its name, how many times larger it is in some logs, and what that may be."""
        difference = f"{self.column.name} {self.factor:.2g} times"
        for guess, factor in KNOWN_FACTORS.items():
            ratio = self.factor / factor
            if 0.6 < ratio < 1.6:
                difference += f" ({guess}?)"
        return difference


def refuse_unlike(episodes: Sequence[Episode], names: Sequence[str]) -> None:
    """Raise ValueError if logs are copies of each other, or a column of some has another scale.

    Args:
        episodes: read from logs with one schema.
        names: of the logs.
    """
    _refuse_copies(episodes, names)
    if len(episodes) > 1 and LOG_SCHEMA in episodes[0].info:
        _refuse_other_scales(episodes, names)


def refuse_other_scales(episodes: Sequence[Episode]) -> None:
    """Raise ValueError if a column of some whole logs has another scale; pieces are not compared."""
    keys = (LOG_SCHEMA, LOG_ORIGIN)
    are_logs = all(key in episode.info for episode in episodes for key in keys)
    if len(episodes) > 1 and are_logs:
        _refuse_other_scales(episodes, [f"episode {n}" for n in range(len(episodes))])


def _refuse_copies(episodes: Sequence[Episode], names: Sequence[str]) -> None:
    """Raise ValueError if two logs hold the same rows."""
    first_with: dict[bytes, str] = {}
    for episode, name in zip(episodes, names, strict=True):
        original = first_with.setdefault(episode.stream.tobytes(), name)
        if original != name:
            raise ValueError(
                f"{name} is a copy of {original}: a threshold from rows that were learned from "
                "promises too much; leave one of them out"
            )


def _refuse_other_scales(episodes: Sequence[Episode], names: Sequence[str]) -> None:
    """Raise ValueError with the columns of another scale, the logs, and what to change."""
    schema = LogSchema.from_json(episodes[0].info[LOG_SCHEMA])
    unlike = _other_scales(episodes, schema)
    if not unlike:
        return
    column = unlike[0].column.name
    differences = ", ".join(str(other) for other in unlike)
    logs = listed([names[k] for k in unlike[0].logs])
    raise ValueError(
        f"columns without a unit differ in scale between logs: {differences}, in {logs}. "
        f"Say the units in their headers, such as '{column} [deg]', or leave these logs out; "
        f"if they are right, write varies = true in the line of {column} of a schema "
        "(asm-gym inspect --schema FILE)"
    )


def _other_scales(episodes: Sequence[Episode], schema: LogSchema) -> list[_OtherScale]:
    """Return the channels without a unit of which some logs have another scale."""
    unlike = []
    compared = {column.stream_channel for column in schema.stream_columns if column.varies}
    for column in schema.stream_columns:
        channel = column.stream_channel
        if channel in compared or column.unit or column.wrap:
            continue
        compared.add(channel)
        place = schema.spec.slices[channel]
        scales = [_scale(episode.stream[:, place], column.noise) for episode in episodes]
        factor, logs = _split_by_scale(np.array(scales))
        if logs:
            unlike.append(_OtherScale(column, factor, logs))
    return unlike


def _scale(numbers: NDArray[np.float32], noise: float) -> tuple[float, float]:
    """Return spread and range of the numbers (T, k) of a channel; NaN if it stands."""
    is_known = np.isfinite(numbers).all(axis=1)
    known = np.asarray(numbers[is_known], np.float64)
    if len(known) < 2:
        return np.nan, np.nan
    spread = float(known.std(axis=0).max())
    if spread <= STANDS * noise or spread == 0:
        return np.nan, np.nan
    return spread, float(np.quantile(np.abs(known), 0.95))


def _split_by_scale(scales: Floats) -> tuple[float, list[int]]:
    """Return by what factor some logs differ from the others, and which; none if they are alike.

    Args:
        scales: (N, 2) spread and range of a channel in each log; NaN if it stands.
    """
    moves = np.isfinite(scales).all(axis=1)
    moving = np.flatnonzero(moves)
    if len(moving) < 2:
        return 1.0, []
    order = moving[np.argsort(scales[moving, 0])]
    ordered = scales[order]  # (M, 2) by their spread
    steps = np.diff(np.log(ordered[:, 0]))
    split = int(np.argmax(steps)) + 1
    small = np.median(ordered[:split], axis=0)
    large = np.median(ordered[split:], axis=0)
    factors = large / small
    if factors.min() < FACTOR:
        return 1.0, []
    fewer = order[split:]
    if len(fewer) > split:
        fewer = order[:split]
    return float(factors[0]), sorted(fewer.tolist())
