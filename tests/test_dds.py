"""Topics of ROS 2 over DDS, published by another process with types of its own."""

from __future__ import annotations

import io
import json
import os

import numpy as np
import pytest
from rich.console import Console

from asm_gym.data.live import SourceDied
from asm_gym.data.sources import lines_from
from asm_gym.scripts.live_watching import follow
from tests import dds_arm as dds
from tests.needs import needs

needs("cyclonedds")


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(100 + os.getpid() % 100))


@pytest.fixture
def publisher():
    made = []

    def start(*options, topic="/joint_states"):
        made.append(dds.publisher(topic, *options))
        return made[-1]

    yield start
    for one in made:
        one.kill()
        one.communicate()


@pytest.fixture(scope="module")
def monitor():
    return dds.fitted("kalman+evidence")


def lines(topics="/joint_states", silence=1.0):
    return lines_from(f"dds:{topics}", io.StringIO(), silence)


def test_joints_are_read_by_the_names_that_a_bag_gives_them(publisher):
    publisher("--seconds", "5", "--clock", "1000")
    rows = [json.loads(line) for _, line in zip(range(20), lines(), strict=False)]
    assert set(rows[0]) == {"time", *dds.episode(0, 0.1).spec.labels}
    steps = np.diff([row["time"] for row in rows])
    np.testing.assert_allclose(steps, 1 / dds.RATE, rtol=1e-4)
    rng = np.random.default_rng(0)
    assert 1000 <= rows[0]["time"] < 1010
    torque = [rows[0][f"joint_states.effort[{n}]"] for n in dds.NAMES]
    q, v = ([rows[0][f"joint_states.{k}[{n}]"] for n in dds.NAMES] for k in ("position", "velocity"))
    weight = 3 * np.sin(q) + 0.5 * np.tanh(np.array(v) / 0.05) + 0.2 * np.array(v)
    assert np.abs(weight - torque).max() < 6 * 0.05  # of one moment; of another one it is off by newton metres
    assert dds.arm(0, rng).shape == (3, 7)


def test_a_fault_is_an_alarm_within_two_rows(monitor):
    found = dds.watched(monitor, "/joint_states", 8.0, 3.0)
    assert found["faults"] == found["found within two rows"] == 2


def test_a_source_that_dies_is_an_alarm_and_is_watched_again_when_it_is_back(publisher, monitor):
    said, second = io.StringIO(), []
    publisher("--seconds", "2")

    def again():
        if not second:  # one, however often it is tried
            second.append(publisher("--seconds", "3"))
        return lines()

    assert follow(lines(), monitor, Console(file=said, width=200), 0.0, again, 8.0) == 1
    out = said.getvalue()
    assert out.count("the source has died, nothing came for 1 s: an alarm") >= 2
    assert "the source is back after" in out
    assert out.index("has died") < out.index("is back")


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (250, "the memory reads 500: they are not judged, an alarm"),
        (1000, "are read at 500, by their clock"),
    ],
)
def test_another_rate_is_said(publisher, monitor, rate, message):
    said = io.StringIO()
    publisher("--seconds", "3", "--rate", str(rate))
    follow(lines(), monitor, Console(file=said, width=200))
    assert message in said.getvalue()


def test_a_topic_of_another_type_or_that_nobody_publishes_is_one_line(publisher):
    publisher("--text", "--seconds", "20", topic="/speech")
    with pytest.raises(ValueError, match=r"/speech is of std_msgs::msg::dds_::String_; read are sensor_msgs"):
        next(lines("/speech"))
    with pytest.raises(OSError, match=r"nobody publishes /joint_states; there are /speech"):
        next(lines())
    with pytest.raises(ValueError, match="dds takes topics"):
        next(lines(""))


def test_a_topic_that_falls_silent_has_died(publisher):
    publisher("--seconds", "1")
    with pytest.raises(SourceDied, match="nothing came for 1 s"):
        list(lines())


def test_a_domain_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID must be a number, got 'seven'"):
        next(lines())
