"""Write a schema as TOML that a user can edit, a line a column with its reason behind it, and read it."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from asm_gym.data.clock import KINDS, NUMBER, LogClock
from asm_gym.data.log_column import ROLES, LogColumn
from asm_gym.data.names import LONGER
from asm_gym.data.schema import LogSchema
from asm_gym.files import write_text
from asm_gym.validation import check_choice, check_number

HEAD = f"""\
# How asm-gym reads these logs. Edit it, and name it: asm-gym fit LOGS --schema FILE
# Roles: {", ".join(ROLES)}.
# Further keys of a column: unit, wrap (turn of an angle that turns over), missing (number for
# missing data), scale (its numbers are multiplied by it), varies = true (logs may differ in range).
"""
NO_RATE = "# rate = 100.0  # rows a second [Hz]: no clock tells it"
NO_CLOCK = "# clock = { columns = [...], units = ['s'], kind = 'number' }  # there is none"
DEFAULTS = LogColumn(name="")
NOT_IN_COMMENTS = r"[\x00-\x1f\x7f]"
KEYS = [each.name for each in fields(LogColumn) if each.name not in ("name", "reason")]


def write_schema(path: Path, schema: LogSchema) -> None:
    """Write a schema to a file."""
    rate = NO_RATE
    if schema.rate:
        rate = f"rate = {schema.rate!r}  # rows a second [Hz]"
    clock = NO_CLOCK
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
    parser = _Parser(path, text)
    unknown = set(saved) - {"rate", "clock", "columns"}
    if unknown:
        parser.refuse(min(unknown), "unknown key; known: rate, clock, columns")
    columns = tuple(parser.column(name, table) for name, table in saved.get("columns", {}).items())
    schema = LogSchema(columns, parser.rate(saved), parser.clock(saved))
    try:
        schema.check()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return schema


class _Parser:
    """Check the values of a schema's file, and name the line of one that is wrong."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = text.splitlines()

    def refuse(self, key: str, problem: object) -> NoReturn:
        """Raise ValueError with the line of a key."""
        written = {key, _json(key), f"'{key}'", f"[{key}]"}
        place = str(self._path)
        for number, line in enumerate(self._lines, 1):
            if line.partition("=")[0].strip() in written:
                place += f", line {number}"
                break
        raise ValueError(f"{place}: {key}: {problem}")

    def rate(self, saved: dict[str, Any]) -> float:
        """Return the rate; 0 if the file says none."""
        try:
            return float(check_number("rate", saved.get("rate", 0.0), low=0.0))
        except (TypeError, ValueError) as error:
            self.refuse("rate", error)

    def clock(self, saved: dict[str, Any]) -> LogClock | None:
        """Return the clock; None if the file says none."""
        table = saved.get("clock")
        if table is None:
            return None
        try:
            columns = tuple(str(name) for name in table["columns"])
            units = tuple(LONGER[unit] for unit in table["units"])
            kind = table.get("kind", NUMBER)
            check_choice("kind", kind, KINDS)
        except (KeyError, TypeError, ValueError) as error:
            known = ", ".join(LONGER)
            self.refuse("clock", f"needs columns, units of {known}, and a kind: {error}")
        if len(columns) != len(units):
            self.refuse("clock", f"{len(columns)} columns need as many units, got {len(units)}")
        return LogClock(columns, units, kind, "by the schema")

    def column(self, name: str, table: Any) -> LogColumn:
        """Return a column."""
        if not isinstance(table, dict) or set(table) - set(KEYS):
            self.refuse(name, f"must be a table of {', '.join(KEYS)}, got {table!r}")
        try:
            return LogColumn(name=name, reason="by the schema", **{"channel": name, **table})
        except (TypeError, ValueError) as error:
            self.refuse(name, error)
