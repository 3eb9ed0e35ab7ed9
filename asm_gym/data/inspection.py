"""Describe a log before anything is learned from it: its clock, its columns, and what is done with each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.bridging import BRIDGED_ROWS
from asm_gym.data.column_names import split_unit
from asm_gym.data.log_column import COMMAND, IGNORED, SENSE, LogColumn
from asm_gym.data.schema import LogSchema
from asm_gym.data.table_layout import Columns, is_numeric
from asm_gym.data.timing import FAR, Timing, evenly, timing_of
from asm_gym.readings import noise_of, resolution, spans

FEW_VALUES = 8  # a channel of fewer different values hardly moves
JITTERS = 0.1  # share of a period that steps spread by from which on a clock jitters


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """A log, and how it is read.

    Args:
        name: of the log.
        table: its columns by their headers.
        columns: what is done with each, by its header.
        times: (T,) when rows were sensed [s]; their numbers without a rate.
        rate: rows a second in the mean, gaps left out [Hz]; 0 if nothing tells.
        clock: names of the columns that are its clock.
        jitter: standard deviation of a step that is no gap, as a share of the period.
        gaps: (N, 2) from when to when nothing came [s].
        trouble: why it cannot be read.
    """

    name: str
    table: Columns
    columns: dict[str, LogColumn]
    times: NDArray[np.float64]
    rate: float = 0.0
    clock: str = ""
    jitter: float = 0.0
    gaps: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    trouble: str = ""

    def caption(self) -> str:
        """Say in a line how long it is, and at which rate it comes."""
        size = len(self.times)
        if not self.rate:
            return f"{self.name}: {size} rows, 0 s, no rate, {len(self.gaps)} gaps"
        clock = ""
        if self.clock:
            clock = f" by {self.clock!r}"
        return (
            f"{self.name}: {size} rows, {np.ptp(self.times):.5g} s, {self.rate:.6g} Hz{clock}, "
            f"jitter {100 * self.jitter:.1f} %, {len(self.gaps)} gaps"
        )

    def remarks(self) -> list[str]:
        """List what a user should know of the whole, a line each."""
        if self.trouble:
            return [f"cannot be read: {self.trouble}"]
        remarks = []
        if self.jitter > JITTERS:
            remarks.append(f"the clock jitters by {self.jitter:.0%} of a step")
        if len(self.gaps):
            longest = np.diff(self.gaps, axis=1).max()
            remarks.append(
                f"{len(self.gaps)} gaps in the clock, the longest {longest:.3g} s: up to "
                f"{BRIDGED_ROWS} lost rows, or --bridge, are filled, the log is cut at others"
            )
        if all(column.role != COMMAND for column in self.columns.values()):
            remarks.append(
                "no command by name: the memory learns without the arm's commands, unless "
                "fit --action or the schema says which they are"
            )
        return remarks

    def facts(self) -> list[dict[str, Any]]:
        """Return what the values of each column are like, by heading."""
        return [_facts(column, self.table[header]) for header, column in self.columns.items()]


def inspect_log(name: str, table: Columns, schema: LogSchema, trouble: str = "") -> Inspection:
    """Describe a log as it is read.

    Args:
        name: of the log.
        table: its columns, as ``asm_gym.data.table_layout.laid_out`` returns them.
        schema: how it is read.
        trouble: why it cannot be read; empty if that is not known yet.
    """
    columns = {header: _column_of(header, schema) for header in table}
    size = len(next(iter(table.values())))
    rows = np.arange(size, dtype=np.float64)
    unread = Inspection(name=name, table=table, columns=columns, times=rows)
    try:
        if trouble:
            raise ValueError(trouble)
        schema.read(table)
        clock = schema.clock_in(table)
    except ValueError as error:
        return replace(unread, trouble=str(error))
    if clock is None:
        return replace(unread, times=rows / schema.rate, rate=schema.rate)

    timing = timing_of(table, clock)
    dt = timing.dt or 1.0 / schema.rate
    return replace(
        unread,
        times=clock.times(table).seconds,
        rate=1 / dt,
        clock=clock.name,
        jitter=_jitter(timing, dt),
        gaps=_gaps(timing, dt),
    )


def _column_of(header: str, schema: LogSchema) -> LogColumn:
    """Return what is done with a column."""
    name = split_unit(header)[0]
    for column in schema.columns:
        if column.name == name:
            return column
    return LogColumn(name=name, role=IGNORED, reason="the schema of the first logs lacks it")


def _jitter(timing: Timing, dt: float) -> float:
    """Return the spread of steps that are no gaps, as a share of the period."""
    steps = np.diff(timing.times.seconds) / dt
    if not len(steps):
        return 0.0
    nine_in_ten = float(np.quantile(steps, 0.9))
    longest = FAR * max(1.0, nine_in_ten)
    return float(steps[steps <= longest].std())


def _gaps(timing: Timing, dt: float) -> NDArray[np.float64]:
    """Return from when to when (N, 2) nothing came, as ``fit`` and ``watch`` see it [s]."""
    times = timing.times.seconds
    ones = np.ones((len(times), 1))
    is_lost = np.isnan(evenly(ones, times, dt)[:, 0])
    ends = [(start - 1, stop) for start, stop in spans(is_lost)]  # [rows]
    return times[0] + dt * np.array(ends, np.float64).reshape(-1, 2)


def _facts(column: LogColumn, values: NDArray[Any]) -> dict[str, Any]:
    """Return what the values (T,) of a column are like."""
    if not is_numeric(values):
        values = np.zeros(0)
    is_known = np.isfinite(values) & (values != column.missing)
    known = values[is_known]
    missing = len(values) - len(known)
    ends = [np.nan, np.nan]
    if len(known):
        ends = [float(known.min()), float(known.max())]
    repeats = 0.0
    if len(values) > 1:
        is_repeated = values[1:] == values[:-1]
        repeats = float(is_repeated.mean())
    return {
        "channel": column.name,
        "unit": column.unit,
        "is": column.role,
        "from": ends[0],
        "to": ends[1],
        "noise": noise_of(values),
        "resolution": resolution(values),
        "repeats": repeats,
        "missing": missing,
        "what is done": _what_is_done(column, len(np.unique(known)), missing),
    }


def _what_is_done(column: LogColumn, different: int, missing: int) -> str:
    """Say what is done with a column of so many different and missing numbers, and why."""
    remarks = []
    if column.reason:
        remarks.append(column.reason)
    if column.role == SENSE and 1 < different < FEW_VALUES:
        remarks.append(f"hardly moves: {different} values; its spread has a floor")
    if column.role == SENSE and missing:
        remarks.append("missing numbers: bridged, or cut there")
    return "; ".join(remarks) or "read as it is"
