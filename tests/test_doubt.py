"""Crashes among healthy episodes: which they are, and what calibrate says where they have raised the threshold."""

import logging
import re

import numpy as np
import pytest

from asm_gym import Channel, Episode, StreamSpec, harmless, make_monitor
from asm_gym.data.crashes import crashes, peak_torques
from asm_gym.episode import EpisodeLabel

SPEC = StreamSpec((Channel("joint", 2, "rad"), Channel("external_torque", 2, "N m")), dt=0.05)
ROWS = 40


def episode(seed: int, hit: float = 0.0, force: float | None = None, task: str = "") -> Episode:
    """Two joints that wander, and torques of about 1 N m; at ``hit`` both are struck."""
    rng = np.random.default_rng(seed)
    stream = np.hstack([np.cumsum(rng.normal(size=(ROWS, 2)), axis=0), rng.normal(size=(ROWS, 2)).clip(-2, 2)])
    stream[ROWS // 2 :, 2:] += hit
    felt = {} if force is None else {"contact_force": np.full(ROWS, force, np.float32)}
    return Episode.from_stream(stream, SPEC, label=EpisodeLabel(task, "nominal") if task else None, **felt)


@pytest.fixture(scope="module")
def monitor():
    return make_monitor("kalman", SPEC).fit([episode(n) for n in range(20)])


CALM = [episode(100 + n) for n in range(40)]


def test_what_presses_twice_as_hard_as_usual_is_a_crash_in_its_own_task():
    light, heavy = [episode(n, force=10, task="Lift") for n in range(5)], [episode(9, force=50, task="Nut")] * 5
    hit = episode(7, force=45, task="Lift")
    tasks = [e.labelled.task for e in [*light, *heavy, hit]]
    assert crashes([*light, *heavy, hit], tasks) == {10: pytest.approx(4.5)}
    assert crashes([*CALM, episode(3, hit=30.0)], [""] * 41).keys() == {40}
    assert crashes(CALM, [""] * 40) == {}


def test_torques_within_rows_tell_where_they_are_sensed_and_nothing_where_none_are():
    peaks = StreamSpec((Channel("external_torque", 1), Channel("external_torque_peak", 1)), dt=0.05)
    np.testing.assert_array_equal(
        peak_torques(Episode.from_stream(np.array([[1.0, -3.0], [2.0, 2.5]]), peaks)), [3, 2.5]
    )
    np.testing.assert_array_equal(peak_torques(CALM[0]), np.abs(CALM[0].stream[:, 2:]).max(axis=1))
    blind = StreamSpec((Channel("joint", 1),), dt=0.05)
    assert not peak_torques(Episode.from_stream(np.ones((3, 1)), blind)).any()


@pytest.mark.parametrize("asked", [{"false_alarm_rate": 0.05}, {"false_alarms_per_hour": 60.0}])
def test_a_threshold_that_a_crash_has_set_is_doubted_and_the_episode_named(monitor, caplog, asked):
    crashed = [*CALM[:30], episode(207, hit=40.0), *CALM[30:], episode(208, hit=30.0)]
    with caplog.at_level(logging.WARNING):
        high = monitor.calibrate(crashed, **asked).threshold
    (said,) = (r.getMessage() for r in caplog.records)
    assert "2 of 42 episodes press more than 2 times as hard as is usual" in said
    assert re.search(r"The worst is episode 30, \d.* asm_gym.harmless\(episodes\) does", said)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        low = monitor.calibrate(harmless(crashed), **asked).threshold  # what it says to do
    assert not caplog.records
    assert high > 1.5 * low
    assert f"with them the threshold is {high:.3g}, without " in said


def test_few_calm_episodes_are_compared_with_the_worst_of_them_and_a_crash_that_changes_nothing_is_not_said(
    monitor, caplog
):
    with caplog.at_level(logging.WARNING):
        monitor.calibrate([*CALM[:18], episode(207, hit=40.0)], 0.05)  # 19, of which 18 promise no 5 %
        assert len(caplog.records) == 1
        monitor.calibrate([*CALM, episode(207, hit=40.0)], 0.1)  # the worst of 41 is beyond what 10 % allow
    assert len(caplog.records) == 1
