"""Describe a log before anything is learned from it: its clock, its channels, and what is done with each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import FAR, clock_among, distinct, period
from asm_gym.data.names import role_of
from asm_gym.data.units import bare_name, unit_of
from asm_gym.readings import noise_of, resolution

FEW_VALUES = 8
"""A channel of fewer different values hardly moves."""

JITTERS = 0.1
"""Share of a period that steps spread by from which on a clock jitters."""

LISTED = 6
"""Names in a remark."""

TREATMENT = {
    "clock": "tells the rate; no channel",
    "label": "rows it marks are not learned from; no channel",
    "counter": "counts rows; no channel",
    "command": "commanded, by its name: fit takes it so",
}
"""What is done with columns that are no senses."""


@dataclass(frozen=True)
class ClockFound:
    """The clock of a log.

    Attributes:
        column: its name; empty where there is none.
        rate: rows a second in the mean, gaps left out [Hz]; 0 where it is unknown.
        jitter: standard deviation of a step that is no gap, as a share of the period.
        gaps: (G, 2) from when to when nothing came [s].
        rows: how many.
        seconds: from the first to the last row.
        trouble: why it cannot be read, in a line; empty where it can.
    """

    column: str
    rate: float
    jitter: float
    gaps: NDArray[np.float64]
    rows: int
    seconds: float
    trouble: str = ""


@dataclass(frozen=True)
class ChannelFound:
    """A column of numbers.

    Attributes:
        name: without its unit.
        unit: as the log says; empty where it does not.
        role: sense, command, clock, label or counter.
        low, high: its range.
        noise: standard deviation of its white noise.
        resolution: its steps; 0 where it has none.
        repeats: share of rows that are equal to the one before.
        missing: rows without a number.
        values: how many different ones.
        rows: how many.
    """

    name: str
    unit: str
    role: str
    low: float
    high: float
    noise: float
    resolution: float
    repeats: float
    missing: int
    values: int
    rows: int

    @property
    def constant(self) -> bool:
        return self.values <= 1

    def treatment(self) -> str:
        """Say what is done with it."""
        if self.role != "sense":
            return TREATMENT[self.role]
        if self.missing == self.rows:
            return "holds no number: leave it out"
        said = {
            "never moves: any change is news": self.constant,
            f"hardly moves: {self.values} values; its spread has a floor": 1 < self.values < FEW_VALUES,
            "missing numbers: bridged, or cut there": self.missing > 0,
            "repeats itself at rest: healthy": bool(self.resolution) and self.repeats > 0.02 and not self.constant,
            "a memory of radians reads it too": "deg" in self.unit or "°" in self.unit,
        }
        return "; ".join(words for words, holds in said.items() if holds) or "read as it is"


@dataclass(frozen=True)
class Inspection:
    """A log.

    Attributes:
        name: where it was found.
        clock: when its rows were sensed.
        channels: of its columns of numbers.
        words: columns of words, which are left out.
        times: (T,) [s], or row numbers without a clock.
        columns: the numbers, by name.
    """

    name: str
    clock: ClockFound
    channels: Sequence[ChannelFound]
    words: Sequence[str]
    times: NDArray[np.float64]
    columns: Mapping[str, NDArray[Any]] = field(repr=False)

    def remarks(self) -> list[str]:
        """List what a user should know of the whole, a line each."""
        clock, said = self.clock, list[str]()
        if clock.trouble:
            said.append(f"cannot be read: {clock.trouble}")
        elif not clock.column and not clock.rate:
            said.append("no clock: say --rate, rows a second")
        elif clock.jitter > JITTERS:
            apart = f"{1e3 / clock.rate:.3g} ms apart"
            said.append(f"the clock jitters by {100 * clock.jitter:.0f} % of a step: rows are put {apart}")
        if len(clock.gaps):
            longest = in_time(float(np.diff(clock.gaps, axis=1).max()))
            said.append(
                f"{len(clock.gaps)} gaps in the clock, the longest {longest}: "
                "those up to --bridge are filled, the log is cut at others"
            )
        if all(c.role != "command" for c in self.channels):
            said.append("no command by name: the memory learns without the arm's commands, unless fit --action says")
        still = [c.name for c in self.channels if c.constant and c.role == "sense"]
        if still:
            more = ", …" if len(still) > LISTED else ""
            said.append(f"{len(still)} channels never move: {', '.join(still[:LISTED])}{more}")
        if self.words:
            said.append(f"columns of words are left out: {', '.join(self.words[:LISTED])}")
        return said


def in_time(seconds: float) -> str:
    """Return a duration in the unit that people would use."""
    for unit, least in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * least:
            return f"{seconds / least:.3g} {unit}"
    return f"{seconds:.3g} s"


def inspected(name: str, columns: Mapping[str, NDArray[Any]], rate: float | None = None) -> Inspection:
    """Describe a table.

    Args:
        name: where it was found.
        columns: (T,) or (T, k) each, as read from a file.
        rate: rows a second [Hz], where its clock does not say.
    """
    flat = {
        f"{column}[{k}]" if values.ndim == 2 else column: part
        for column, values in columns.items()
        for k, part in enumerate(values.T if values.ndim == 2 else [values])
    }
    clock, times = _clock(flat, rate or 0.0)
    roles = {n: role_of(n, v) for n, v in flat.items()}
    words = [n for n, role in roles.items() if role == "words"]
    numbers = {n: v for n, v in flat.items() if v.dtype.kind in "biuf"}
    in_words = [n for n in flat if n not in numbers and n not in words]  # clocks and labels
    channels = [_channel(n, roles[n], v) for n, v in numbers.items()]
    channels += [_channel(n, roles[n], np.zeros(0)) for n in in_words]
    return Inspection(name, clock, channels, words, times, numbers)


def _clock(columns: Mapping[str, NDArray[Any]], rate: float) -> tuple[ClockFound, NDArray[np.float64]]:
    rows = max(map(len, columns.values()), default=0)
    nothing, count = np.zeros((0, 2)), np.arange(rows, dtype=np.float64)
    clock = clock_among(columns)
    if clock is None:
        return ClockFound("", rate, 0.0, nothing, rows, rows / rate if rate else 0.0), count / (rate or 1.0)
    try:
        times = clock.seconds(columns[clock.column])
        kept = times[distinct(times)]
        dt = period(kept)
        if dt is None:
            raise ValueError("one row")
    except ValueError as error:
        return ClockFound(clock.column, 0.0, 0.0, nothing, rows, 0.0, str(error)), count
    steps = np.diff(kept)
    wide = steps > FAR * max(dt, float(np.quantile(steps, 0.9)))
    gaps = np.stack([kept[:-1][wide], kept[1:][wide]], axis=1)
    jitter = float(steps[~wide].std() / dt)
    return ClockFound(clock.column, 1 / dt, jitter, gaps, rows, float(kept[-1] - kept[0])), times


def _channel(column: str, role: str, values: NDArray[Any]) -> ChannelFound:
    known = values[np.isfinite(values)]
    return ChannelFound(
        bare_name(column),
        unit=unit_of(column),
        role=role,
        low=float(known.min()) if len(known) else float("nan"),
        high=float(known.max()) if len(known) else float("nan"),
        noise=noise_of(values),
        resolution=resolution(values),
        repeats=float(np.mean(values[1:] == values[:-1])) if len(values) > 1 else 0.0,
        missing=len(values) - len(known),
        values=len(np.unique(known)),
        rows=len(values),
    )
