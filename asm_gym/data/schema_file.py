"""Write a schema as TOML that a user can edit, a line a column with its reason behind it, and read it."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from asm_gym.data.clock import KINDS, LogClock
from asm_gym.data.names import LONGER
from asm_gym.data.schema import ROLES, LogColumn, LogSchema
from asm_gym.files import write_text
from asm_gym.validation import check_choice, check_number

HEAD = f"""\
# How asm-gym reads these logs. Edit it, and name it: asm-gym fit LOGS --schema FILE
# Roles: {", ".join(ROLES)}.
# Further keys of a column: unit, wrap (turn of an angle that turns over), missing (number for
# missing data), scale (its numbers are multiplied by it), varies = true (logs may differ in range).
"""
DEFAULTS = LogColumn(name="")
KEYS = [each.name for each in fields(LogColumn) if each.name not in ("name", "reason")]


def write_schema(path: Path, schema: LogSchema) -> None:
    """Write a schema to a file."""
    clock = "# clock = { columns = [...], units = ['s'], kind = 'number' }  # there is none\n"
    if schema.clock is not None:
        table = {
            "columns": list(schema.clock.columns),
            "units": schema.clock.unit_names,
            "kind": schema.clock.kind,
        }
        clock = f"clock = {_inline(table)}  # {schema.clock.reason}\n"
    rate = f"rate = {schema.rate!r}  # rows a second [Hz]\n"
    if not schema.rate:
        rate = "# rate = 100.0  # rows a second [Hz]: no clock tells it\n"
    write_text(path, "".join([HEAD, rate, clock, "\n[columns]\n", *map(_line, schema.columns)]))


def _line(column: LogColumn) -> str:
    """Return the line of a column."""
    table = {"role": column.role}
    for key in KEYS:
        value = getattr(column, key)
        if value != getattr(DEFAULTS, key) and key != "role":
            table[key] = value
    if column.channel == column.name:
        del table["channel"]
    reason = column.reason or "read as it is"
    return (
        f"{json.dumps(column.name, ensure_ascii=False)} = {_inline(table)}  # {_one_line(reason)}\n"
    )


def _one_line(text: str) -> str:
    """Return text without the characters that a comment may not hold."""
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


def _inline(table: dict[str, Any]) -> str:
    """Return an inline table of TOML, whose strings and numbers are those of JSON."""
    cells = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items()]
    return f"{{ {', '.join(cells)} }}"


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
        quoted = {key, json.dumps(key, ensure_ascii=False), f"'{key}'"}
        for number, line in enumerate(self._lines, 1):
            if line.partition("=")[0].strip() in quoted or line.strip() == f"[{key}]":
                raise ValueError(f"{self._path}, line {number}: {key}: {problem}")
        raise ValueError(f"{self._path}: {key}: {problem}")

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
            units = [LONGER[unit] for unit in table["units"]]
            kind = table.get("kind", KINDS[0])
            check_choice("kind", kind, KINDS)
            columns = tuple(map(str, table["columns"]))
        except (KeyError, TypeError, ValueError) as error:
            self.refuse(
                "clock", f"needs columns, units of {', '.join(LONGER)}, and a kind: {error}"
            )
        if len(columns) != len(units):
            self.refuse("clock", f"{len(columns)} columns need as many units, got {len(units)}")
        return LogClock(columns, tuple(units), kind, "by the schema")

    def column(self, name: str, table: Any) -> LogColumn:
        """Return a column."""
        if not isinstance(table, dict) or set(table) - set(KEYS):
            self.refuse(name, f"must be a table of {', '.join(KEYS)}, got {table!r}")
        try:
            return LogColumn(name=name, reason="by the schema", **{"channel": name, **table})
        except (TypeError, ValueError) as error:
            self.refuse(name, error)
