"""Bring the table of a log into one layout: a column a sense, a row a moment.

names in cells   name0, position0, name1, …     position[elbow] of each joint that a row names, in any order
long             time, joint, position          a row a joint: position[elbow], a row a time
several rates    empty cells between            the rows of the fastest columns; a slower one keeps its newest value
publishers       a row of one of them each      the rows of the one of most columns; others keep their newest value
lists            (T, k)                         q[0], …, q[k-1]
pictures         (T, h, w), or many bytes       left out
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import element_name, is_clock
from asm_gym.data.reader_notes import note
from asm_gym.validation import short_repr

Columns = dict[str, NDArray[Any]]
Mask = NDArray[np.bool_]

# A column whose cells name those of its number: field.name0, joint_name[0]
_NAMES = re.compile(
    r"""
    (?P<of> .*?)
    (?: joint_? )? names? [_.]?
    \[? (?P<place> \d+) \]?
    """,
    re.IGNORECASE | re.VERBOSE,
)
# A column that says whose row it is
_KEY = re.compile(
    r"""
    (.*[^a-z])?
    (joint|motor|axis|servo|actuator|name|channel|signal|sensor|topic|field|variable) s?
    ([^a-z].*)?
    """,
    re.IGNORECASE | re.VERBOSE,
)
LISTS = (list, tuple, np.ndarray)  # types of a cell that holds several numbers
MOST_COLUMNS = 8192  # every number is weighed against every other later on: see ``whitening``
MOST_BYTES = 512  # of a row of an array of bytes; more are a picture
MOST_KEYS = 64  # joints of a long table
MOSTLY_REGULAR = 0.9  # share of its rows in which a long table goes round its joints
SPARSE = 0.55  # largest share of filled rows of a column at a lower rate: at most every other row
HELD_PERIODS = 3.0  # for so many of its own periods a slower column keeps its newest value
FEWEST_FILLED_ROWS = 5  # filled rows that show a rate


class NamedBy(NamedTuple):
    """What names a column: ``name0`` names ``position0``, which is of the kind ``position``."""

    column: str
    kind: str


Named = dict[str, NamedBy]  # by the column that is named


def table_of(frame: Any) -> Columns:
    """Return the columns (T,) of a dictionary, a frame of pandas or Polars, or an Arrow table by name."""
    names = getattr(frame, "column_names", getattr(frame, "columns", None))
    if isinstance(frame, Mapping):
        names = frame
    if names is None:
        raise TypeError(
            f"a table must be a dictionary of columns, or a frame of them, got {short_repr(frame)}"
        )
    words = list(map(str, names))
    if len(set(words)) < len(words):
        raise ValueError(f"columns must have different names, got {', '.join(words)}")
    table: Columns = {}
    for name in names:
        values = as_array(frame[name])
        if _are_pictures(values):
            note(f"{name}: left out, taken for pictures by its type and size")
        elif values.ndim == 2:
            for place, column in enumerate(values.T):
                table[element_name(str(name), place)] = column
        else:
            table[str(name)] = values
    return table


def _are_pictures(values: NDArray[Any]) -> bool:
    """Whether a row of an array is of two dimensions, or of many bytes."""
    is_bytes = values.dtype.name in ("uint8", "int8")
    if is_bytes and values.ndim == 2:
        return values.shape[1] > MOST_BYTES
    return values.ndim > 2


def check_width(size: int) -> None:
    """Raise ValueError where a table has more columns than can be watched."""
    if size > MOST_COLUMNS:
        raise ValueError(f"it has {size} columns, and at most {MOST_COLUMNS} can be watched")


def as_array(column: Any) -> NDArray[Any]:
    """Return an array (T,), None being NaN, or, of lists of one length, (T, k)."""
    array = np.asarray(column)
    if array.dtype != object:
        return array
    if all(isinstance(cell, Real | None) for cell in array):
        return array.astype(np.float64)
    if not all(isinstance(cell, LISTS) for cell in array):
        return array
    lengths = set(map(len, array))
    if len(lengths) > 1:
        return array
    return np.array(array.tolist())


def is_numeric(values: NDArray[Any]) -> bool:
    """Tell whether a column holds numbers."""
    return values.dtype.kind in "biuf"


def named_columns(names: Iterable[str]) -> Named:
    """Return the columns that the cells of others name: ``position0`` by those of ``name0``."""
    names = list(names)
    named: Named = {}
    matches = map(_NAMES.fullmatch, names)
    for match in filter(None, matches):
        of = re.escape(match["of"])
        pattern = rf"({of}.*?[^\W\d])[_.]?\[?{match['place']}\]?"
        for other in names:
            kind = re.fullmatch(pattern, other)
            if kind and not _NAMES.fullmatch(other):
                named[other] = NamedBy(
                    column=match[0],
                    kind=kind[1].rstrip("_.["),
                )
    return named


def named_row(row: Mapping[str, Any], named: Named) -> dict[str, Any]:
    """Return a row whose cells name its values, by those names: ``position[elbow]``."""
    made = dict(row)
    for column, by in named.items():
        word = str(row.get(by.column, "")).strip()
        if word and column in made:
            made[f"{by.kind}[{word}]"] = made.pop(column)
    return made


def _with_names(table: Columns) -> Columns:
    """The table with the columns that cells name: a message may name other joints, or the same in another order."""
    made = dict(table)
    for column, by in named_columns(table).items():
        names = table[by.column]
        values = table[column]
        if is_numeric(names) or not is_numeric(values):
            continue
        made.pop(column)
        made.pop(by.column, None)
        words = np.array([str(name).strip() for name in names])
        for word in dict.fromkeys(words.tolist()):
            rows = words == word
            empty = np.full(len(words), np.nan)
            if word:
                named = made.setdefault(f"{by.kind}[{word}]", empty)
                named[rows] = values[rows]
    return made


def _pivoted(table: Columns) -> Columns:
    """A long table as a wide one; others as they are."""
    import pandas as pd

    keys = []
    clocks = []
    senses = []
    for name, values in table.items():
        if is_clock(name):
            clocks.append(name)
        elif is_key(name) and _goes_round(values):
            keys.append(name)
        elif is_numeric(values):
            senses.append(name)
    if not keys or not senses:
        return table
    key = keys[0]
    frame = pd.DataFrame(table)
    moments = frame.groupby(key).cumcount()
    times = frame[clocks[:1]]
    if times.duplicated().any():  # joints of a moment share a stamp
        is_new = times != times.shift()
        moments = is_new.any(axis=1).cumsum()
    wide = frame.pivot_table(
        senses,
        index=moments,
        columns=key,
        aggfunc="last",
        sort=False,
    )
    made: Columns = {}
    for clock in times:
        made[clock] = times[clock].groupby(moments).first().to_numpy()
    for name, word in wide:
        made[element_name(name, word)] = wide[name, word].to_numpy()
    names = ", ".join(made)
    note(f"a row a joint: put side by side by {key!r}, as {names[:120]}")
    return made


def is_key(name: str) -> bool:
    """Tell whether a column is called as if it said whose row it is."""
    if _NAMES.fullmatch(name):
        return False
    return _KEY.fullmatch(name) is not None


def _goes_round(values: NDArray[Any]) -> bool:
    """Whether a column goes round the same few words or numbers."""
    import pandas as pd

    if values.dtype.kind == "f":
        return False
    codes, words = pd.factorize(values)
    size = len(words)
    most = min(MOST_KEYS, len(codes) / 2)
    if not 2 <= size <= most:
        return False
    changes = np.mean(codes[1:] != codes[:-1])
    repeats = np.mean(codes[size:] == codes[:-size])
    return bool(min(changes, repeats) >= MOSTLY_REGULAR)


def _joined(table: Columns) -> Columns:
    """A table whose columns come at several rates, at the rate of the fastest ones."""
    import pandas as pd

    filled = {}
    for name, values in table.items():
        if values.dtype.kind == "f" and not is_clock(name):
            mask = np.isfinite(values)
            if mask.any():
                filled[name] = mask
    rows = _leading_rows(list(filled.values()))
    slower = {}
    for name, mask in filled.items():
        share = mask.mean()
        is_fast = rows.all() and share > SPARSE
        if is_fast or np.array_equal(mask, rows) or not _is_steady(mask):
            continue
        column = pd.Series(table[name])
        limit = round(HELD_PERIODS / share)
        slower[name] = column.ffill(limit=limit)
    if not slower:
        return table
    names = ", ".join(slower)
    note(f"columns come at several rates: {names[:120]} keep their newest value")
    is_known = pd.DataFrame(slower)[rows].notna()
    start = is_known.all(axis=1).argmax()  # before, a slower column has no value yet
    joined: Columns = {}
    for name, values in table.items():
        column = np.asarray(slower.get(name, values))
        joined[name] = column[rows][start:]
    return joined


def _leading_rows(filled: Sequence[Mask]) -> Mask:
    """The rows (T,) of the publisher of most columns where publishers take turns; else all rows."""
    publishers: dict[bytes, list[Mask]] = {}
    for mask in filled:
        columns = publishers.setdefault(mask.tobytes(), [])
        columns.append(mask)
    rows = [columns[0] for columns in publishers.values()]
    is_of_one = np.sum(rows, axis=0) == 1
    if len(rows) < 2 or is_of_one.mean() <= MOSTLY_REGULAR:
        return np.ones_like(is_of_one)
    leader = max(publishers.values(), key=len)
    return leader[0]


def _is_steady(filled: Mask) -> bool:
    """Whether filled cells (T,) come at a steady rate all the time, and not in a stretch of their own."""
    places = np.flatnonzero(filled)
    if len(places) < FEWEST_FILLED_ROWS:
        return False
    period = len(filled) / len(places)  # [rows]
    stretch = len(filled) - 2 * period
    if np.ptp(places) < MOSTLY_REGULAR * stretch:
        return False
    steps = np.diff(places)
    usual = max(period, np.median(steps))
    long = np.quantile(steps, 0.9)
    return bool(long <= 2.5 * usual)


def laid_out(frame: Any) -> Columns:
    """Return a table as ``table_of`` reads it, with a column a sense and a row a moment.

    Raises ValueError where it has no row, too many columns, or columns of several lengths.
    """
    table = table_of(frame)
    check_width(len(table))
    lengths = set(map(len, table.values()))
    if lengths <= {0}:
        names = ", ".join(table)
        raise ValueError(f"a table must hold a row of numbers, got none of {names[:200]}")
    if len(lengths) > 1:
        sizes = [f"{name}: {len(values)}" for name, values in table.items()]
        raise ValueError(f"columns must have one length, got {', '.join(sizes)}")
    table = _with_names(table)
    table = _pivoted(table)
    return _joined(table)
