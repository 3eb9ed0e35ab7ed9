"""What a log means: its clock, its rate, and the role of each column. Inferred once, shown, edited, kept.

tables ► LogSchema.infer ► schema.read(table) ► rows of a stream, and which of them a label marks
              ▲
           logs.toml, which the user edits (``asm_gym.data.schema_file``)

number of a stream   x = scale · ratio(unit of the header, unit) · cell, NaN if the cell is ``missing``
wrapped angle        sin(2π x / wrap) and cos(2π x / wrap)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import LogClock
from asm_gym.data.clock_inference import infer_clock
from asm_gym.data.names import TAU, TURN, TURNED, factor, is_label, label_of, split_unit
from asm_gym.data.reader_notes import note
from asm_gym.data.tables import Columns, is_numeric, laid_out
from asm_gym.data.timing import Timing, evenly, timing_of
from asm_gym.exceptions import DamagedFile
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_choice, check_number

SENSE = "sense"
COMMAND = "command"
LABEL = "label"
CLOCK = "clock"
CONSTANT = "constant"
COPY = "copy"
COUNTER = "counter"
IGNORED = "ignored"
UNCLEAR = "unclear"
ROLES = (SENSE, COMMAND, LABEL, CLOCK, CONSTANT, COPY, COUNTER, IGNORED, UNCLEAR)
READ = (SENSE, COMMAND)

LOG_SCHEMA = "log_schema"  # where an episode and a memory keep the schema that they were read with
ORIGIN = "origin"  # where an episode keeps the stamp of its first row [s]
RESAMPLED = 1.5  # a log is read at another rate by its clock, up to so many times its own
RATE_TOLERANCE = 0.01  # share by which a rate may differ without a note
NO_RATE = (
    "how many rows come a second? Say the rate [Hz] (--rate), or name or add a column of times "
    "(--clock)"
)
NORMAL = ("", "0", "false", "no", "none", "normal", "nominal", "ok", "good", "healthy", "nan")


@dataclass(frozen=True, kw_only=True)
class LogColumn:
    """What a column of a log is.

    Args:
        name: in the log, without the unit behind it.
        role: one of ``ROLES``; senses and commands are read.
        unit: of its numbers after ``scale``; empty if the log does not say.
        channel: to which its numbers belong; by default its name.
        element: which of several numbers of the channel it is.
        wrap: turn of an angle that turns over [unit]; 0 of other numbers.
        missing: the number that stands for missing data; None without one.
        scale: its numbers are multiplied by this.
        noise: standard deviation of its white noise [unit].
        varies: logs may differ in its range.
        reason: why it has this role.
    """

    name: str
    role: str = SENSE
    unit: str = ""
    channel: str = ""
    element: str = ""
    wrap: float = 0.0
    missing: float | None = None
    scale: float = 1.0
    noise: float = 0.0
    varies: bool = False
    reason: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        check_choice(f"role of {self.name!r}", self.role, ROLES)
        for what in ("unit", "channel", "element"):
            if not isinstance(getattr(self, what), str):
                raise ValueError(f"{what} of {self.name!r} must be text, got {self.unit!r}")
        check_number(f"scale of {self.name!r}", self.scale)
        check_number(f"wrap of {self.name!r}", self.wrap, low=0.0)
        check_number(f"noise of {self.name!r}", self.noise, low=0.0)

    @property
    def is_read(self) -> bool:
        """Whether it is part of the stream."""
        return self.role in READ

    @property
    def stream_channel(self) -> str:
        """The channel of the stream: an angle that turns over has one of its own."""
        if self.wrap or not self.channel:
            return self.name
        return self.channel

    @property
    def label(self) -> str:
        """What the stream calls its number."""
        if self.element:
            return f"{self.channel}[{self.element}]"
        return self.channel or self.name

    def matches(self, pattern: str) -> bool:
        """Return whether it or its channel is called so."""
        return pattern in (self.name, self.channel) or (
            fnmatchcase(self.name, pattern) or fnmatchcase(self.channel, pattern)
        )


class Recorded(NamedTuple):
    """The rows of a log."""

    stream: NDArray[np.float32]  # (T, D)
    spec: StreamSpec
    faults: NDArray[np.bool_]  # (T,) rows that a label marks; (0,) without a label
    origin: float | None  # stamp of the first row, by the log's clock; None without one [s]


@dataclass(frozen=True)
class LogSchema:
    """How the logs of a robot are read.

    Args:
        columns: every column, those of the stream in their order in a row.
        rate: rows a second [Hz]; 0 if nothing tells, and then no log can be read.
        clock: tells when a row was sensed; None if rows come at ``rate``.
        find_clock: name of the clock that is looked for in each log, or "" for any; None to read
            ``clock``. Not saved.
        memory_spec: the stream of a memory that keeps no schema; it is read by its labels. Not saved.

    Example:
        >>> import numpy as np
        >>> from asm_gym.data.schema import LogSchema
        >>> t = np.arange(100) / 50
        >>> log = {"time": t, "q_0 [rad]": np.sin(t), "q_1 [rad]": np.cos(t)}
        >>> schema = LogSchema.infer([log])
        >>> schema.rate, schema.spec.labels, schema.read(log).stream.shape
        (50.0, ('q[0]', 'q[1]'), (100, 2))
    """

    columns: tuple[LogColumn, ...]
    rate: float = 0.0
    clock: LogClock | None = None
    find_clock: str | None = None
    memory_spec: StreamSpec | None = None

    @classmethod
    def infer(cls, tables: Sequence[Any], **hints: Any) -> LogSchema:
        """Return the schema of logs of one robot; ``hints`` are the arguments of ``SchemaHints``."""
        from asm_gym.data.schema_inference import SchemaHints, infer_schema

        return infer_schema([laid_out(table) for table in tables], SchemaHints(**hints))

    @classmethod
    def of_spec(cls, spec: StreamSpec) -> Self:
        """Return the schema of a stream whose columns are called as its labels are."""
        columns = []
        for channel in spec.channels:
            role = COMMAND if channel.group == MOTOR else SENSE
            if channel.elements == TURNED:
                turn = TURN[channel.unit]
                columns.append(
                    LogColumn(name=channel.name, role=role, unit=channel.unit, wrap=turn)
                )
                continue
            elements: Iterable[Any] = channel.elements or range(channel.size)
            for label, element in zip(channel.labels, elements, strict=True):
                columns.append(
                    LogColumn(
                        name=label,
                        role=role,
                        unit=channel.unit,
                        channel=channel.name,
                        element="" if label == channel.name else str(element),
                    )
                )
        return cls(tuple(columns), 1.0 / spec.dt, find_clock="", memory_spec=spec)

    @classmethod
    def kept_in(cls, about: Mapping[str, Any], spec: StreamSpec) -> LogSchema:
        """Return the schema that a memory keeps in ``about``, or that of its ``spec``."""
        if LOG_SCHEMA in about:
            return cls.from_json(about[LOG_SCHEMA])
        return cls.of_spec(spec)

    @cached_property
    def read_columns(self) -> list[LogColumn]:
        """The columns of a stream's row in their order: commands stand last, or as in the memory."""
        columns = [column for column in self.columns if column.is_read]
        if self.memory_spec is None:
            columns.sort(key=lambda column: column.role == COMMAND)
        return columns

    @cached_property
    def spec(self) -> StreamSpec:
        """The stream of these columns.

        Raises:
            ValueError: the columns make no stream, or nothing tells the rate.
        """
        if self.memory_spec is not None:
            return self.memory_spec
        self.check()
        channels: dict[str, list[LogColumn]] = {}
        for column in self.read_columns:
            channels.setdefault(column.stream_channel, []).append(column)
        return StreamSpec(
            tuple(_channel(name, columns) for name, columns in channels.items()),
            1.0 / self.rate,
            "table",
        )

    def check(self) -> None:
        """Raise ValueError if logs cannot be read so, and say what to change."""
        for column in self.columns:
            if column.role == UNCLEAR:
                raise ValueError(f"{column.name} {column.reason}")
        names = Counter(column.name for column in self.read_columns)
        for name, count in names.items():
            if count > 1:
                raise ValueError(f"columns must have different names, got {name!r} twice")
        if not names:
            reasons = "; ".join(f"{column.name} {column.reason}" for column in self.columns)[:300]
            raise ValueError(f"a log must hold columns of numbers, got {reasons or 'nothing'}")
        if not self.rate:
            raise ValueError(NO_RATE)

    def read(self, table: Any) -> Recorded:
        """Return the rows of a log.

        Args:
            table: a dictionary of arrays, a frame of pandas or Polars, or an Arrow table.

        Raises:
            ValueError: columns are missing or hold no numbers, or rows come at another rate.
        """
        table = laid_out(table)
        spec = self.spec
        match = ColumnMatch(self, table)
        rows = match.rows(table)
        faults = self._marked_rows(table, match)
        clock = self.clock_in(table)
        if clock is None:
            return Recorded(rows.astype(np.float32), spec, faults, None)

        timing = timing_of(table, clock)
        self._check_rate(timing)
        if len(faults):
            rows = np.column_stack([rows, faults])
        rows = evenly(rows[timing.kept], timing.times.seconds, spec.dt)
        if len(faults):
            faults = np.nan_to_num(rows[:, -1]) > 0
            rows = rows[:, :-1]
        origin = timing.times.origin + float(timing.times.seconds[0])
        return Recorded(rows.astype(np.float32), spec, faults, origin)

    def clock_in(self, table: Columns) -> LogClock | None:
        """Return the clock of a table; None if its rows come at ``rate``.

        Raises:
            ValueError: it has no clock, and must have one.
        """
        dt = 1.0 / self.rate
        if self.find_clock is not None:
            return _found(infer_clock(table, self.find_clock, dt))
        if self.clock is None or set(self.clock.columns) <= set(table):
            return self.clock
        found = _found(infer_clock(table, dt=dt))
        note(f"the clock {self.clock.name!r} is not there: {found.name!r} is read")
        return found

    def _check_rate(self, timing: Timing) -> None:
        """Raise ValueError if rows come at another rate, and tell the user if they are resampled."""
        if timing.dt is None:
            return
        ratio = timing.dt * self.rate
        if not 1 / RESAMPLED <= ratio <= RESAMPLED:
            raise ValueError(
                f"the memory reads {self.rate:.4g} rows a second, these come at {1 / timing.dt:.4g}"
            )
        if abs(ratio - 1) > RATE_TOLERANCE:
            note(
                f"rows that come at {1 / timing.dt:.4g} a second are read at {self.rate:.4g}, "
                "by their clock"
            )

    def _marked_rows(self, table: Columns, match: ColumnMatch) -> NDArray[np.bool_]:
        """Return the rows (T,) that a label marks as faulty; (0,) without a label."""
        marks = []
        for header, values in table.items():
            if header not in match.headers and self._is_label(split_unit(header)[0], values):
                marks.append(_is_marked(values))
        if not marks:
            return np.zeros(0, np.bool_)
        return np.asarray(np.logical_or.reduce(marks))

    def _is_label(self, name: str, values: NDArray[Any]) -> bool:
        """Return whether a column labels faults: by the schema, or if that has no such column."""
        for column in self.columns:
            if column.name == name or fnmatchcase(name, column.name):
                return column.role == LABEL
        return is_label(name) and are_whole(values)

    def with_column(self, name: str, **changes: Any) -> LogSchema:
        """Return the schema with one column changed, or added at the front.

        Args:
            name: of the column; an added one may be a pattern such as ``state*``.
            changes: fields of ``LogColumn``.
        """
        if all(column.name != name for column in self.columns):
            return replace(self, columns=(LogColumn(name=name, **changes), *self.columns))
        columns = tuple(
            replace(column, **changes) if column.name == name else column for column in self.columns
        )
        return replace(self, columns=columns)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        saved = asdict(replace(self, memory_spec=None))
        del saved["memory_spec"]
        del saved["find_clock"]
        return saved

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> LogSchema:
        """Read what ``to_json`` returned.

        Raises:
            ValueError: it is something else.
        """
        try:
            clock = saved["clock"]
            if clock is not None:
                clock = LogClock(
                    columns=tuple(clock["columns"]),
                    units=tuple(clock["units"]),
                    kind=clock["kind"],
                    reason=clock["reason"],
                )
            columns = tuple(LogColumn(**column) for column in saved["columns"])
            return cls(columns, float(saved["rate"]), clock)
        except (KeyError, TypeError) as error:
            raise DamagedFile("the schema of the logs", repr(error)) from error


class ColumnMatch:
    """Find the numbers of a stream's row among the columns of a table or the names of a line.

    A column is found by its name, by the stream's label, or by its place in a list of its channel.

    Args:
        schema: how logs are read.
        names: of the columns that are there, perhaps with units.
        whole: all columns of the schema must be there.

    Attributes:
        headers: names of the columns that were found.

    Raises:
        ValueError: columns are missing, or of another unit.
    """

    def __init__(self, schema: LogSchema, names: Iterable[str], whole: bool = True) -> None:
        by_name = _headers_by_name(names)
        self.headers: list[str] = []
        self._columns: list[LogColumn] = []
        self._scales: list[float] = []
        missing = []
        for column, place in _with_places(schema.read_columns, by_name):
            candidates = (column.name, column.label, place)
            header = next((by_name[name] for name in candidates if name in by_name), None)
            if header is None:
                missing.append(column.label)
                continue
            self.headers.append(header)
            self._columns.append(column)
            own_name, own_unit = split_unit(header)
            self._scales.append(column.scale * factor(own_name, own_unit, column.unit or "1"))
        if missing and whole:
            raise ValueError(_what_is_missing(missing, schema, by_name))
        self._scale = np.array(self._scales)
        self._missing = np.array(
            [math.nan if c.missing is None else c.missing for c in self._columns]
        )
        self._wrapped = any(column.wrap for column in self._columns)

    def row(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the numbers (D,) of a line, by the names of its columns; NaN of those it lacks."""
        cells = [values.get(header) for header in self.headers]
        return self._numbers(
            np.array([math.nan if cell is None else cell for cell in cells], np.float64)
        )

    def rows(self, table: Columns) -> NDArray[np.float64]:
        """Return the rows (T, D) of a table.

        Raises:
            ValueError: a column holds words.
        """
        for header in self.headers:
            if not is_numeric(table[header]):
                raise ValueError(
                    f"{header} must hold numbers, as its schema says, got {table[header][0]!r}"
                )
        return self._numbers(
            np.column_stack([table[header] for header in self.headers]).astype(np.float64)
        )

    def _numbers(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the numbers (..., D) of a stream of those of its columns (..., C)."""
        numbers = np.where(cells == self._missing, np.nan, cells) * self._scale
        if not self._wrapped:
            return numbers
        parts = []
        for k, column in enumerate(self._columns):
            if column.wrap:
                angle = numbers[..., k] * TAU / column.wrap
                parts += [np.sin(angle), np.cos(angle)]
            else:
                parts.append(numbers[..., k])
        return np.stack(parts, axis=-1)


def _found(clock: LogClock | None) -> LogClock:
    """Return a clock that was looked for; raise ValueError if there is none."""
    if clock is None:
        raise ValueError(NO_RATE)
    return clock


def _headers_by_name(names: Iterable[str]) -> dict[str, str]:
    """Return the headers by their names without a unit, and by the labels that these stand for."""
    bare = {name: split_unit(name)[0] for name in names}
    headers = {label_of(short): name for name, short in bare.items()}
    return headers | {short: name for name, short in bare.items()}


def _with_places(
    columns: Iterable[LogColumn], by_name: Mapping[str, str]
) -> list[tuple[LogColumn, str]]:
    """Return each column, and its place in a list of its channel, ``q[1]``, if no name is there."""
    columns = list(columns)
    named = {c.channel for c in columns if c.name in by_name or c.label in by_name}
    count = Counter[str]()
    placed = []
    for column in columns:
        place = "" if column.channel in named else f"{column.channel}[{count[column.channel]}]"
        count[column.channel] += 1
        placed.append((column, place))
    return placed


def _what_is_missing(missing: list[str], schema: LogSchema, by_name: Mapping[str, str]) -> str:
    """Say which columns of a schema are not there, and which are there that it does not know."""
    message = f"the memory reads channels that are not there: {', '.join(missing)}"
    known = {name for column in schema.columns for name in (column.name, column.label)}
    extra = sorted({by_name[name] for name in by_name} - {by_name.get(name) for name in known})
    if extra:
        message += f"; there are, and its schema lacks them: {', '.join(extra)[:120]}"
    return message


def _channel(name: str, columns: Sequence[LogColumn]) -> Channel:
    """Return the channel of its columns.

    Raises:
        ValueError: they are of several units, or only some of them are commands.
    """
    names = ", ".join(sorted(column.name for column in columns))
    if len({column.role for column in columns}) > 1:
        raise ValueError(f"channel {name!r} is commanded in part: {names}")
    units = sorted({column.unit for column in columns if column.unit})
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(units)}")
    group = columns[0].channel or name
    if columns[0].role == COMMAND:
        group = MOTOR
    noise = float(np.median([column.noise for column in columns]))
    if group == MOTOR:
        noise = 0.0
    if columns[0].wrap:
        unit = "rad" if columns[0].wrap == TAU else "deg"
        return Channel(name, 2, unit, noise, group, TURNED)
    elements = tuple(column.element for column in columns)
    return Channel(
        name=name,
        size=len(columns),
        unit=units[0] if units else "1",
        noise=noise,
        group=group,
        elements=elements if any(elements) else (),
    )


def are_whole(values: NDArray[Any]) -> bool:
    """Return whether a column holds whole numbers, or words."""
    if not is_numeric(values):
        return True
    known = values[np.isfinite(values)]
    return bool((known == np.rint(known)).all())


def _is_marked(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the rows (T,) in which a label says that something is wrong."""
    if is_numeric(values):
        return np.asarray(np.nan_to_num(values.astype(np.float64)) != 0)
    return np.array([str(cell).strip().lower() not in NORMAL for cell in values])
