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

from asm_gym.data.episode import Episode
from asm_gym.data.live_rows import RowReader
from asm_gym.data.live_sources import SourceDied, lines_from
from asm_gym.data.schema import LogSchema
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
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

    def start(
        name: str, message: Callable[[int], object], seconds: float = 5.0, quality: object = None
    ) -> None:
        participant = domain.DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        writer = pub.DataWriter(
            participant, topic.Topic(participant, f"rt{name}", type(message(0))), qos=quality
        )

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
    return JointState(
        Header(Time(int(stamp), round(1e9 * (stamp % 1))), ""), NAMES, numbers, numbers, []
    )


def lines(topics: str = "/joint_states", silence: float = 0.5) -> Iterator[str]:
    return lines_from(f"dds:{topics}", io.StringIO(), silence)


def test_joints_are_read_by_the_names_that_a_bag_gives_them(publish):
    publish("/joint_states", joints)
    rows = [json.loads(line) for _, line in zip(range(20), lines(), strict=False)]
    kinds = ("position", "velocity")
    assert set(rows[0]) == {
        "time",
        *(f"joint_states.{kind}[{name}]" for kind in kinds for name in NAMES),
    }
    np.testing.assert_allclose(np.diff([row["time"] for row in rows]), 1 / RATE, rtol=1e-4)
    for row in rows:
        k = round((row["time"] - 1000) * RATE)
        assert (row["joint_states.position[shoulder]"], row["joint_states.velocity[elbow]"]) == (
            k,
            -k,
        )


def test_a_row_holds_the_newest_of_other_topics_and_nothing_of_one_that_fell_silent(publish):
    publish("/joint_states", joints, 4.0)
    publish(
        "/gripper", lambda k: JointState(Header(Time(0, 0), ""), ["finger"], [7.0], [], []), 1.0
    )
    found = lines("/joint_states,/gripper")
    until, held = time.monotonic() + 3.0, []
    while time.monotonic() < until:
        held.append(json.loads(next(found)).get("gripper.position[finger]"))
    assert 7.0 in held
    assert held[-1] is None


def test_publishers_of_other_joints_on_one_topic_make_one_row(publish):
    def finger(k: int) -> JointState:
        # two velocities are whose?
        return JointState(Header(Time(0, 0), ""), ["finger"], [7.0], [1.0, 2.0], [])

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
    monkeypatch.setattr("asm_gym.data.dds_topics.CONNECT_S", 1.0)
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
            tuple(
                Channel(f"joint_states.{kind}", 2, elements=tuple(NAMES))
                for kind in ("position", "velocity")
            ),
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
    publish(
        "/joint_states", shuffled, quality=core.Qos(reliable, core.Policy.Durability.TransientLocal)
    )
    reader = RowReader(LogSchema.of_spec(spec))
    rows = [row for (row, _), _ in zip(reader.rows(lines()), range(80), strict=False)]
    read = [row for row in rows if row.read]
    assert all(row.numbers[0] == -row.numbers[1] == row.numbers[2] for row in read)
    steps = np.diff([row.numbers[0] for row in read])
    assert (steps == 1 + np.array([row.lost for row in read[1:]])).all()
    assert sum(not row.read for row in rows) in (1, 2)  # late, and sent twice


def test_alarms_are_published_on_a_topic_and_who_joins_late_gets_the_last_one(
    tmp_path, monkeypatch, capsys
):
    core, sub = needs("cyclonedds.core"), needs("cyclonedds.sub")
    rng = np.random.default_rng(0)
    spec = StreamSpec((Channel("q", 2, noise=1e-3),), 0.01)
    rows = np.sin(np.arange(300)[:, None] / [20, 30]) + 1e-3 * rng.normal(size=(40, 300, 2))
    episodes = [Episode.from_stream(each, spec) for each in rows.astype(np.float32)]
    monitor = (
        make_monitor("kalman", spec)
        .fit(episodes[:20])
        .calibrate(episodes[20:], false_alarm_rate=0.05)
    )
    monitor.save(tmp_path / "m.asm")
    live = rows[0].copy()
    live[100:, 0] += 1.0
    participant = domain.DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    alarms = topic.Topic(participant, "rt/asm_gym/alarms", Text)
    kept = core.Policy.Durability.TransientLocal, core.Policy.Reliability.Reliable(1_000_000_000)
    listener = sub.DataReader(participant, alarms)  # as ROS makes one by default
    found = []

    def read(reader: object) -> list[str]:
        return [sample.data for sample in reader.take(N=100) if hasattr(sample, "data")]

    def lines() -> Iterator[str]:
        for row in live:
            yield json.dumps(row.tolist())
        late, until = sub.DataReader(participant, alarms, qos=core.Qos(*kept)), time.monotonic() + 5
        while not (found and found[0] and found[1]) and time.monotonic() < until:
            time.sleep(0.02)
            found[:] = [
                [*before, *new]
                for before, new in zip(found or ([], []), (read(listener), read(late)), strict=True)
            ]

    monkeypatch.setattr("asm_gym.scripts.watch.lines_from", lambda *_: lines())
    assert (
        main(
            [
                "watch",
                "-",
                "--monitor",
                str(tmp_path / "m.asm"),
                "--topic",
                "/asm_gym/alarms",
                "--json",
            ]
        )
        == 1
    )
    printed = [line for line in capsys.readouterr().out.splitlines() if '"kind": "alarm"' in line]
    assert [json.loads(text) for text in found[1]] == [json.loads(printed[-1])]
    assert json.loads(found[0][-1])["kind"] == "alarm"
    assert json.loads(printed[0])["channel"] == "q[0]"
    assert (
        main(["watch", str(tmp_path), "--monitor", str(tmp_path / "m.asm"), "--topic", "/a"]) == 2
    )
    assert "--topic is for a live source" in capsys.readouterr().err
