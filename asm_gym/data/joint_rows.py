"""Join rows of one joint each into rows of all joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from asm_gym.data.live_clock import LiveClock
from asm_gym.data.names import element_name, is_clock, split_unit
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
        self._gathered: dict[str, Any] = {}  # of the joints that came

    def find(self, row: Mapping[str, Any]) -> None:
        """Find the column that names a joint of the memory, if there is one."""
        labels = self._spec.labels
        joints = {label.partition("[")[2].rstrip("]") for label in labels if "[" in label}
        keys = [name for name in row if is_key(name) and str(row[name]).strip() in joints]
        self._joint = next(iter(keys), "")

    def whole(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
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

        before = self._gathered
        has_joint = any(name in before and not is_clock(name) for name in own)
        if has_joint or self._is_later(before, row):
            self._gathered = own
            return before
        whole = own | before  # the time is that of the first
        names = {split_unit(name)[0] for name in whole}
        if not names.issuperset(self._spec.labels):
            self._gathered = whole
            return None
        self._gathered = {}
        return whole

    def _is_later(self, before: Mapping[str, Any], row: Mapping[str, Any]) -> bool:
        """Return whether a row is of a later moment than the joints before it."""
        if not self._clock_is_found:
            self._clock.find(row, ())
            self._clock_is_found = True
        first = self._clock.stamp(before)
        stamp = self._clock.stamp(row)
        if first is None or stamp is None:
            return False
        return stamp - first > LATER * self._spec.dt
