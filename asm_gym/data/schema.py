"""What a log means: its clock, its rate, and the role of each column. Inferred once, shown, edited, kept.

tables ► LogSchema.infer ► schema.read(table) ► rows of a stream, and which of them a label marks
              ▲
           logs.toml, which the user edits (``asm_gym.data.schema_file``)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import LogClock
from asm_gym.data.clock_inference import infer_clock
from asm_gym.data.column_behaviour import are_whole, finite
from asm_gym.data.column_match import ColumnMatch
from asm_gym.data.column_names import TAU, TURN, TURNED_ELEMENTS, is_label, split_unit
from asm_gym.data.log_column import COMMAND, COUNTER, LABEL, SENSE, UNCLEAR, LogColumn
from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import Columns, is_numeric, laid_out
from asm_gym.data.timing import Timing, evenly, timing_of
from asm_gym.exceptions import DamagedFile
from asm_gym.spec import MOTOR, Channel, StreamSpec

LOG_SCHEMA = "log_schema"  # where an episode and a memory keep the schema that they were read with
LOG_ORIGIN = "origin"  # where an episode keeps the stamp of its first row [s]
MOST_RESAMPLED = 1.5  # greatest ratio of two rates at which a log is resampled by its clock
RATE_TOLERANCE = 0.01  # share by which a rate may differ without a note
NO_RATE = (
    "how many rows come a second? Say the rate [Hz] (--rate), or name or add a column of times "
    "(--clock)"
)
TURN_UNITS = {TAU: "rad", 360.0: "deg"}
"""The unit of an angle, by the size of a full turn in that unit."""
HEALTHY_LABELS = (
    "",
    "0",
    "false",
    "no",
    "none",
    "normal",
    "nominal",
    "ok",
    "good",
    "healthy",
    "nan",
)
"""Cells of a column of labels, in lower case, that say that nothing is wrong."""


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
        find_clock: None to read every log by ``clock``; else the name of the clock that is looked
            for in each log, or "" for whichever it has. Not saved.
        memory_spec: the stream of a memory that keeps no schema; it is read by its labels. Not saved.

    Example:
        >>> import numpy as np
        >>> from asm_gym import LogSchema
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
        columns = chain.from_iterable(_columns_of(channel) for channel in spec.channels)
        return cls(tuple(columns), 1.0 / spec.dt, find_clock="", memory_spec=spec)

    @classmethod
    def kept_in(cls, about: Mapping[str, Any], spec: StreamSpec) -> LogSchema:
        """Return the schema that a memory keeps in ``about``, or that of its ``spec``."""
        if LOG_SCHEMA in about:
            return cls.from_json(about[LOG_SCHEMA])
        return cls.of_spec(spec)

    @property
    def names(self) -> set[str]:
        """What its columns are called in logs and in the stream."""
        return {name for column in self.columns for name in (column.name, column.label)}

    @cached_property
    def stream_columns(self) -> list[LogColumn]:
        """The columns of a stream's row in their order: commands stand last, or as in the memory."""
        columns = [column for column in self.columns if column.is_read]
        if self.memory_spec is None:
            columns.sort(key=lambda column: column.role == COMMAND)
        return columns

    @property
    def names_in_logs(self) -> tuple[str, ...]:
        """What logs call each of the D numbers of a row; sine and cosine of an angle have one name."""
        names: list[str] = []
        for column in self.stream_columns:
            numbers = 1
            if column.wrap:
                numbers = len(TURNED_ELEMENTS)
            names += [column.name] * numbers
        return tuple(names)

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
        for column in self.stream_columns:
            channels.setdefault(column.stream_channel, []).append(column)
        described = [_channel(name, columns) for name, columns in channels.items()]
        return StreamSpec(tuple(described), 1.0 / self.rate, "table")

    def check(self) -> None:
        """Raise ValueError if logs cannot be read so, and say what to change."""
        for column in self.columns:
            if column.role == UNCLEAR:
                raise ValueError(f"{column.name} {column.reason}")
        names = Counter(column.name for column in self.stream_columns)
        for name, count in names.items():
            if count > 1:
                raise ValueError(f"columns must have different names, got {name!r} twice")
        if not names:
            reasons = [f"{column.name} {column.reason}" for column in self.columns]
            got = "; ".join(reasons)[:300] or "nothing"
            raise ValueError(f"a log must hold columns of numbers, got {got}")
        if not self.rate:
            message = NO_RATE
            counters = [column.name for column in self.columns if column.role == COUNTER]
            if counters:
                message += f"; {counters[0]!r} counts: --clock '{counters[0]} [ms]'?"
            raise ValueError(message)

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
        # Marks of faults stand behind the stream's columns, so that they are resampled with them.
        fault_marks = self._fault_marks(table, match.headers)
        rows = np.column_stack([match.rows(table), *fault_marks])
        origin = None
        clock = self.clock_in(table)
        if clock is not None:
            timing = timing_of(table, clock)
            self._check_rate(timing)
            rows = evenly(rows[timing.kept], timing.times.seconds, spec.dt)
            origin = timing.times.origin + float(timing.times.seconds[0])

        stream = rows[:, : spec.size].astype(np.float32)
        resampled_marks = np.nan_to_num(rows[:, spec.size :])
        faults: NDArray[np.bool_] = np.zeros(0, np.bool_)
        if resampled_marks.size:
            faults = np.asarray(resampled_marks.any(axis=1))
        return Recorded(stream, spec, faults, origin)

    def clock_in(self, table: Columns) -> LogClock | None:
        """Return the clock of a table; None if its rows come at ``rate``.

        Raises:
            ValueError: it has no clock, and must have one.
        """
        if self.find_clock is not None:
            found = infer_clock(table, self.find_clock, 1.0 / self.rate)
            if found is None:
                raise ValueError(NO_RATE)
            return found

        if self.clock is None or self.clock.is_in(table):
            return self.clock
        substitute = infer_clock(table, "", 1.0 / self.rate)
        if substitute is None:
            raise ValueError(NO_RATE)
        note(f"the clock {self.clock.name!r} is not there: {substitute.name!r} is read")
        return substitute

    def _check_rate(self, timing: Timing) -> None:
        """Raise ValueError if rows come at another rate, and tell the user if they are resampled."""
        if timing.dt is None:
            return
        ratio = timing.dt * self.rate
        log_rate = 1 / timing.dt
        if not can_resample(ratio):
            raise ValueError(
                f"the memory reads {self.rate:.4g} rows a second, these come at {log_rate:.4g}"
            )
        if abs(ratio - 1) > RATE_TOLERANCE:
            note(
                f"rows that come at {log_rate:.4g} a second are read at {self.rate:.4g}, "
                "by their clock"
            )

    def _fault_marks(
        self, table: Columns, stream_headers: Sequence[str]
    ) -> Iterator[NDArray[np.bool_]]:
        """Yield the rows (T,) that a column marks as faulty, for each label that is not in the stream."""
        for header, values in table.items():
            if header not in stream_headers and self._is_label(split_unit(header)[0], values):
                yield _is_marked(values)

    def _is_label(self, name: str, values: NDArray[Any]) -> bool:
        """Return whether a column labels faults: as its role says, or its name if it has none.

        Names in a schema may be patterns; the role of the exact name comes first.
        """
        exact = [column.role for column in self.columns if column.name == name]
        by_pattern = [column.role for column in self.columns if fnmatchcase(name, column.name)]
        roles = exact + by_pattern
        if roles:
            return roles[0] == LABEL
        return is_called_label(name, values)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        clock = None
        if self.clock is not None:
            clock = asdict(self.clock)
        columns = [asdict(column) for column in self.columns]
        return {"columns": columns, "rate": self.rate, "clock": clock}

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> LogSchema:
        """Read what ``to_json`` returned.

        Raises:
            ValueError: it is something else.
        """
        try:
            columns = tuple(LogColumn(**column) for column in saved["columns"])
            schema = cls(columns, float(saved["rate"]))
            clock = saved["clock"]
            if clock is None:
                return schema
            tuples = {key: tuple(clock[key]) for key in ("columns", "units")}  # lists in JSON
            return replace(schema, clock=LogClock(**clock | tuples))
        except (KeyError, TypeError) as error:
            raise DamagedFile("the schema of the logs", repr(error)) from error


def can_resample(ratio: float) -> bool:
    """Return whether a log can be read at another rate; ``ratio`` is of the two rates, either first."""
    return 1 / MOST_RESAMPLED <= ratio <= MOST_RESAMPLED


def _channel(name: str, columns: Sequence[LogColumn]) -> Channel:
    """Return the channel of its columns.

    Raises:
        ValueError: they are of several units, or only some of them are commands.
    """
    first = columns[0]
    unit = _common_unit(name, columns)
    group = first.channel or name
    if first.role == COMMAND:
        group = MOTOR
    noise = 0.0
    if group != MOTOR:
        noise = float(np.median([column.noise for column in columns]))
    if first.wrap:  # an angle that turns over is read as its sine and cosine
        unit = TURN_UNITS.get(first.wrap, "deg")
        return Channel(name, 2, unit, noise, group, TURNED_ELEMENTS)

    elements = tuple(column.element for column in columns)
    if not any(elements):
        elements = ()
    return Channel(name, len(columns), unit, noise, group, elements)


def _common_unit(name: str, columns: Sequence[LogColumn]) -> str:
    """Return the unit of a channel's columns, 1 without one.

    Raises:
        ValueError: they are of several units, or only some of them are commands.
    """
    roles = {column.role for column in columns}
    if len(roles) > 1:
        names = sorted(column.name for column in columns)
        raise ValueError(f"channel {name!r} is commanded in part: {', '.join(names)}")
    units = sorted({column.unit for column in columns if column.unit})
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(units)}")
    return next(iter(units), "1")


def _columns_of(channel: Channel) -> Iterator[LogColumn]:
    """Yield the columns of a channel, called as its labels are."""
    role = SENSE
    if channel.group == MOTOR:
        role = COMMAND
    if channel.elements == TURNED_ELEMENTS:
        turn = TURN[channel.unit]
        yield LogColumn(name=channel.name, role=role, unit=channel.unit, wrap=turn)
        return

    elements: Iterable[Any] = channel.elements or range(channel.size)
    for label, element in zip(channel.labels, elements, strict=True):
        column = LogColumn(name=label, role=role, unit=channel.unit, channel=channel.name)
        if label != channel.name:
            column = replace(column, element=str(element))
        yield column


def is_called_label(name: str, values: NDArray[Any]) -> bool:
    """Return whether a column is called as a label is, and holds whole numbers, or words."""
    return is_label(name) and (not is_numeric(values) or are_whole(finite(values)))


def _is_marked(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the rows (T,) in which a label says that something is wrong."""
    if is_numeric(values):
        return np.asarray(np.nan_to_num(values.astype(np.float64)) != 0)
    return np.array([str(cell).strip().lower() not in HEALTHY_LABELS for cell in values])
