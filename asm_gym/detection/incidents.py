"""Incidents: one cause counts once. Live watch, reports, counts by the hour and promises go by this definition.

    strength    r_i = (a_i s^(p-1))^(1/p) / q      of channel i, in thresholds; (Σ r_i^p)^(1/p) = s/q
    opens       row in alarm, and no incident of a minute before explains it
    explains    (Σ r_i^p)^(1/p) <= max(1, 2 m) over the channels i of no open incident;
                or what blame points to are channels of open incidents alone
    ends        a minute without a row of its own; of a snoozed one, when that time is over

s is surprise, q its threshold, a_i the share of channel i, and p how the detection pools. A row in ``SETTLING_S`` from
an incident's start adds its channels to it; m is the greatest strength in channels that were added, or elsewhere in
``SPREADING_S``, so that a fault which spreads is one incident, and a fault elsewhere opens another at once. A large
error grows with what the robot does, and so does its share in what is predicted from it: blame tells it from a fault
elsewhere, and m grows to it.

Of rows with missing or other broken numbers, each reason is a cause, and its channels are those numbers. Surprise in
the rows that follow comes from the gap and belongs to it. The sign of an incident is noted and divides none: the error
of a channel that moves changes its sign all the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.alarm_reasons import SURPRISING, reason
from asm_gym.detection.alarm_rule import MINUTE, alarms_in, rows_over

Floats = NDArray[np.float64]
Numbers = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
SharesOf = Callable[[int], Numbers]
Blamed = tuple[int, ...]  # columns that explain a row together, the likeliest first

SETTLING_S = 2.0  # in which an incident spreads over the channels it touches [s]
SPREADING_S = 20.0  # in which its strength elsewhere is learned: about a round of work [s]
SPREAD = 2.0  # a channel of no incident may be as strong as this times those that were added
FADING_S = 10.0  # in which surprise fades once the cause is acknowledged [s]
TOUCHED = 0.5  # least strength of a channel that an incident touches, in thresholds


@dataclass(eq=False, slots=True)
class Incident:
    """An alarm with all that has the same cause."""

    reason: str  # of ``asm_gym.data.alarm_reasons``
    column: int | None  # that its first row points to; None where a whole row was missing
    start: float  # of its first row [s]
    last: float  # of its last row up to now [s]
    known: Mask  # (D,) its channels
    excess: float  # greatest surprise, in thresholds
    spread: float = 0.0  # m
    settled: float = 0.0  # until then it spreads [s]
    gap: float = -math.inf  # its latest row with numbers that are missing or not finite [s]
    snoozed: float | None = None  # until then it stays open, whatever comes [s]
    blamed: Blamed = ()  # by its first row, or the strongest channel; empty of missing numbers

    def is_open(self, time: float) -> bool:
        """Return whether a row at this time [s] may still belong to it."""
        if self.snoozed is not None:
            return time <= self.snoozed
        return time - self.last <= MINUTE

    def settles(self, time: float) -> bool:
        """Return whether it still spreads at this time [s]."""
        return time <= self.settled

    def snooze(self, time: float, seconds: float) -> None:
        """Keep it open, and so silent, for so many seconds from a time [s] on."""
        self.snoozed = time + seconds

    def acknowledge(self, time: float) -> None:
        """Take what follows at once as its end; after that, the same cause opens another."""
        self.settled = time + SETTLING_S
        self.snoozed = time + FADING_S

    def add_channels(self, strengths: Floats, known: Mask) -> None:
        """Add the channels of a row, of these strengths (D,), but for those that are ``known`` (D,)."""
        self.known |= (strengths > TOUCHED) & ~known
        others = self.known.copy()
        if self.column is not None:
            others[self.column] = False
        if others.any():
            self.spread = max(self.spread, float(strengths[others].max()))


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """A row in alarm."""

    time: float  # [s]
    numbers: Numbers  # (D,) as they were sensed
    shares: Floats  # (D,) of its surprise
    surprise: float
    threshold: float
    follows: bool = False  # the row before was in alarm too
    blame: Callable[[], Blamed] | None = None  # asked where it matters, as it takes milliseconds

    @property
    def excess(self) -> float:
        """Surprise, in thresholds."""
        return float(self.surprise / self.threshold)

    def blamed(self) -> Blamed:
        """Return what blame points to; empty where it cannot be asked."""
        if self.blame is None:
            return ()
        return self.blame()


class IncidentBook:
    """Assign rows in alarm to incidents.

    Args:
        power: p, how the detection pools its channels; 1 for a sum.
    """

    def __init__(self, power: float = 1.0) -> None:
        self._power = power
        self._open: list[Incident] = []
        self._is_after_gap = False  # every row in alarm since a gap has followed another

    def open_at(self, time: float) -> list[Incident]:
        """Return the incidents that are open at this time [s]."""
        self._open = [incident for incident in self._open if incident.is_open(time)]
        return self._open

    def end_all(self) -> None:
        """End all incidents: whatever comes next opens another."""
        self._open = []

    def follow(self, row: AlarmRow) -> Incident | None:
        """Take up a row in alarm; return the incident that it opens, None where it belongs to one."""
        why = reason(row.numbers)
        if why != SURPRISING:
            return self._follow_broken(row, why)
        if self._belongs_to_gap(row):
            return None

        surprising = [i for i in self.open_at(row.time) if i.reason == SURPRISING]
        strengths = strengths_of(row, self._power)
        if not surprising:
            return self._open_first(row, strengths)
        return self._follow_others(surprising, row, strengths)

    def _follow_others(
        self, surprising: list[Incident], row: AlarmRow, strengths: Floats
    ) -> Incident | None:
        """Take up a row of these strengths (D,) while such incidents are open."""
        known = np.logical_or.reduce([i.known for i in surprising])
        settling = [i for i in surprising if i.settles(row.time)]
        rest = np.where(known, 0.0, strengths)
        owner = max(surprising, key=lambda i: self._strength_in(i, strengths))
        allowed = max(1.0, *(SPREAD * i.spread for i in surprising))
        if not settling and pooled(rest, self._power) > allowed:
            opened = self._open_elsewhere(row, rest, known)
            if opened is not None:
                return opened
            owner.spread = float(rest.max())
        elif row.time <= owner.start + SPREADING_S:
            owner.spread = max(owner.spread, float(rest.max()))

        if settling:
            settling[-1].add_channels(strengths, known)
        self._prolong(surprising, owner, row, strengths)
        return None

    def note(self, why: str, time: float) -> Incident | None:
        """Take up what is wrong with no channel, such as a line that cannot be read, as ``follow`` does a row."""
        for incident in self.open_at(time):
            if incident.reason == why:
                incident.last = time
                return None
        return self._add(why, None, time, np.zeros(0, np.bool_), math.inf)

    def _belongs_to_gap(self, row: AlarmRow) -> bool:
        """Return whether the surprise of a row comes from a gap shortly before; keep that for the next row."""
        gaps = [i for i in self.open_at(row.time) if row.time - i.gap <= SETTLING_S]
        self._is_after_gap = self._is_after_gap and row.follows and bool(gaps)
        return self._is_after_gap

    def _follow_broken(self, row: AlarmRow, why: str) -> Incident | None:
        """Take up a row with numbers that are missing or not finite."""
        self._is_after_gap = True
        broken = ~np.isfinite(row.numbers)
        same = [i for i in self.open_at(row.time) if i.reason == why]
        for incident in same:
            if (broken & incident.known).any() or incident.settles(row.time):
                incident.last = row.time
                incident.gap = row.time
        if any(i.settles(row.time) for i in same):
            same[-1].known |= broken
            return None

        new = broken.copy()
        for incident in same:
            new &= ~incident.known
        if same and not new.any():
            return None
        column = None
        if not new.all():
            column = int(np.argmax(new))
        opened = self._open_by(row, why, column, new)
        opened.gap = row.time
        return opened

    def _open_first(self, row: AlarmRow, strengths: Floats) -> Incident:
        """Open an incident by a row of these strengths (D,), where no other surprises."""
        columns = row.blamed() or (int(np.argmax(strengths)),)
        opened = self._open_by(row, SURPRISING, columns[0], strengths > TOUCHED)
        opened.blamed = columns
        return opened

    def _open_elsewhere(self, row: AlarmRow, rest: Floats, known: Mask) -> Incident | None:
        """Open an incident by the strengths (D,) of a row that are in none of the ``known`` channels (D,).

        None where blame points to known channels alone, whose error spreads.
        """
        columns = row.blamed()
        if columns and known[list(columns)].all():
            return None
        touched = (rest > TOUCHED) | (rest == rest.max())
        new = tuple(column for column in columns if not known[column])
        if not new:
            new = (int(np.argmax(rest)),)
        opened = self._open_by(row, SURPRISING, new[0], touched)
        opened.blamed = new
        return opened

    def _prolong(
        self, incidents: list[Incident], owner: Incident, row: AlarmRow, strengths: Floats
    ) -> None:
        """Add a row of these strengths (D,) to its owner, and to each incident strong enough by itself."""
        for incident in incidents:
            strength = self._strength_in(incident, strengths)
            if incident is owner or strength > 1.0:
                incident.last = row.time
                incident.excess = max(incident.excess, min(strength, row.excess))

    def _strength_in(self, incident: Incident, strengths: Floats) -> float:
        """Return the pooled strength of a row in the channels of an incident."""
        return pooled(strengths[incident.known], self._power)

    def _open_by(self, row: AlarmRow, why: str, column: int | None, known: Mask) -> Incident:
        """Open an incident by its first row."""
        if column is not None:
            known[column] = True
        return self._add(why, column, row.time, known, row.excess)

    def _add(
        self, why: str, column: int | None, time: float, known: Mask, excess: float
    ) -> Incident:
        """Keep a new incident."""
        incident = Incident(
            reason=why,
            column=column,
            start=time,
            last=time,
            known=known,
            excess=excess,
            settled=time + SETTLING_S,
        )
        self._open.append(incident)
        return incident


def strengths_of(row: AlarmRow, power: float) -> Floats:
    """Return r (D,) of a row in alarm."""
    shares = np.maximum(np.nan_to_num(row.shares, nan=0.0), 0.0)
    if not math.isfinite(row.surprise):
        return np.where(np.isfinite(shares), 0.0, np.inf)
    strengths: Floats = (shares / row.surprise) ** (1.0 / power) * (row.surprise / row.threshold)
    return strengths


def pooled(strengths: Floats, power: float) -> float:
    """Return (Σ r_i^p)^(1/p); 0 of none."""
    greatest = float(strengths.max(initial=0.0))
    if not 0.0 < greatest < math.inf:
        return greatest
    return greatest * float(((strengths / greatest) ** power).sum()) ** (1.0 / power)


def power_of(monitor: object) -> float:
    """Return p of a monitor's detection."""
    return float(getattr(getattr(monitor, "detection", None), "power", 1.0))


def rows_of_alarm(
    surprise: Numbers,
    shares_of: SharesOf,
    stream: Numbers | None,
    threshold: float,
    dt: float,
    blame_of: Callable[[int], Blamed] | None = None,
) -> Iterator[AlarmRow]:
    """Yield the rows in alarm of an episode.

    Args:
        surprise: (T,).
        shares_of: returns the shares (D,) of the numbers of a row in its surprise, by the index of the row.
        stream: (T, D) as it was sensed. Without it, numbers whose shares are not finite are missing.
        threshold: of surprise.
        dt: period of the rows [s].
        blame_of: returns what blame points to in a row, by its index; None where it cannot be asked.
    """
    over = rows_over(surprise, threshold)
    for index in np.flatnonzero(over).tolist():
        shares = np.asarray(shares_of(index), np.float64)
        blame = None
        if blame_of is not None:
            blame = partial(blame_of, index)
        if stream is None:
            numbers: Numbers = np.where(np.isfinite(shares), 0.0, np.nan)
        else:
            numbers = stream[index]
        yield AlarmRow(
            time=float((index + 1) * dt),
            numbers=numbers,
            shares=shares,
            surprise=float(surprise[index]),
            threshold=threshold,
            follows=bool(index and over[index - 1]),
            blame=blame,
        )


def incidents_in(
    surprise: Numbers,
    threshold: float,
    dt: float,
    shares_of: SharesOf | None = None,
    power: float = 1.0,
) -> int:
    """Count the incidents in the surprise (T,) of an episode.

    Args:
        surprise: (T,).
        threshold: of surprise.
        dt: period of the rows [s].
        shares_of: as for ``rows_of_alarm``; None where shares are not kept, and all is one cause.
        power: p of the detection.
    """
    if shares_of is None:
        return alarms_in(surprise, threshold, dt)
    book = IncidentBook(power)
    rows = rows_of_alarm(surprise, shares_of, None, threshold, dt)
    return sum(book.follow(row) is not None for row in rows)
