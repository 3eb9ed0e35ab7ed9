"""Follow ROS 2 topics over DDS, without ROS.

    /joint_states      on DDS rt/joint_states, of type sensor_msgs::msg::dds_::JointState_
    a row              a message of the first topic, at the time in its header, with the newest of the others
    numbers            named as those of a bag are, joint_states.position[panda_joint1] (``asm_gym.data.bags``)

Source: ROS 2 design, "Topic and Service name mapping to DDS".
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

from asm_gym.data.bags import MESSAGES, Numbers, stamp_of
from asm_gym.data.rows import SourceDied
from asm_gym.extras import require

CONNECT_S = 5.0  # how long a topic may take to be found [s]
POLL_S = 0.05  # how often the end of a source is looked for while nothing comes [s]
AT_ONCE = 2048  # messages of a topic taken, and kept for the reader, at once: four seconds of 500 Hz

FIELDS: dict[str, dict[str, str]] = {
    "builtin_interfaces/msg/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/msg/Header": {"stamp": "builtin_interfaces/msg/Time", "frame_id": "str"},
    "sensor_msgs/msg/JointState": {
        "header": "std_msgs/msg/Header",
        "name": "[str]",
        **dict.fromkeys(("position", "velocity", "effort"), "[float64]"),
    },
    "geometry_msgs/msg/Vector3": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/msg/Wrench": dict.fromkeys(("force", "torque"), "geometry_msgs/msg/Vector3"),
    "geometry_msgs/msg/WrenchStamped": {"header": "std_msgs/msg/Header", "wrench": "geometry_msgs/msg/Wrench"},
    "std_msgs/msg/MultiArrayDimension": {"label": "str", "size": "uint32", "stride": "uint32"},
    "std_msgs/msg/MultiArrayLayout": {"dim": "[std_msgs/msg/MultiArrayDimension]", "data_offset": "uint32"},
    "std_msgs/msg/Float64MultiArray": {"layout": "std_msgs/msg/MultiArrayLayout", "data": "[float64]"},
}
"""Fields of the messages, from their .msg files."""


def _dds(part: str) -> Any:
    return require(f"cyclonedds.{part}", what="a DDS topic")


@cache
def message(name: str) -> Any:
    """Return the IDL type of a message, ``sensor_msgs/msg/JointState``, or of a field, ``float64`` or ``[float64]``."""
    if name == "str":
        return str
    if name.startswith("["):
        return _dds("idl.types").sequence[message(name[1:-1])]
    if name not in FIELDS:
        return getattr(_dds("idl.types"), name)
    fields = {field: message(kind) for field, kind in FIELDS[name].items()}
    return _dds("idl").make_idl_struct(name.rpartition("/")[2], _type_name(name).replace("::", "."), fields)


def _type_name(name: str) -> str:
    """The name of a type on DDS: ``sensor_msgs::msg::dds_::JointState_``."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def follow_topics(topics: str, silence: float) -> Iterator[str]:
    """Yield rows of topics, ``/joint_states`` or several with commas between, as JSON lines, with their times [s].

    The first topic is the clock; after ``silence`` [s] without a row of it the source has died.

    Raises:
        ValueError: no such names, or a topic is of another type, or ROS_DOMAIN_ID is no number.
        OSError: nobody publishes one of them, or no first row came.
    """
    names = [name.strip() for name in topics.split(",")]
    if not all(name.strip("/") for name in names):
        raise ValueError(f"dds takes topics, as in dds:/joint_states, got {topics!r}")
    participant, core = _participant(), _dds("core")
    kinds = {name: _kind(participant, name) for name in names}
    quality = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(AT_ONCE))
    readers = {}
    for name, kind in kinds.items():
        topic = _dds("topic").Topic(participant, f"rt/{name.strip('/')}", message(kind))
        readers[name] = _dds("sub").DataReader(participant, topic, qos=quality)
    clock, *others = names
    waiting = core.WaitSet(participant)
    unread = core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead
    condition = core.ReadCondition(readers[clock], unread)
    waiting.attach(condition)
    last_at, latest, rows = dict.fromkeys(names, time.monotonic()), dict[str, Numbers](), 0
    while True:
        waiting.wait(_dds("util").duration(seconds=POLL_S))
        for name in (*others, clock):
            for sample in readers[name].take(N=AT_ONCE):
                if not getattr(getattr(sample, "sample_info", None), "valid_data", False):
                    continue  # it only says that a writer went
                found = MESSAGES[kinds[name]](sample)
                last_at[name] = time.monotonic()
                latest[name] = {f"{name.strip('/')}.{number}": value for number, value in found.items()}
                if name == clock:
                    rows += 1
                    numbers = {n: v for part in latest.values() for n, v in part.items()}
                    seconds = stamp_of(sample) or 1e-9 * sample.sample_info.source_timestamp
                    yield json.dumps({"time": seconds} | numbers)
            if name != clock and time.monotonic() - last_at[name] > silence:
                latest.pop(name, None)  # an old value is a missing one
        if time.monotonic() - last_at[clock] > silence:
            if not rows:
                raise OSError(f"no row came from {topics} for {silence:g} s")
            raise SourceDied(f"nothing came for {silence:g} s")


def _participant() -> Any:
    """Return a participant in the domain of ROS_DOMAIN_ID."""
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not domain.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number, got {domain!r}")
    return _dds("domain").DomainParticipant(int(domain))


def _kind(participant: Any, name: str) -> str:
    """The type of message that somebody publishes there."""
    builtin = _dds("builtin")
    found = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsPublication)
    known = {_type_name(kind): kind for kind in MESSAGES}
    until, others = time.monotonic() + CONNECT_S, set[str]()
    while time.monotonic() < until:
        for publication in found.take(N=AT_ONCE):
            if getattr(publication, "topic_name", "") == f"rt/{name.strip('/')}":
                if publication.type_name not in known:
                    raise ValueError(f"{name} is of {publication.type_name}; read are {', '.join(MESSAGES)}")
                return known[publication.type_name]
            if publication.topic_name.startswith("rt/"):
                others.add(publication.topic_name[2:])
        time.sleep(POLL_S)
    there = f"; there are {', '.join(sorted(others))}" if others else ""
    raise OSError(f"nobody publishes {name}{there}")
