"""Causes of a robot's daily life, on a simulated arm at work: each is one incident."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.logs import Log
from asm_gym.evaluation.recorded_alarms import alarms_of, traces_of
from asm_gym.scripts.reproduce import day

pytestmark = pytest.mark.slow  # a memory of an arm is learned

SECONDS = 180.0
ONSET_S = 30.0


@pytest.fixture(scope="module")
def memory():
    return day.learned(day.Config(logs=10, calibration=70))


def work(memory, change=None, sensors=None):
    """Channel and start of each incident in minutes of work, of which something changes at ONSET_S."""
    usual = day.Day.usual(SECONDS)
    if change is not None:
        change(usual, slice(round(ONSET_S / day.CONTROL_PERIOD_S), None))
    rows = day.simulated(usual, seed=5000)
    if sensors is not None:
        sensors(rows, slice(round(ONSET_S / day.SPEC.dt), None))
    episode = Episode.from_stream(rows, day.SPEC)
    (trace,) = traces_of([Log("work", episode)], memory)
    return [(alarm.channel, alarm.start) for alarm in alarms_of(trace)]


def offset(rows: np.ndarray, after: slice) -> None:
    rows[after, day.FORCE] += 0.5


def wider(rows: np.ndarray, after: slice) -> None:
    is_open = rows[after, day.WIDTH] > 0.5 * (day.OPEN + day.CLOSED)
    rows[after, day.WIDTH] += 0.02 * is_open


def wrapped(rows: np.ndarray, after: slice) -> None:
    rows[after, 3] += 2 * np.pi


def slower(changes: day.Day, after: slice) -> None:
    changes.pace[after] = 0.7


def faster(changes: day.Day, after: slice) -> None:
    changes.pace[after] = 1.3


@pytest.mark.parametrize("sensors", [offset, wider, wrapped])
def test_a_sensor_that_changes_for_good_is_one_incident(memory, sensors):
    found = work(memory, sensors=sensors)
    assert len(found) == 1
    assert found[0][1] > ONSET_S


@pytest.mark.parametrize("change", [slower, faster])
def test_another_pace_is_one_incident(memory, change):
    assert len(work(memory, change=change)) == 1


def test_two_causes_are_two_incidents_also_while_the_first_is_open(memory):
    def both(rows, after):
        offset(rows, after)
        wider(rows, slice(after.start + round(60.0 / day.SPEC.dt), None))

    found = work(memory, sensors=both)
    assert [channel for channel, _ in found] == ["force[0]", "width"]
    assert found[1][1] - found[0][1] == pytest.approx(60.0, abs=15.0)
