"""Write a schema as TOML that a user can edit, a line a column with its reason behind it, and read it."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from asm_gym.data.clock import CLOCK_KINDS, NUMBER, LogClock
from asm_gym.data.column_names import LONGER
from asm_gym.data.log_column import COLUMN_ROLES, LogColumn
from asm_gym.data.schema import LogSchema
from asm_gym.files import write_text
from asm_gym.validation import check_choice, check_number

HEAD = f"""\
# How asm-gym reads these logs. Edit it, and name it: asm-gym fit LOGS --schema FILE
# Roles: {", ".join(COLUMN_ROLES)}.
# Further keys of a column: unit, wrap (turn of an angle that turns over), missing (number for
# missing data), scale (its numbers are multiplied by it), varies = true (logs may differ in range).
"""
RATE_COMMENT = "# rate = 100.0  # rows a second [Hz]: no clock tells it"
CLOCK_COMMENT = "# clock = { columns = [...], units = ['s'], kind = 'number' }  # there is none"
DEFAULTS = LogColumn(name="")
NOT_IN_COMMENTS = r"[\x00-\x1f\x7f]"
KEYS = [each.name for each in fields(LogColumn) if each.name not in ("name", "reason")]


def write_schema(path: Path, schema: LogSchema) -> None:
    """Write a schema to a file."""
    rate = RATE_COMMENT
    if schema.rate:
        rate = f"rate = {schema.rate!r}  # rows a second [Hz]"
    clock = CLOCK_COMMENT
    if schema.clock is not None:
        table = {
            "columns": schema.clock.columns,
            "units": schema.clock.unit_names,
            "kind": schema.clock.kind,
        }
        clock = f"clock = {_inline(table)}  # {schema.clock.reason}"
    lines = [HEAD + rate, clock, "", "[columns]"]
    lines += [_line(column) for column in schema.columns]
    write_text(path, "\n".join(lines) + "\n")


def _line(column: LogColumn) -> str:
    """Return the line of a column."""
    table = {"role": column.role}
    for key in KEYS:
        value = getattr(column, key)
        if value != getattr(DEFAULTS, key):
            table[key] = value
    if column.channel == column.name:
        del table["channel"]
    reason = re.sub(NOT_IN_COMMENTS, " ", column.reason or "read as it is")
    return f"{_json(column.name)} = {_inline(table)}  # {reason}"


def _inline(table: dict[str, Any]) -> str:
    """Return an inline table of TOML, whose strings and numbers are those of JSON."""
    cells = [f"{key} = {_json(value)}" for key, value in table.items()]
    return f"{{ {', '.join(cells)} }}"


def _json(value: Any) -> str:
    """Return a string, a number or a list of them as JSON, which is TOML too."""
    return json.dumps(value, ensure_ascii=False)


def read_schema(path: Path) -> LogSchema:
    """Read a schema that ``write_schema`` wrote and a user edited.

    Raises:
        OSError: there is no such file.
        ValueError: it is damaged; the message names the line.
    """
    text = path.read_text(encoding="utf-8")
    try:
        saved = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path} is no schema: {error}") from error
    clock = None
    rate = 0.0
    columns = []
    lines = _Lines(path, text)
    for key, value in saved.items():
        with lines.named(key):
            if key == "rate":
                rate = float(check_number("rate", value, low=0.0))
            elif key == "clock":
                clock = _clock(value)
            elif key != "columns":
                raise ValueError("unknown key; known: rate, clock, columns")
    for name, table in saved.get("columns", {}).items():
        with lines.named(name):
            columns.append(_column(name, table))
    schema = LogSchema(tuple(columns), rate, clock)
    try:
        schema.check()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return schema


class _Lines:
    """The lines of a schema's file, which name what is wrong."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = text.splitlines()

    @contextmanager
    def named(self, key: str) -> Iterator[None]:
        """Raise a ValueError of the block with the line of a key."""
        try:
            yield
        except (KeyError, TypeError, ValueError) as error:
            place = str(self._path)
            written = {key, _json(key), f"'{key}'", f"[{key}]"}
            for number, line in enumerate(self._lines, 1):
                if line.partition("=")[0].strip() in written:
                    place += f", line {number}"
                    break
            raise ValueError(f"{place}: {key}: {error}") from error


def _clock(table: Any) -> LogClock:
    """Return the clock of an inline table."""
    try:
        columns = tuple(str(name) for name in table["columns"])
        units = tuple(LONGER[unit] for unit in table["units"])
        kind = table.get("kind", NUMBER)
        check_choice("kind", kind, CLOCK_KINDS)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        known = ", ".join(LONGER)
        raise ValueError(f"needs columns, units of {known}, and a kind: {error}") from error
    if len(columns) != len(units):
        raise ValueError(f"{len(columns)} columns need as many units, got {len(units)}")
    return LogClock(columns, units, kind, "by the schema")


def _column(name: str, table: Any) -> LogColumn:
    """Return a column of an inline table."""
    if not isinstance(table, dict) or set(table) - set(KEYS):
        raise ValueError(f"must be a table of {', '.join(KEYS)}, got {table!r}")
    return LogColumn(name=name, reason="by the schema", **{"channel": name, **table})
