"""Join rows of one joint each into rows of all joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from asm_gym.data.column_names import element_name, is_clock, split_unit
from asm_gym.data.live_clock import LiveClock
from asm_gym.data.schema import LogSchema
from asm_gym.data.table_layout import is_key

LATER = 0.5  # share of a period from which on a row is of a later moment


class JointRows:
    """Gather the rows of single joints until all joints are there.

    Args:
        schema: how a memory reads logs.
    """

    def __init__(self, schema: LogSchema) -> None:
        self._spec = schema.spec
        self._clock = LiveClock(schema, "")
        self._clock_is_found = False
        self._joint = ""  # the column that says whose numbers a row holds
        self._gathered: dict[str, Any] = {}  # numbers of the joints of one moment so far

    def find(self, row: Mapping[str, Any]) -> None:
        """Find the column that names a joint of the memory, if there is one."""
        elements = [label.partition("[")[2] for label in self._spec.labels if "[" in label]
        joints = [element.rstrip("]") for element in elements]
        self._joint = ""
        for name, value in row.items():
            if is_key(name) and str(value).strip() in joints:
                self._joint = name
                return

    def complete_row(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return the row of all joints once it is complete, or one of a later moment comes.

        Where rows are not of one joint each, return them as they are.
        """
        if not self._joint:
            return row
        joint = str(row[self._joint]).strip()
        own = {}
        for name, value in row.items():
            if is_clock(name):
                own[name] = value
            elif name != self._joint:
                own[element_name(name, joint)] = value

        gathered = self._gathered
        has_joint = any(name in gathered and not is_clock(name) for name in own)
        if has_joint or self._is_later(gathered, row):
            self._gathered = own
            return gathered
        gathered = own | gathered  # the time is that of the first
        names = {split_unit(name)[0] for name in gathered}
        if not names.issuperset(self._spec.labels):
            self._gathered = gathered
            return None
        self._gathered = {}
        return gathered

    def _is_later(self, gathered: Mapping[str, Any], row: Mapping[str, Any]) -> bool:
        """Return whether a row is of a later moment than the joints before it."""
        if not self._clock_is_found:
            self._clock.find(row, ())
            self._clock_is_found = True
        first = self._clock.stamp(gathered)
        stamp = self._clock.stamp(row)
        if first is None or stamp is None:
            return False
        return stamp - first > LATER * self._spec.dt
