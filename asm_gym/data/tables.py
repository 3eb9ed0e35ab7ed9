"""Bring the table of a log into one layout: a column a sense, a row a moment.

names in cells   name0, position0, name1, …     position[elbow] of each joint that a row names, in any order
long             time, joint, position          a row a joint: position[elbow], a row a time
several rates    empty cells between            the rows of the fastest columns; a slower one keeps its newest value
publishers       a row of one of them each      the rows of the one of most columns; others keep their newest value
lists            (T, k)                         q[0], …, q[k-1]
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import element_name, is_clock
from asm_gym.data.reader_notes import note
from asm_gym.validation import short_repr

Columns = dict[str, NDArray[Any]]
Named = dict[str, dict[str, str]]  # values by their kind, by the column that names them

_NAMES = re.compile(r"(?P<of>.*?)(?:joint_?)?names?[_.]?\[?(?P<place>\d+)\]?", re.I)
_KEYS = "joint|motor|axis|servo|actuator|name|channel|signal|sensor|topic|field|variable"  # whose row it is
_KEY = re.compile(rf"(.*[^a-z])?({_KEYS})s?([^a-z].*)?", re.I)
MOST_COLUMNS = 8192  # every number is weighed against every other later on: see ``whitening``
MOST_KEYS = 64  # joints of a long table
MOSTLY = 0.9  # share of its rows in which a long table goes round its joints
SPARSE = 0.55  # share of filled rows up to which a column comes at a lower rate: at most at every other row
HELD = 3.0  # for so many of its own periods a slower column keeps its newest value


def table_of(frame: Any) -> Columns:
    """Return the columns (T,) of a dictionary, a frame of pandas or Polars, or an Arrow table by name."""
    names = (
        frame
        if isinstance(frame, Mapping)
        else getattr(frame, "column_names", getattr(frame, "columns", None))
    )
    if names is None or callable(names):
        raise TypeError(
            f"a table must be a dictionary of columns, or a frame of them, got {short_repr(frame)}"
        )
    if len({str(name) for name in names}) < len(list(names)):
        raise ValueError(f"columns must have different names, got {', '.join(map(str, names))}")
    made: Columns = {}
    for name in names:
        values = as_array(frame[name])
        if values.ndim > 2:
            note(f"{name}: of {values.ndim} dimensions, left out")
        elif values.ndim == 2:
            made |= {element_name(str(name), k): v for k, v in enumerate(values.T)}
        else:
            made[str(name)] = values
    return made


def check_width(size: int) -> None:
    """Raise ValueError where a table has more columns than can be watched."""
    if size > MOST_COLUMNS:
        raise ValueError(f"it has {size} columns, and at most {MOST_COLUMNS} can be watched")


def as_array(column: Any) -> NDArray[Any]:
    """Return an array (T,), None being NaN, or, of lists of one length, (T, k)."""
    array = np.asarray(column)
    if array.dtype == object and all(cell is None or isinstance(cell, Real) for cell in array):
        return np.array([np.nan if cell is None else cell for cell in array], np.float64)
    if (
        array.dtype == object
        and len(array)
        and all(isinstance(row, list | tuple | np.ndarray) for row in array)
    ):
        return np.array(array.tolist()) if len({len(row) for row in array}) == 1 else array
    return array


def is_numeric(values: NDArray[Any]) -> bool:
    """Tell whether a column holds numbers."""
    return values.dtype.kind in "biuf"


def named_columns(names: Iterable[str]) -> Named:
    """Return the columns whose cells name others, and these by their kind: ``position`` of ``position0``."""
    names = list(names)
    found: Named = {}
    for name in names:
        if match := _NAMES.fullmatch(name):
            kind = re.compile(rf"({re.escape(match['of'])}.*?[^\W\d])[_.]?\[?{match['place']}\]?")
            others = {
                other: kind.fullmatch(other)
                for other in names
                if other != name and not _NAMES.fullmatch(other)
            }
            found[name] = {hit[1].rstrip("_.["): other for other, hit in others.items() if hit}
    return {name: kinds for name, kinds in found.items() if kinds}


def named_row(row: Mapping[str, Any], named: Named) -> dict[str, Any]:
    """Return a row whose cells name its values, by those names: ``position[elbow]``."""
    made = dict(row)
    for name, kinds in named.items():
        for kind, column in kinds.items():
            if column in made and str(row.get(name) or "").strip():
                made[f"{kind}[{str(row[name]).strip()}]"] = made.pop(column)
    return made


def _with_names(table: Columns) -> Columns:
    """The table with the columns that cells name: a message may name other joints, or the same in another order."""
    named = {
        name: kinds for name, kinds in named_columns(table).items() if not is_numeric(table[name])
    }
    made = {
        name: values
        for name, values in table.items()
        if all(name not in k.values() for k in named.values())
    }
    for name, kinds in named.items():
        words = np.array([str(cell).strip() for cell in made.pop(name)])
        for word in dict.fromkeys(words.tolist()):
            at = words == word
            for kind, column in kinds.items() if word else ():
                values = made.setdefault(f"{kind}[{word}]", np.full(len(words), np.nan))
                values[at] = table[column][at]
    return made


def _pivoted(table: Columns) -> Columns:
    """A long table as a wide one; others as they are."""
    import pandas as pd

    key = next((name for name in table if is_key(name) and _goes_round(table[name])), None)
    values = [
        name for name in table if name != key and is_numeric(table[name]) and not is_clock(name)
    ]
    if key is None or not values:
        return table
    clock = next(filter(is_clock, table), None)
    frame = pd.DataFrame(table)
    round_of = frame.groupby(key, sort=False).cumcount()
    if clock is not None and frame[clock].duplicated().any():  # joints of a moment share a stamp
        round_of = (frame[clock] != frame[clock].shift()).cumsum()
    wide = frame.assign(_round=round_of).pivot_table(
        values, "_round", key, aggfunc="last", sort=False
    )
    made: Columns = (
        {}
        if clock is None
        else {clock: frame.groupby(round_of.to_numpy())[clock].first().to_numpy()}
    )
    made |= {element_name(name, word): wide[name, word].to_numpy() for name, word in wide.columns}
    note(
        f"a row a joint: put side by side by {key!r}, as {next(reversed(made))} and {len(made) - 1} others"
    )
    return made


def is_key(name: str) -> bool:
    """Tell whether a column is called as if it said whose row it is."""
    return _KEY.fullmatch(name) is not None and _NAMES.fullmatch(name) is None


def _goes_round(values: NDArray[Any]) -> bool:
    """Whether a column goes round the same few words or numbers."""
    import pandas as pd

    if len(values) < 4 or values.dtype.kind == "f":
        return False
    words = pd.factorize(values)[0]
    size = int(words.max()) + 1
    if not 2 <= size <= min(MOST_KEYS, len(words) // 2) or (words[:size] != np.arange(size)).any():
        return False
    changes, again = np.mean(words[1:] != words[:-1]), np.mean(words[size:] == words[:-size])
    return bool(changes >= MOSTLY and again >= MOSTLY)


def _joined(table: Columns) -> Columns:
    """A table whose columns come at several rates, at the rate of the fastest ones."""
    import pandas as pd

    filled = {
        n: np.isfinite(v)
        for n, v in table.items()
        if is_numeric(v) and v.dtype.kind == "f" and not is_clock(n)
    }
    masks = {mask.tobytes(): mask for mask in filled.values() if mask.any()}
    rows, most = np.ones(len(next(iter(table.values()), ())), np.bool_), SPARSE
    if (
        len(masks) > 1 and np.mean(np.sum(list(masks.values()), axis=0) == 1) > MOSTLY
    ):  # a row has one of them
        # as live: rows are those of the most numbers
        columns = Counter(mask.tobytes() for mask in filled.values())
        rows, most = (
            max(masks.values(), key=lambda mask: (columns[mask.tobytes()], np.count_nonzero(mask))),
            1.0,
        )
    slower = {
        n: m
        for n, m in filled.items()
        if not np.array_equal(m, rows) and m.mean() <= most and _regular(m)
    }
    if not slower:
        return table
    note(f"columns come at several rates: {', '.join(slower)[:120]} keep their newest value")
    held = pd.DataFrame(
        {n: pd.Series(table[n]).ffill(limit=round(HELD / m.mean())) for n, m in slower.items()}
    )[rows]
    # before that the slower ones said nothing
    start = int(held.notna().to_numpy().argmax(axis=0).max())
    return {
        n: (held[n].to_numpy() if n in slower else values[rows])[start:]
        for n, values in table.items()
    }


def _regular(mask: NDArray[np.bool_]) -> bool:
    """Whether filled cells (T,) come at a steady rate all the time, and not in a stretch of their own."""
    filled = np.flatnonzero(mask)
    if len(filled) < 5 or filled[-1] - filled[0] < MOSTLY * (len(mask) - 2 / mask.mean()):
        return False
    steps = np.diff(filled)
    return bool(np.quantile(steps, 0.9) <= 2.5 * max(float(np.median(steps)), 1 / mask.mean()))


def laid_out(frame: Any) -> Columns:
    """Return a table as ``table_of`` reads it, with a column a sense and a row a moment.

    Raises ValueError where it has no row, too many columns, or columns of several lengths.
    """
    table = table_of(frame)
    check_width(len(table))
    lengths = {name: len(values) for name, values in table.items()}
    if not any(lengths.values()):
        raise ValueError(
            f"a table must hold a row of numbers, got none of {', '.join(table)[:200] or 'any column'}"
        )
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"columns must have one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}"
        )
    return _joined(_pivoted(_with_names(table)))
