"""What a live watch does about its incidents: evidence, orders of a person, and the threshold that follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.live_rows import Row
from asm_gym.detection.incidents import Incident, IncidentBook
from asm_gym.evaluation.incident_window import AFTER_S
from asm_gym.guard.guard import Guard
from asm_gym.guard.incident_recorder import IncidentRecorder, KeptRow
from asm_gym.guard.operator_orders import ACKNOWLEDGE, Order
from asm_gym.guard.step_info import RowReport
from asm_gym.guard.watch_settings import WatchSettings
from asm_gym.monitors.expectation import Expectation, Expected
from asm_gym.spec import StreamSpec

ALL = "all"  # channels that are acknowledged
RETRY_S = 5.0  # time between two attempts to acknowledge a channel [s]


@dataclass(frozen=True)
class IncidentDetails:
    """What the alarm of an incident says of its channel."""

    channel: str
    in_words: str  # sensed and expected
    fields: dict[str, Any]  # of ``LiveEvent``


class IncidentDesk:
    """Record incidents, obey a person, and let the threshold follow.

    Args:
        monitor: of the watch.
        guard: of one robot, that judges its rows.
        settings: of the watch.
        names: of the columns (D,), as logs call them.
        note: says a note.
    """

    def __init__(
        self,
        monitor: Any,
        guard: Guard,
        settings: WatchSettings,
        names: Sequence[str],
        note: Callable[[str], None],
    ) -> None:
        self._spec: StreamSpec = monitor.spec
        self._names = names
        self._guard = guard
        self._settings = settings
        self._note = note
        self._expectation = Expectation(monitor)
        self._recorder = IncidentRecorder(
            settings.evidence, names, self._spec.dt, self._expectation
        )
        self._numbers: dict[int, Incident] = {}  # incidents that may be open, by number
        self._waiting: dict[int, float] = {}  # when to try next to acknowledge each [s]
        self._said: set[str] = set()  # problems that were noted
        self._is_kept = True  # every level shift is saved
        self._following = settings.following

    def begin(self) -> None:
        """Forget the rows before: they are not the past of those that follow."""
        self._recorder.begin()
        self._set_threshold()

    def details(
        self, incident: Incident, numbers: NDArray[np.float64], number: int
    ) -> IncidentDetails:
        """Return what is known of an incident that the row (D,) opens."""
        self._forget_ended(incident.start)
        self._numbers[number] = incident
        column = incident.column
        if self._settings.acknowledges:
            self._waiting[number] = incident.start + AFTER_S
        file = self._recorder.open_window(number, column, incident.start)
        fields: dict[str, Any] = {"evidence": file}
        if column is None:
            return IncidentDetails(channel="", in_words="", fields=fields)
        channel = self._names[column]
        fields |= {"channel": channel, "group": self._spec.groups[column]}
        expected = self._expected(numbers, column)
        if expected is None:
            return IncidentDetails(channel=channel, in_words="", fields=fields)
        fields |= expected._asdict() | {"sign": expected.sign}
        return IncidentDetails(channel=channel, in_words=f"  {expected}", fields=fields)

    def _forget_ended(self, time: float) -> None:
        """Forget the incidents that have ended: a watch may run for months."""
        ended = [number for number, each in self._numbers.items() if not each.is_open(time)]
        for number in ended:
            del self._numbers[number]
            self._waiting.pop(number, None)

    def _expected(self, numbers: NDArray[np.float64], column: int) -> Expected | None:
        """Return a column of a row (D,) beside what is expected; None if unknown: no error may hold up an alarm."""
        rows: list[NDArray[np.floating[Any]]] = [numbers]
        before = self._recorder.last_row()
        if before is not None:
            rows.insert(0, before)
        try:
            return self._expectation.at_end(np.array(rows, np.float64), column)
        except Exception as error:
            self._say_once(f"what {self._names[column]} should read is unknown: {error!r}")
            return None

    def after_row(self, time: float, row: Row, report: RowReport, book: IncidentBook) -> None:
        """Do all that need not come before an alarm is told."""
        robot = report.robots[0]
        surprise = float(robot["surprise"])
        threshold = float(robot["threshold"])
        strength = 0.0
        if threshold > 0:
            strength = surprise / threshold
        self._recorder.add(KeptRow(time, row.stamp, row.numbers, strength))
        self._obey(time, book)
        for number, due in list(self._waiting.items()):
            if time >= due:
                self._acknowledge_steady(number, time, book)
        if self._following is not None and self._following.add(surprise):
            self._set_threshold()
            self._try("the state of the threshold is not saved", self._following.save)
        for problem in self._recorder.problems():
            self._say_once(problem)

    def close(self) -> None:
        """Write what is left to write."""
        self._recorder.close()
        for problem in self._recorder.problems():
            self._say_once(problem)
        if self._following is not None:
            self._try("the state of the threshold is not saved", self._following.save)
        if not self._is_kept:
            self._note(
                "the level shifts that were acknowledged end with this run: --keep saves them"
            )

    def _obey(self, time: float, book: IncidentBook) -> None:
        """Carry out the orders that have come."""
        orders = self._settings.orders
        while orders is not None and not orders.empty():
            self._carry_out(orders.get(), time, book)

    def _carry_out(self, order: Order, time: float, book: IncidentBook) -> None:
        """Carry out an order, and note what was done or why not."""
        if order.problem:
            self._note(order.problem)
            return
        is_open = {id(incident) for incident in book.open_at(time)}
        numbers = [number for number, each in self._numbers.items() if id(each) in is_open]
        if order.incident is not None:
            numbers = [number for number in numbers if number == order.incident]
        if not numbers:
            which = "no incident is open"
            if order.incident is not None:
                which = f"incident {order.incident} is not open"
            self._note(f"{order.kind}: {which}")
            return
        number = numbers[-1]
        if order.kind == ACKNOWLEDGE:
            self._note(self._acknowledged(number, time))
            return
        self._numbers[number].snooze(time, order.seconds)
        self._note(f"incident {number} ({self._name(number)}) is snoozed for {order.seconds:g} s")

    def _acknowledge_steady(self, number: int, time: float, book: IncidentBook) -> None:
        """Acknowledge an incident of a channel that the settings name, once it is steady."""
        incident = self._numbers[number]
        names = self._settings.acknowledges
        is_named = ALL in names or self._name(number) in names
        is_open = any(each is incident for each in book.open_at(time))
        self._waiting.pop(number)
        if not is_named or not is_open or incident.column is None:
            return
        result = self._acknowledged(number, time)
        if incident.snoozed is None:  # not steady yet
            self._waiting[number] = time + RETRY_S
            self._say_once(result)
            return
        self._note(result)

    def _acknowledged(self, number: int, time: float) -> str:
        """Learn the level shift of an incident; return what was done, or why not."""
        incident = self._numbers[number]
        try:
            if incident.column is None:
                raise ValueError("it points to no channel")
            shift = self._guard.acknowledge(column=incident.column)
        except ValueError as error:
            return f"incident {number} ({self._name(number)}) is not acknowledged: {error}"
        incident.acknowledge(time)
        if self._following is not None:
            self._following.confirm()
        self._is_kept = False
        keep = self._settings.keep
        if keep is not None:
            self._is_kept = self._try("the memory is not kept", lambda: self._guard.keep(keep))
        return f"incident {number} is acknowledged: {shift} from now on"

    def _name(self, number: int) -> str:
        """Return the channel or the reason of an incident."""
        incident = self._numbers[number]
        if incident.column is None:
            return incident.reason
        return self._names[incident.column]

    def _set_threshold(self) -> None:
        """Judge the rows that follow by the threshold as it is now."""
        if self._following is not None:
            self._guard.table.records["threshold"] = self._following.value

    def _try(self, problem: str, act: Callable[[], object]) -> bool:
        """Return whether something could be written; note, once, why not."""
        try:
            act()
        except (OSError, ValueError) as error:
            self._say_once(f"{problem}: {error}")
            return False
        return True

    def _say_once(self, problem: str) -> None:
        """Note a problem, once."""
        if problem not in self._said:
            self._said.add(problem)
            self._note(problem)
