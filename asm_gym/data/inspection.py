"""Describe a log before anything is learned from it: its clock, its columns, and what is done with each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.channels import clock_of
from asm_gym.data.clock import Clock
from asm_gym.data.columns import Column, LogLayout, decide
from asm_gym.data.gaps import BRIDGED_ROWS
from asm_gym.data.tables import Columns, is_numeric, laid_out
from asm_gym.data.timing import FAR, evenly, timing_of
from asm_gym.readings import noise_of, resolution, spans

FEW_VALUES = 8  # A channel of fewer different values hardly moves
JITTERS = 0.1  # share of a period that steps spread by from which on a clock jitters

SHOWN = {"pace": "clock", "mixed": "words", "double": "sense"}
"""How a role is called in the table, where not by its name."""


class ClockFound(NamedTuple):
    """The clock of a log."""

    times: NDArray[np.float64]  # (T,) [s], or row numbers without a clock
    rate: float = 0.0  # rows a second in the mean, gaps left out [Hz]; 0 where it is unknown
    jitter: float = 0.0  # standard deviation of a step that is no gap, as a share of the period
    gaps: NDArray[np.float64] = np.zeros((0, 2))  # from when to when nothing came [s]
    trouble: str = ""  # why it cannot be read
    name: str = ""  # the columns that are it


class Inspection(NamedTuple):
    """A log."""

    name: str
    clock: ClockFound
    columns: list[Column]  # what is done with each
    facts: list[dict[str, Any]]  # what the values of each are like, by heading

    def caption(self) -> str:
        """Say in a line how long it is, and at which rate it comes."""
        clock, rows = self.clock, len(self.clock.times)
        seconds = float(np.ptp(clock.times)) if clock.rate and rows else 0.0
        by = f" by {clock.name!r}" if clock.name else ""
        rate = f"{clock.rate:.6g} Hz{by}, jitter {100 * clock.jitter:.1f} %" if clock.rate else "no rate"
        return f"{self.name}: {rows} rows, {seconds:.5g} s, {rate}, {len(clock.gaps)} gaps"

    def remarks(self) -> list[str]:
        """List what a user should know of the whole, a line each."""
        clock, lines = self.clock, list[str]()
        if clock.trouble:
            lines.append(f"cannot be read: {clock.trouble}")
        elif not clock.rate:
            lines.append("no clock: say --rate, rows a second, or name the column of times with --clock")
        elif clock.jitter > JITTERS:
            share, step = 100 * clock.jitter, 1e3 / clock.rate
            lines.append(f"the clock jitters by {share:.0f} % of a step: rows are put {step:.3g} ms apart")
        if len(clock.gaps):
            longest = f"{len(clock.gaps)} gaps in the clock, the longest {np.diff(clock.gaps, axis=1).max():.3g} s"
            lines.append(
                f"{longest}: up to {BRIDGED_ROWS} lost rows, or --bridge, are filled, the log is cut at others"
            )
        if all(c.role != "command" for c in self.columns):
            lines.append("no command by name: the memory learns without the arm's commands, unless fit --action says")
        return lines


def inspected(
    name: str, table: Mapping[str, NDArray[Any]], layout: LogLayout | None = None, others: Sequence[Columns] = ()
) -> Inspection:
    """Describe a table of columns (T,) or (T, k), as ``asm-gym fit`` reads it; ``others`` are of the same folder."""
    table, layout = laid_out(table), layout or LogLayout()
    found, clock = _clock(table, layout)
    columns = decide([table, *others], layout, clock)
    trouble = [f"{c.name} {c.why}" for c in columns if c.role in ("mixed", "double")]
    found = found._replace(trouble=found.trouble or "; ".join(trouble))
    return Inspection(name, found, columns, [_facts(c) for c in columns])


def _clock(table: Columns, layout: LogLayout) -> tuple[ClockFound, Clock | None]:
    count = np.arange(max(map(len, table.values()), default=0), dtype=np.float64)
    rate = layout.rate or layout.nominal or 0.0
    clock = None
    try:
        clock = clock_of(table, layout)
        if clock is None:
            return ClockFound(count / (rate or 1.0), rate), None
        timing = timing_of(table, clock)
        if timing.dt is None:
            raise ValueError("one row")
        times, dt = timing.times, timing.dt
        lost = np.isnan(evenly(np.ones((len(times), 1)), times, dt)[:, 0])  # as fit and watch read them
    except ValueError as error:
        return ClockFound(count / (rate or 1.0), rate, trouble="" if layout.rate else str(error)), clock
    gaps = times[0] + dt * np.array([(start - 1, stop) for start, stop in spans(lost)], np.float64).reshape(-1, 2)
    steps = np.diff(times) / dt
    jitter = float(steps[steps <= FAR * max(1.0, float(np.quantile(steps, 0.9)))].std())
    return ClockFound(clock.seconds(table), 1 / dt, jitter, gaps, name=clock.name), clock


def _facts(column: Column) -> dict[str, Any]:
    """What the values of a column are like."""
    values = column.values if is_numeric(column.values) else np.zeros(0)
    known = values[np.isfinite(values) & (values != column.code)]
    different, missing, step = len(np.unique(known)), len(values) - len(known), resolution(values)
    repeats = float(np.mean(values[1:] == values[:-1])) if len(values) > 1 else 0.0
    treatment = {
        f"hardly moves: {different} values; its spread has a floor": 1 < different < FEW_VALUES,
        "missing numbers: bridged, or cut there": missing > 0,
        "a memory of radians reads it too": "deg" in column.unit or "°" in column.unit,
    }
    remarks = ["commanded, by its name"] if column.role == "command" else []
    remarks += [column.why] if column.why else []
    remarks += [words for words, holds in treatment.items() if holds] if column.role == "sense" else []
    return {
        "channel": column.name,
        "unit": column.unit,
        "is": SHOWN.get(column.role, column.role),
        "from": float(known.min()) if len(known) else np.nan,
        "to": float(known.max()) if len(known) else np.nan,
        "noise": noise_of(values),
        "resolution": step,
        "repeats": repeats,
        "missing": missing,
        "what is done": "; ".join(remarks) or "read as it is",
    }
