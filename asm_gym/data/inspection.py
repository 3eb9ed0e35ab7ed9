"""What a log is: its clock and its channels, and what would be done about each before anything is learned from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import FAR, clock_among, distinct, period
from asm_gym.data.names import is_clock, is_command, is_counter, is_label
from asm_gym.data.units import bare_name, unit_of
from asm_gym.readings import noise_of, resolution

FEW_VALUES = 8
"""A channel of fewer different values hardly moves."""

JITTERS = 0.1
"""Share of a period that steps spread by from which on a clock jitters."""


@dataclass(frozen=True)
class ClockFound:
    """When rows were sensed.

    Attributes:
        column: that says so; empty where none does.
        rate: rows a second in the mean, gaps left out [Hz]; 0 where nobody knows.
        jitter: standard deviation of a step that is no gap, as a share of the period.
        gaps: (G, 2) from when to when nothing came [s].
        rows: how many.
        seconds: from the first to the last row.
        trouble: what forbids reading it, in a line; empty where nothing does.
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
        noise: standard deviation of what is white in it.
        resolution: its steps; 0 where it has none.
        repeats: share of rows that say the same as the one before.
        missing: rows without a number.
        values: how many different ones.
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
        """What is done about it."""
        if self.role != "sense":
            return {
                "clock": "tells the rate; no channel",
                "label": "rows it marks are not learned from; no channel",
                "counter": "counts rows; no channel",
                "command": "commanded, by its name: fit takes it so",
            }[self.role]
        said = []
        if self.missing == self.rows:
            return "holds no number: leave it out"
        if self.constant:
            said.append("never moves: any change is news")
        elif self.values < FEW_VALUES:
            said.append(f"hardly moves: {self.values} values; its spread has a floor")
        if self.missing:
            said.append("missing numbers: bridged, or cut there")
        if self.resolution and self.repeats > 0.02 and not self.constant:
            said.append("repeats itself at rest: healthy")
        if "deg" in self.unit or "°" in self.unit:
            said.append("a memory of radians reads it too")
        return "; ".join(said) or "read as it is"


@dataclass(frozen=True)
class Inspection:
    """A log.

    Attributes:
        name: where it was found.
        clock: when its rows were sensed.
        channels: what it holds.
        words: columns of words, which are left out.
        times: (T,) [s], or row numbers where nobody knows.
        columns: the numbers, by name.
    """

    name: str
    clock: ClockFound
    channels: Sequence[ChannelFound]
    words: Sequence[str]
    times: NDArray[np.float64]
    columns: Mapping[str, NDArray[Any]] = field(repr=False)

    def remarks(self) -> list[str]:
        """What is worth saying of the whole, a line each."""
        clock, said = self.clock, []
        if clock.trouble:
            said.append(f"cannot be read: {clock.trouble}")
        elif not clock.column and not clock.rate:
            said.append("no clock: say --rate, rows a second")
        elif clock.jitter > JITTERS:
            apart = f"{1e3 / clock.rate:.3g} ms apart"
            said.append(f"the clock jitters by {100 * clock.jitter:.0f} % of a step: rows are put {apart}")
        if len(clock.gaps):
            longest = float(np.diff(clock.gaps, axis=1).max())
            said.append(
                f"{len(clock.gaps)} gaps in the clock, the longest {in_time(longest)}: "
                "those up to --bridge are filled, the log is cut at others"
            )
        roles = [c.role for c in self.channels]
        if "command" not in roles:
            said.append(
                "no command by name: the memory learns without what was asked of the arm, unless fit --action says"
            )
        still = [c.name for c in self.channels if c.constant and c.role == "sense"]
        if still:
            said.append(f"{len(still)} channels never move: {', '.join(still[:6])}{', …' if len(still) > 6 else ''}")
        if self.words:
            said.append(f"columns of words are left out: {', '.join(self.words[:6])}")
        return said


def in_time(seconds: float) -> str:
    """As people say it."""
    for unit, least in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * least:
            return f"{seconds / least:.3g} {unit}"
    return f"{seconds:.3g} s"


def inspected(name: str, columns: Mapping[str, NDArray[Any]], rate: float | None = None) -> Inspection:
    """What a table holds.

    Args:
        columns: (T,) or (T, k) each, as read from a file.
        rate: rows a second [Hz], where its clock does not say.
    """
    flat: dict[str, NDArray[Any]] = {}
    for column, values in columns.items():
        if values.ndim == 2:
            flat |= {f"{column}[{k}]": values[:, k] for k in range(values.shape[1])}
        else:
            flat[column] = values
    rows = max(map(len, flat.values()), default=0)
    clock, times = _clock(flat, rows, rate)
    words = [n for n, v in flat.items() if v.dtype.kind not in "biuf" and not is_clock(n) and not is_label(n)]
    numbers = {n: v for n, v in flat.items() if v.dtype.kind in "biuf"}
    found = [_channel(n, v) for n, v in numbers.items()]
    found += [_channel(n, np.zeros(0)) for n, v in flat.items() if n not in numbers and n not in words]
    return Inspection(name, clock, found, words, times, numbers)


def _clock(
    columns: Mapping[str, NDArray[Any]], rows: int, rate: float | None
) -> tuple[ClockFound, NDArray[np.float64]]:
    nothing, count = np.zeros((0, 2)), np.arange(rows, dtype=np.float64)
    clock = clock_among(columns)
    if clock is None:
        known = rate or 0.0
        return ClockFound("", known, 0.0, nothing, rows, rows / known if known else 0.0), count / (known or 1.0)
    try:
        times = clock.seconds(columns[clock.column])
        kept = times[distinct(times)]
        dt = period(kept)
    except ValueError as error:
        return ClockFound(clock.column, 0.0, 0.0, nothing, rows, 0.0, str(error)), count
    if dt is None:
        return ClockFound(clock.column, 0.0, 0.0, nothing, rows, 0.0, "one row"), count
    steps = np.diff(kept)
    wide = steps > FAR * max(dt, float(np.quantile(steps, 0.9)))
    gaps = np.stack([kept[:-1][wide], kept[1:][wide]], axis=1)
    jitter = float(steps[~wide].std() / dt)
    return ClockFound(clock.column, 1 / dt, jitter, gaps, rows, float(kept[-1] - kept[0])), times


def _channel(column: str, values: NDArray[Any]) -> ChannelFound:
    name, known = bare_name(column), values[np.isfinite(values)]
    role = _role(column, values)
    return ChannelFound(
        name,
        unit_of(column),
        role,
        float(known.min()) if len(known) else float("nan"),
        float(known.max()) if len(known) else float("nan"),
        noise_of(values),
        resolution(values),
        float(np.mean(values[1:] == values[:-1])) if len(values) > 1 else 0.0,
        int(len(values) - len(known)),
        len(np.unique(known)),
        len(values),
    )


def _role(column: str, values: NDArray[Any]) -> str:
    name = bare_name(column)
    if is_clock(column):
        return "clock"
    if is_label(name):
        return "label"
    if is_counter(name, values):
        return "counter"
    return "command" if is_command(name) else "sense"
