"""Topics of ROS 2 over DDS, published with types of their own."""

import io
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from asm_gym.data.live import SourceDied, lines_from
from asm_gym.data.rows import RowReader
from asm_gym.spec import Channel, StreamSpec
from tests.needs import needs

domain, pub, topic = (needs(f"cyclonedds.{part}") for part in ("domain", "pub", "topic"))
idl, types = needs("cyclonedds.idl"), needs("cyclonedds.idl.types")

NAMES = ["shoulder", "elbow"]
RATE = 200.0


@dataclass
class Time(idl.IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(idl.IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class JointState(idl.IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    header: Header
    name: types.sequence[str]
    position: types.sequence[types.float64]
    velocity: types.sequence[types.float64]
    effort: types.sequence[types.float64]


@dataclass
class Text(idl.IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(100 + os.getpid() % 100))


@pytest.fixture
def publish() -> Iterator[Callable[..., None]]:
    """Publishes messages on a topic at 200 Hz, for so many seconds, in a thread."""
    over, threads = threading.Event(), []

    def start(name: str, message: Callable[[int], object], seconds: float = 5.0, quality: object = None) -> None:
        participant = domain.DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        writer = pub.DataWriter(participant, topic.Topic(participant, f"rt{name}", type(message(0))), qos=quality)

        def run() -> None:
            for k in range(int(seconds * RATE)):
                writer.write(message(k))
                if over.wait(1 / RATE):
                    return

        threads.append(threading.Thread(target=run))
        threads[-1].start()

    yield start
    over.set()
    for thread in threads:
        thread.join()


def joints(k: int) -> JointState:
    stamp = 1000 + k / RATE
    numbers = [float(k), float(-k)]
    return JointState(Header(Time(int(stamp), round(1e9 * (stamp % 1))), ""), NAMES, numbers, numbers, [])


def lines(topics: str = "/joint_states", silence: float = 0.5) -> Iterator[str]:
    return lines_from(f"dds:{topics}", io.StringIO(), silence)


def test_joints_are_read_by_the_names_that_a_bag_gives_them(publish):
    publish("/joint_states", joints)
    rows = [json.loads(line) for _, line in zip(range(20), lines(), strict=False)]
    kinds = ("position", "velocity")
    assert set(rows[0]) == {"time", *(f"joint_states.{kind}[{name}]" for kind in kinds for name in NAMES)}
    np.testing.assert_allclose(np.diff([row["time"] for row in rows]), 1 / RATE, rtol=1e-4)
    for row in rows:
        k = round((row["time"] - 1000) * RATE)
        assert (row["joint_states.position[shoulder]"], row["joint_states.velocity[elbow]"]) == (k, -k)


def test_a_row_holds_the_newest_of_other_topics_and_nothing_of_one_that_fell_silent(publish):
    publish("/joint_states", joints, 4.0)
    publish("/gripper", lambda k: JointState(Header(Time(0, 0), ""), ["finger"], [7.0], [], []), 1.0)
    found = lines("/joint_states,/gripper")
    until, held = time.monotonic() + 3.0, []
    while time.monotonic() < until:
        held.append(json.loads(next(found)).get("gripper.position[finger]"))
    assert 7.0 in held
    assert held[-1] is None


def test_publishers_of_other_joints_on_one_topic_make_one_row(publish):
    def finger(k: int) -> JointState:
        return JointState(Header(Time(0, 0), ""), ["finger"], [7.0], [1.0, 2.0], [])  # two velocities are whose?

    publish("/joint_states", finger)
    publish("/joint_states", joints)
    found = lines()
    rows = [json.loads(next(found)) for _ in range(80)][30:]
    np.testing.assert_allclose(np.diff([row["time"] for row in rows]), 1 / RATE, rtol=1e-4)
    assert {row["joint_states.position[finger]"] for row in rows} == {7.0}
    assert all("joint_states.velocity[finger]" not in row for row in rows)


def test_a_topic_that_falls_silent_has_died(publish):
    publish("/joint_states", joints, 0.5)
    with pytest.raises(SourceDied, match=r"nothing came for 0\.5 s"):
        list(lines())


def test_a_topic_of_another_type_or_that_nobody_publishes_is_one_line(publish, monkeypatch):
    monkeypatch.setattr("asm_gym.data.live.CONNECT_S", 1.0)
    publish("/speech", lambda k: Text("good morning"))
    with pytest.raises(ValueError, match=r"/speech .*std_msgs::msg::dds_::String_.* sensor_msgs"):
        next(lines("/speech"))
    with pytest.raises(OSError, match=r"nobody publishes /joint_states; there are /speech"):
        next(lines())
    with pytest.raises(ValueError, match="dds takes topics"):
        next(lines(""))
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID must be a number, got 'seven'"):
        next(lines())


def test_joints_in_any_order_dropped_and_late_messages_and_another_quality_are_read_right(publish):
    core, spec = (
        needs("cyclonedds.core"),
        StreamSpec(
            tuple(Channel(f"joint_states.{kind}", 2, elements=tuple(NAMES)) for kind in ("position", "velocity")),
            1 / RATE,
        ),
    )

    def shuffled(k: int) -> JointState:
        made = joints(k - 3 if k == 40 else k)  # one comes late
        if k % 2:
            made.name, made.position = made.name[::-1], made.position[::-1]
            made.velocity = made.velocity[::-1]
        return joints(k + 1) if k in (20, 21) else made  # 20 is dropped, 21 sent twice

    reliable = core.Policy.Reliability.Reliable(0)
    publish("/joint_states", shuffled, quality=core.Qos(reliable, core.Policy.Durability.TransientLocal))
    reader = RowReader(spec)
    rows = [row for (row, _), _ in zip(reader.rows(lines()), range(80), strict=False)]
    read = [row for row in rows if row.read]
    assert all(row.numbers[0] == -row.numbers[1] == row.numbers[2] for row in read)
    steps = np.diff([row.numbers[0] for row in read])
    assert (steps == 1 + np.array([row.lost for row in read[1:]])).all()
    assert sum(not row.read for row in rows) in (1, 2)  # late, and sent twice
