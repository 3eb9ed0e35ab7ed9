"""Follow topics of ROS 2 over DDS, and publish texts on one. ROS itself is not needed.

    /joint_states      on DDS rt/joint_states, of type sensor_msgs::msg::dds_::JointState_
    a row              a message of the first topic, at the time in its header, with the newest of the others; of
                       several publishers there, one with the most joints
    numbers            named as those of a bag are, joint_states.position[panda_joint1] (``asm_gym.data.bags``)

Source: ROS 2 design, "Topic and Service name mapping to DDS".
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from asm_gym.data.bags import MESSAGES, numbers_of, stamp_of
from asm_gym.data.live_rows import SourceDied
from asm_gym.data.publishers import Publishers
from asm_gym.extras import require

CONNECT_S = 5.0  # how long a topic may take to be found [s]
WAIT_S = 0.05  # how often the end of a topic is looked for while nothing comes [s]
MESSAGES_AT_ONCE = 2048  # messages taken, and kept for the reader, at once: four seconds of 500 Hz

FIELDS = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
    "sensor_msgs/msg/JointState": (
        "std_msgs/msg/Header header, string[] name, "
        "float64[] position, float64[] velocity, float64[] effort"
    ),
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Wrench": "geometry_msgs/msg/Vector3 force, geometry_msgs/msg/Vector3 torque",
    "geometry_msgs/msg/WrenchStamped": (
        "std_msgs/msg/Header header, geometry_msgs/msg/Wrench wrench"
    ),
    "std_msgs/msg/String": "string data",
    "std_msgs/msg/MultiArrayDimension": "string label, uint32 size, uint32 stride",
    "std_msgs/msg/MultiArrayLayout": "std_msgs/msg/MultiArrayDimension[] dim, uint32 data_offset",
    "std_msgs/msg/Float64MultiArray": "std_msgs/msg/MultiArrayLayout layout, float64[] data",
}
"""Fields of the messages, as in their .msg files."""


def _dds(part: str) -> Any:
    return require(f"cyclonedds.{part}", what="a DDS topic")


@cache
def message(name: str) -> Any:
    """Return the IDL type of a message, ``sensor_msgs/msg/JointState``, or of a field, ``float64`` or ``float64[]``."""
    if name == "string":
        return str
    if name.endswith("[]"):
        return _dds("idl.types").sequence[message(name.removesuffix("[]"))]
    if name not in FIELDS:
        return getattr(_dds("idl.types"), name)
    fields = {}
    for line in FIELDS[name].split(", "):
        kind, field = line.split()
        fields[field] = message(kind)
    package, _, last = name.partition("/msg/")
    return _dds("idl").make_idl_struct(last, f"{package}.msg.dds_.{last}_", fields)


def _participant() -> Any:
    """Join the domain of ROS. Raises ValueError where ROS_DOMAIN_ID is no number."""
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not domain.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number, got {domain!r}")
    return _dds("domain").DomainParticipant(int(domain))


def _topic(participant: Any, name: str, kind: str) -> Any:
    return _dds("topic").Topic(participant, f"rt/{name}", message(kind))


def publisher(topic: str) -> Callable[[str], None]:
    """Return what publishes a text on a topic of ROS 2, as std_msgs/msg/String; who joins late gets the last one too.

    Raises ValueError where ROS_DOMAIN_ID is no number.
    """
    core = _dds("core")
    participant = _participant()
    kind = "std_msgs/msg/String"
    quality = core.Qos(
        core.Policy.Reliability.Reliable(0),
        core.Policy.Durability.TransientLocal,
        core.Policy.History.KeepLast(1),
    )
    there = _topic(participant, topic.strip("/"), kind)
    writer = _dds("pub").DataWriter(participant, there, qos=quality)
    return lambda text: writer.write(message(kind)(text))


def follow_topics(topics: str, silence: float) -> Iterator[str]:
    """Yield rows of topics as JSON lines, with their times [s].

    Args:
        topics: ``/joint_states``, or several with commas between; the first one is the clock.
        silence: after so long without a message of the first topic the source has died [s].

    Raises:
        ValueError: no such names, or a topic is of another type, or ROS_DOMAIN_ID is no number.
        OSError: nobody publishes one of them, or no first row came.
        SourceDied: no row came any more.
    """
    names = [name.strip().strip("/") for name in topics.split(",")]
    if not all(names):
        raise ValueError(f"dds takes topics, as in dds:/joint_states, got {topics!r}")
    participant = _participant()
    kinds = {name: _kind(participant, name) for name in names}
    readers = {name: _reader(participant, name, kind) for name, kind in kinds.items()}
    publishers = Publishers(silence)
    has_row = False
    for name, sample in _samples(participant, readers, silence):
        numbers = numbers_of(kinds[name], name, sample)
        joints = [f"{name}.{joint}" for joint in getattr(sample, "name", ())]
        row = publishers.row(
            message=numbers,
            numbers=joints or [name],
            now=time.monotonic(),
            leads=name == names[0],
        )
        if row is not None:
            has_row = True
            seconds = stamp_of(sample) or 1e-9 * sample.sample_info.source_timestamp
            yield json.dumps({"time": seconds} | row)
    if not has_row:
        raise OSError(f"no row came from {topics} for {silence:g} s")
    raise SourceDied(f"nothing came for {silence:g} s")


def _kind(participant: Any, name: str) -> str:
    """The type of message that somebody publishes on a topic."""
    builtin = _dds("builtin")
    reader = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsPublication)
    topic = f"rt/{name}"
    types: dict[str, str] = {}  # by topic
    deadline = time.monotonic() + CONNECT_S
    while topic not in types and time.monotonic() < deadline:
        time.sleep(WAIT_S)
        for publication in reader.take(N=MESSAGES_AT_ONCE):
            if hasattr(publication, "topic_name"):
                types[publication.topic_name] = publication.type_name
    if topic not in types:
        others = [other.removeprefix("rt") for other in sorted(types) if other.startswith("rt/")]
        raise OSError(f"nobody publishes /{name}; there are {', '.join(others) or 'no others'}")
    kind = types[topic].replace("::dds_::", "/").replace("::", "/").removesuffix("_")
    if kind not in MESSAGES:
        readable = ", ".join(MESSAGES)
        raise ValueError(f"/{name} has the type {types[topic]}; readable types: {readable}")
    return kind


def _reader(participant: Any, name: str, kind: str) -> Any:
    policy = _dds("core").Policy
    quality = _dds("core").Qos(
        policy.Reliability.BestEffort,
        policy.History.KeepLast(MESSAGES_AT_ONCE),
    )
    topic = _topic(participant, name, kind)
    return _dds("sub").DataReader(participant, topic, qos=quality)


def _samples(
    participant: Any, readers: dict[str, Any], silence: float
) -> Iterator[tuple[str, Any]]:
    """Yield topics and messages as they come, until the first topic is silent for so long [s]."""
    core = _dds("core")
    clock, *others = readers
    states = core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead
    arrivals = core.WaitSet(participant)
    arrivals.attach(core.ReadCondition(readers[clock], states))
    newest = time.monotonic()
    while time.monotonic() - newest <= silence:
        arrivals.wait(_dds("util").duration(seconds=WAIT_S))
        for name in (*others, clock):
            for sample in readers[name].take(N=MESSAGES_AT_ONCE):
                if not sample.sample_info.valid_data:
                    continue  # it only says that a writer went
                if name == clock:
                    newest = time.monotonic()
                yield name, sample
