"""Calibration by the hour: which episodes are refused, and that the promise is saved with the memory."""

from __future__ import annotations

import re

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import CalibratedMonitor, load_monitor, make_monitor
from asm_gym.monitors.training_data import KEPT, STRETCH, check_fresh, marks, sketch
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("sense", 3, group="a"), Channel("action", 2, group=MOTOR)), dt=0.05)


def episode(seed: int, steps: int = 120) -> Episode:
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(size=(steps, 5)), axis=0)
    return Episode.from_stream(course + rng.normal(size=(steps, 5)), SPEC)


def part(whole: Episode, begin: int, end: int) -> Episode:
    return Episode.from_stream(whole.stream[begin:end], SPEC)


def test_a_mark_is_of_a_stretch_wherever_it_stands():
    whole = episode(0)
    found = marks(whole)
    assert len(found) == 120 - STRETCH + 1 == len(set(found))
    np.testing.assert_array_equal(marks(part(whole, 30, 90)), found[30 : 90 - STRETCH + 1])
    assert not set(marks(episode(1))) & set(found)
    assert (found == np.floor(found)).all()
    assert found.max() < 2**52  # so a double holds it


def test_a_robot_that_stands_still_is_not_told_apart():
    assert not len(marks(Episode.from_stream(np.ones((100, 5)), SPEC)))
    still = np.concatenate([np.ones((60, 5)), episode(0).stream])
    check_fresh([Episode.from_stream(still, SPEC), Episode.from_stream(still[:60], SPEC)])
    assert not len(marks(episode(0, STRETCH - 1)))


@pytest.mark.parametrize("other", [slice(0, 120), slice(60, 100), slice(100, 120)])
def test_episodes_that_overlap_are_refused_by_number(other):
    whole = episode(0)
    twin = np.concatenate([episode(9).stream, whole.stream[other]])
    with pytest.raises(ValueError, match=r"^episodes 1 and 3 overlap, 20 rows or more are the same"):
        check_fresh([episode(5), whole, episode(6), Episode.from_stream(twin, SPEC)])
    check_fresh([whole, Episode.from_stream(whole.stream[other][: STRETCH - 1], SPEC)])


def test_what_was_learned_from_is_known_however_it_is_cut():
    lessons = [episode(n) for n in range(10)]
    kept = sketch(lessons)
    assert len(kept) == 10 * KEPT
    joined = Episode.from_stream(np.concatenate([e.stream for e in lessons[3:5]]), SPEC)
    for again in (lessons[3], joined):
        with pytest.raises(ValueError, match=r"^episode 1 was learned from"):
            check_fresh([episode(77), again], kept)
    check_fresh([episode(n) for n in range(20, 30)], kept)


@pytest.fixture(scope="module")
def monitor() -> CalibratedMonitor:
    return make_monitor("association_linear+evidence", SPEC).fit([episode(n) for n in range(30)])


NOMINAL = [episode(1000 + n, 600) for n in range(120)]  # one hour
HOUR = 120 * 600 * SPEC.dt / 3600


def test_a_promise_by_the_hour_is_kept_saved_and_loaded(monitor, tmp_path):
    asm = monitor.calibrate(NOMINAL, false_alarms_per_hour=3.0)
    assert HOUR == 1.0
    maxima = np.sort([s.value.max() for s in asm.score_episodes(NOMINAL)])
    assert asm.threshold == maxima[-3]  # two may exceed it: 2 + 1 <= 3 * 1 h
    assert asm.promise[:2] == (120, pytest.approx(3.0))
    assert asm.promise.at_most == pytest.approx(6.2, abs=0.2)  # of a Gamma(3), and 120 blocks
    assert (asm.promise.per, asm.promise.hours) == ("hour", pytest.approx(1.0))
    asm.save(tmp_path / "by_hour.asm")
    again = load_monitor(tmp_path / "by_hour.asm")
    assert (again.threshold, again.promise) == (asm.threshold, asm.promise)
    assert again.threshold_at(false_alarms_per_hour=1.0) == maxima[-1]
    assert again.threshold_at(0.05) == asm.threshold_at(false_alarm_rate=0.05)
    assert monitor.calibrate(NOMINAL, 0.05).promise.per == "episode"


def test_fresh_hours_alarm_as_often_as_was_promised(monitor):
    """Of 20 calibrations, each with 10 fresh hours: what was promised lies inside the interval of all that alarmed."""
    from asm_gym.detection import Blocks, hourly_threshold
    from asm_gym.evaluation.statistics import Rate

    rng = np.random.default_rng(5)
    surprise = [s.value for s in monitor.score_episodes([episode(9000 + n, 600) for n in range(240)])]
    alarms = 0
    for _ in range(200):  # halves of two hours: one sets the threshold for the other
        order = rng.permutation(240)
        own, other = ([surprise[i] for i in half] for half in (order[:120], order[120:]))
        q = hourly_threshold(Blocks.of(own, SPEC.dt), 4.0)
        alarms += sum(v.max() > q for v in other)
    assert 3.0 < Rate(alarms, 200.0).value < 4.6  # 4 an hour: 4/121 of 120, as of exchangeable ones


@pytest.mark.parametrize(
    ("episodes", "asked", "message"),
    [
        (NOMINAL, {}, "which promise: give false_alarm_rate .* or false_alarms_per_hour .*, got neither"),
        (NOMINAL, {"false_alarm_rate": 0.1, "false_alarms_per_hour": 1.0}, "which promise: .* got both"),
        (NOMINAL[:30], {"false_alarms_per_hour": 1.0}, "got 0.25: record 0.75 hours more, or promise 4"),
        (NOMINAL, {"false_alarms_per_hour": -2.0}, r"must be a number in \[1e-06, 1e\+06\], got -2"),
        ([*NOMINAL, NOMINAL[7]], {"false_alarms_per_hour": 1.0}, "episodes 7 and 120 overlap"),
        ([*NOMINAL, episode(3)], {"false_alarms_per_hour": 1.0}, "episode 120 was learned from"),
    ],
)
def test_what_cannot_be_promised_is_refused_in_a_line_and_nothing_changes(monitor, episodes, asked, message):
    monitor.calibrate(NOMINAL, false_alarms_per_hour=2.0)
    before = monitor.threshold, monitor.promise
    with pytest.raises(ValueError, match=message) as refused:
        monitor.calibrate(episodes, **asked)
    assert "\n" not in str(refused.value)
    assert (monitor.threshold, monitor.promise) == before


@pytest.mark.parametrize(
    ("added", "message"),
    [
        (NOMINAL[7], "episodes 7 and 120 overlap.* give each hour once; the"),
        (episode(3), "episode 120 was learned from"),
    ],
)
def test_a_promise_by_the_episode_says_so_and_is_made_all_the_same(monitor, caplog, added, message):
    with caplog.at_level("WARNING"):
        monitor.calibrate([*NOMINAL, added], 0.1)
    assert re.search(f"{message}.* promise by the episode does not hold", caplog.text)
    assert monitor.promise.episodes == 121


def test_a_loaded_memory_still_knows_what_it_learned_from(monitor, tmp_path):
    monitor.calibrate(NOMINAL, 0.1).save(tmp_path / "m.asm")
    with pytest.raises(ValueError, match="episode 0 was learned from"):
        load_monitor(tmp_path / "m.asm").calibrate([episode(3), *NOMINAL], false_alarms_per_hour=1.0)
