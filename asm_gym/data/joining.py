"""Several files of one recording as one table: positions here, torques there.

By their clocks, at the rows of the first file; what another said between two of its rows is interpolated. Files without
a clock are joined row by row, and must be of one length.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock_column import clock_among, is_clock
from asm_gym.data.row_times import FAR

Columns = Mapping[str, NDArray[Any]]


def joined(files: Mapping[str, Columns]) -> dict[str, NDArray[Any]]:
    """The columns of all; those that several have are called ``file.column``.

    Raises:
        ValueError: some have a clock and others none; lengths differ, and there is none; times do not overlap.
    """
    clocks = {name: clock_among(columns) for name, columns in files.items()}
    without = [name for name, clock in clocks.items() if clock is None]
    if without and len(without) < len(files):
        raise ValueError(f"files are joined by their clocks, and {', '.join(without)} has none")
    first, *others = files
    times: dict[str, NDArray[np.float64]] = {}
    if not without:
        times = {name: clock.seconds(files[name][clock.column]) for name, clock in clocks.items() if clock}
        start, end = max(t[0] for t in times.values()), min(t[-1] for t in times.values())
        rows = (times[first] >= start) & (times[first] <= end)
        if rows.sum() < 2:
            raise ValueError(f"{first} and {', '.join(others)} were not recorded at the same time")
    else:
        lengths = {name: len(next(iter(columns.values()))) for name, columns in files.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(
                f"files without a clock must be of one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}"
            )
        rows = np.ones(lengths[first], np.bool_)
    counted = Counter(name for columns in files.values() for name in columns if not is_clock(name))
    made: dict[str, NDArray[Any]] = {} if without else {"time": times[first][rows]}
    for file, columns in files.items():
        for name, values in columns.items():
            if is_clock(name):
                continue
            called = name if counted[name] == 1 else f"{file}.{name}"
            same = without or np.array_equal(times[file], times[first])
            made[called] = values[rows] if same else _at(made["time"], times[file], values)
    return made


def _at(due: NDArray[np.float64], stamps: NDArray[np.float64], values: NDArray[Any]) -> NDArray[Any]:
    """What was said at these times: between two rows interpolated, NaN where they are far apart; of words the last."""
    after = np.clip(np.searchsorted(stamps, due), 1, len(stamps) - 1)
    if values.dtype.kind not in "biuf":
        said: NDArray[Any] = values[np.where(stamps[after] > due, after - 1, after)]
        return said
    flat = values.reshape(len(values), -1).astype(np.float64)
    out = np.column_stack([np.interp(due, stamps, flat[:, k]) for k in range(flat.shape[1])])
    gap = stamps[after] - stamps[after - 1]
    out[gap > FAR * float(np.quantile(np.diff(stamps), 0.9))] = np.nan
    return out.reshape(len(due), *values.shape[1:])
