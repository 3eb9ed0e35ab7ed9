"""One cause counts once: what belongs to an incident, and what opens another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.detection.alarm_rule import MINUTE, alarms_in
from asm_gym.detection.conformal import Blocks, hourly_threshold
from asm_gym.detection.incidents import AlarmRow, IncidentBook, incidents_in, pooled, strengths_of

SIZE = 6
POWER = 8.0


def row(
    time: float,
    strengths: dict[int, float],
    broken: tuple[int, ...] = (),
    follows: bool = False,
    blamed: tuple[int, ...] = (),
) -> AlarmRow:
    """A row in alarm whose channels have these strengths, in thresholds, at a threshold of 2."""
    r = np.zeros(SIZE)
    for column, strength in strengths.items():
        r[column] = strength
    powers = r**POWER
    surprise = 2.0 * powers.sum() ** (1 / POWER)
    shares = np.zeros(SIZE)
    if surprise > 0:
        shares = surprise * powers / powers.sum()
    numbers = np.zeros(SIZE)
    if broken:
        numbers[list(broken)] = np.nan
        shares = np.where(np.isnan(numbers), np.inf, 0.0)
        surprise = np.inf
    return AlarmRow(time, numbers, shares, float(surprise), 2.0, follows, lambda: blamed)


def opened(*rows: AlarmRow) -> list[tuple[float, int | None, str]]:
    """Start, channel and reason of the incidents of rows."""
    book = IncidentBook(POWER)
    incidents = [book.follow(each) for each in rows]
    return [(i.start, i.column, i.reason) for i in incidents if i is not None]


def test_what_continues_or_returns_within_a_minute_is_one_incident_and_later_another():
    times = [1.0, 1.1, 40.0, 99.9]
    rows = [row(time, {2: 3.0}) for time in times]
    assert opened(*rows) == [(1.0, 2, "surprise")]
    late = 99.9 + MINUTE + 0.1
    assert opened(*rows, row(late, {2: 3.0})) == [(1.0, 2, "surprise"), (late, 2, "surprise")]


def test_another_cause_opens_an_incident_at_once_also_while_the_first_is_open():
    assert opened(
        row(1.0, {2: 5.0}),
        row(10.0, {2: 5.0, 4: 1.2}),
        row(10.1, {2: 5.0, 4: 1.2}),
        row(10.2, {4: 1.2}),
    ) == [(1.0, 2, "surprise"), (10.0, 4, "surprise")]


def test_a_fault_that_spreads_is_one_incident():
    spreading = [row(1.0, {2: 9.0}), row(2.0, {2: 9.0, 3: 4.0}), row(30.0, {5: 7.0})]
    assert opened(*spreading) == [(1.0, 2, "surprise")]
    assert len(opened(*spreading, row(31.0, {5: 9.0}))) == 2  # more than its spread explains


def test_what_blame_explains_by_a_channel_at_fault_is_no_other_cause():
    first = row(1.0, {2: 9.0}, blamed=(2,))
    poisoned = [row(40.0 + n, {2: 500.0, 5: 7.0 + n}, blamed=(2,)) for n in range(3)]
    assert opened(first, *poisoned) == [(1.0, 2, "surprise")]
    other = row(50.0, {2: 500.0, 4: 30.0, 5: 40.0}, blamed=(2, 4))
    assert opened(first, *poisoned, other) == [(1.0, 2, "surprise"), (50.0, 4, "surprise")]


def test_a_cause_that_shows_elsewhere_in_another_part_of_the_work_is_one_incident():
    work = [row(1.0, {2: 2.0}), row(5.0, {2: 2.0, 5: 0.9}), row(9.0, {2: 2.0, 5: 1.7})]
    assert len(opened(*work, row(60.0, {4: 3.3}))) == 1
    assert len(opened(*work, row(60.0, {4: 3.5}))) == 2
    assert len(opened(*work, row(30.0, {2: 2.0, 5: 3.3}), row(60.0, {4: 3.5}))) == 2


def test_each_channel_that_is_missing_is_a_cause_and_surprise_after_a_gap_is_none():
    gap = row(1.0, {}, broken=(3,))
    after = row(1.1, {0: 4.0}, follows=True)
    assert opened(gap, after, row(20.0, {}, broken=(3,))) == [(1.0, 3, "missing data")]
    assert opened(gap, after, row(1.5, {0: 4.0})) == [
        (1.0, 3, "missing data"),
        (1.5, 0, "surprise"),
    ]
    assert opened(gap, row(20.0, {}, broken=(1, 3))) == [
        (1.0, 3, "missing data"),
        (20.0, 1, "missing data"),
    ]
    assert opened(gap, row(20.0, {0: 4.0})) == [(1.0, 3, "missing data"), (20.0, 0, "surprise")]
    assert opened(row(1.0, {}, broken=tuple(range(SIZE)))) == [(1.0, None, "missing data")]


def test_a_snoozed_incident_is_silent_for_its_time_and_no_other_is():
    book = IncidentBook(POWER)
    first = book.follow(row(1.0, {2: 3.0}))
    assert first is not None
    first.snooze(1.0, seconds=300.0)
    assert book.follow(row(250.0, {2: 3.0})) is None
    other = book.follow(row(251.0, {2: 3.0, 4: 2.0}))
    assert other is not None
    assert other.column == 4
    again = book.follow(row(301.5, {2: 3.0}))
    assert again is not None
    assert again.column == 2


def test_strengths_of_channels_pool_to_the_surprise_in_thresholds():
    each = row(0.0, {0: 1.5, 3: 1.2, 4: 0.3})
    strengths = strengths_of(each, POWER)
    np.testing.assert_allclose(strengths, [1.5, 0, 0, 1.2, 0.3, 0], rtol=1e-9, atol=1e-12)
    assert pooled(strengths, POWER) == pytest.approx(each.surprise / each.threshold)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 0.999))
def test_with_one_channel_an_incident_is_an_alarm_counted_by_the_minute(seed, quantile):
    rng = np.random.default_rng(seed)
    dt = 1.0
    surprise = rng.exponential(size=600) * (rng.random(600) < 0.05)
    threshold = float(np.quantile(surprise, quantile)) + 1e-9
    found = incidents_in(surprise, threshold, dt, shares_of=lambda k: surprise[k : k + 1])
    assert found == alarms_in(surprise, threshold, dt) == incidents_in(surprise, threshold, dt)


def test_a_promise_by_the_hour_counts_two_causes_in_a_minute_as_two():
    dt = 1.0
    minutes = 60 * 4
    surprise = np.full(60 * minutes, 0.1)
    shares = np.zeros((len(surprise), SIZE))
    shares[:, 0] = surprise
    for minute in range(20, 201, 20):  # two causes, ten seconds apart
        for second, column in ((5, 1), (15, 3)):
            row_index = 60 * minute + second
            surprise[row_index] = minute
            shares[row_index] = 0.0
            shares[row_index, column] = minute
    plain = Blocks.of([surprise], dt)

    def count(threshold: float, group: int) -> int:
        return incidents_in(surprise, threshold, dt, shares_of=shares.__getitem__)

    by_incidents = plain.with_incidents(count)
    # of 4 hours, 8 with that of a fresh minute may be above it
    assert hourly_threshold(plain, 2.0) == 60.0
    assert hourly_threshold(by_incidents, 2.0) == 140.0
    assert by_incidents.total == pytest.approx(plain.total)
    restored = Blocks.restored(by_incidents.array)
    np.testing.assert_array_equal(restored.maxima, by_incidents.maxima)
