"""Describe a log before anything is learned from it: its clock, its columns, and what is done with each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.channels import clock_of
from asm_gym.data.clock import Clock
from asm_gym.data.columns import Column, LogLayout, decide
from asm_gym.data.tables import Columns, is_numeric, laid_out
from asm_gym.data.timing import BRIDGED_ROWS, FAR, evenly, timing_of
from asm_gym.readings import noise_of, resolution, spans

FEW_VALUES = 8  # A channel of fewer different values hardly moves
JITTERS = 0.1  # share of a period that steps spread by from which on a clock jitters


class Inspection(NamedTuple):
    """A log."""

    name: str
    columns: list[Column]  # what is done with each
    facts: list[dict[str, Any]]  # what the values of each are like, by heading
    times: NDArray[np.float64]  # (T,) [s], or row numbers without a clock
    rate: float  # rows a second in the mean, gaps left out [Hz]; 0 where it is unknown
    by: str = ""  # the columns that are its clock
    jitter: float = 0.0  # standard deviation of a step that is no gap, as a share of the period
    gaps: NDArray[np.float64] = np.zeros((0, 2))  # from when to when nothing came [s]
    trouble: str = ""  # why it cannot be read

    def caption(self) -> str:
        """Say in a line how long it is, and at which rate it comes."""
        seconds = float(np.ptp(self.times)) if self.rate and len(self.times) else 0.0
        by = f" by {self.by!r}" if self.by else ""
        rate = (
            f"{self.rate:.6g} Hz{by}, jitter {100 * self.jitter:.1f} %" if self.rate else "no rate"
        )
        return (
            f"{self.name}: {len(self.times)} rows, {seconds:.5g} s, {rate}, {len(self.gaps)} gaps"
        )

    def remarks(self) -> list[str]:
        """List what a user should know of the whole, a line each."""
        longest = np.diff(self.gaps, axis=1).max(initial=0.0)
        remarks = {
            f"cannot be read: {self.trouble}": bool(self.trouble),
            "no clock: say --rate, rows a second, or name the column of times with --clock": not (
                self.trouble or self.rate
            ),
            f"the clock jitters by {self.jitter:.0%} of a step": self.jitter > JITTERS
            and not self.trouble,
            f"{len(self.gaps)} gaps in the clock, the longest {longest:.3g} s: up to {BRIDGED_ROWS} lost rows, or "
            "--bridge, are filled, the log is cut at others": len(self.gaps) > 0,
            "no command by name: the memory learns without the arm's commands, unless fit --action says": all(
                c.role != "command" for c in self.columns
            ),
        }
        return [line for line, holds in remarks.items() if holds]


def inspected(
    name: str,
    table: Mapping[str, NDArray[Any]],
    layout: LogLayout | None = None,
    others: Sequence[Columns] = (),
) -> Inspection:
    """Describe a table of columns (T,) or (T, k), as ``asm-gym fit`` reads it; ``others`` are of the same folder."""
    table, layout = laid_out(table), layout or LogLayout()
    rate, clock, trouble, found = layout.rate or layout.nominal or 0.0, None, "", dict[str, Any]()
    try:
        if (clock := clock_of(table, layout)) is not None:
            found = _by_clock(table, clock)
    except ValueError as error:
        trouble = "" if layout.rate else str(error)
    columns = decide([table, *others], layout, clock)
    refused = [f"{c.name} {c.why}" for c in columns if c.role in ("mixed", "double")]
    refused += [] if any(c.read for c in columns) or refused else ["no column of numbers is left"]
    rows = np.arange(len(next(iter(table.values()))), dtype=np.float64)
    unread: dict[str, Any] = {
        "times": rows / (rate or 1.0),
        "rate": rate,
        "trouble": trouble or "; ".join(refused),
    }
    return Inspection(name, columns, [_facts(c) for c in columns], **unread | found)


def _by_clock(table: Columns, clock: Clock) -> dict[str, Any]:
    """What the clock tells. Raises ValueError where it cannot be read."""
    timing = timing_of(table, clock)
    times, dt = timing.times, timing.dt
    if dt is None:
        raise ValueError("one row")
    # as fit and watch read them
    lost = spans(np.isnan(evenly(np.ones((len(times), 1)), times, dt)[:, 0]))
    gaps = times[0] + dt * np.array(
        [(start - 1, stop) for start, stop in lost], np.float64
    ).reshape(-1, 2)
    steps = np.diff(times) / dt
    jitter = float(steps[steps <= FAR * max(1.0, float(np.quantile(steps, 0.9)))].std())
    return {
        "times": clock.seconds(table),
        "rate": 1 / dt,
        "by": clock.name,
        "jitter": jitter,
        "gaps": gaps,
    }


def _facts(column: Column) -> dict[str, Any]:
    """What the values of a column are like."""
    values = column.values if is_numeric(column.values) else np.zeros(0)
    known = values[np.isfinite(values) & (values != column.code)]
    different, missing = len(np.unique(known)), len(values) - len(known)
    remarks = {
        "commanded, by its name": column.role == "command",
        column.why: bool(column.why),
        f"hardly moves: {different} values; its spread has a floor": column.role == "sense"
        and 1 < different < FEW_VALUES,
        "missing numbers: bridged, or cut there": column.role == "sense" and missing > 0,
    }
    return {
        "channel": column.name,
        "unit": column.unit,
        "is": column.role,
        "from": float(known.min()) if len(known) else np.nan,
        "to": float(known.max()) if len(known) else np.nan,
        "noise": noise_of(values),
        "resolution": resolution(values),
        "repeats": float(np.mean(values[1:] == values[:-1])) if len(values) > 1 else 0.0,
        "missing": missing,
        "what is done": "; ".join(line for line, holds in remarks.items() if holds)
        or "read as it is",
    }
