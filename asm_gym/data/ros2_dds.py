"""Rows from ROS 2 topics over DDS, without ROS: what joints and wrists say, as they say it.

    /joint_states      on DDS rt/joint_states, of type sensor_msgs::msg::dds_::JointState_
    a row              a message of the first topic, at the time in its header; of the others what they said last
    numbers            named as those of a bag are, joint_states.position[panda_joint1] (``asm_gym.data.bags``)

So a memory fitted from a bag reads the topics that the bag recorded. A reader asks for no more than best effort, which
every writer offers. It was tried with publishers of CycloneDDS in other processes, and never with a robot's.

Sources: ROS 2 design, “Topic and Service name mapping to DDS”; ROS_DOMAIN_ID as ROS 2 reads it.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

from asm_gym.data.bags import MESSAGES, Numbers
from asm_gym.extras import require

CONNECT_S = 5.0
"""How long a topic may take to be found [s]."""

LOOK_S = 0.05
"""How often the end of a source is looked for while nothing comes [s]."""

AT_ONCE = 2048
"""Messages of a topic taken, and kept for the reader, at once: four seconds of 500 Hz."""

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
"""What the messages hold, from their .msg files."""


@cache
def message(name: str) -> Any:
    """The IDL type of a message, ``sensor_msgs/msg/JointState``, or of a field, ``float64`` or ``[float64]``."""
    idl, types = (require(f"cyclonedds.{part}", what="a DDS topic") for part in ("idl", "idl.types"))
    if name == "str":
        return str
    if name.startswith("["):
        return types.sequence[message(name[1:-1])]
    if name not in FIELDS:
        return getattr(types, name)
    fields = {field: message(kind) for field, kind in FIELDS[name].items()}
    return idl.make_idl_struct(name.rpartition("/")[2], f"{_on_dds(name)}".replace("::", "."), fields)


def _on_dds(name: str) -> str:
    """What a type is called there: ``sensor_msgs::msg::dds_::JointState_``."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def dds_lines(topics: str, silence: float) -> Iterator[str]:
    """Rows of topics as JSON lines, their time in seconds since 1970 or whatever the stamps count from.

    Args:
        topics: ``/joint_states``, or several with commas between, the first being the clock.
        silence: seconds without a row from which on the source has died, which ends the lines with a TimeoutError.

    Raises:
        ValueError: no such names, or a topic is of another type, or ROS_DOMAIN_ID is no number.
        OSError: nobody publishes one of them.
        TimeoutError: nothing came for so long.
        ImportError: cyclonedds is not installed.
    """
    names = [name.strip() for name in topics.split(",")]
    if not all(name.strip("/") for name in names):
        raise ValueError(f"dds takes topics, as in dds:/joint_states, got {topics!r}")
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not domain.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number, got {domain!r}")
    participant = require("cyclonedds.domain", what="a DDS topic").DomainParticipant(int(domain))
    sub, core, util = (require(f"cyclonedds.{part}", what="a DDS topic") for part in ("sub", "core", "util"))
    kinds = {name: _kind(participant, name) for name in names}
    policy = core.Policy
    quality = core.Qos(policy.Reliability.BestEffort, policy.History.KeepLast(AT_ONCE))
    topic = require("cyclonedds.topic", what="a DDS topic").Topic
    readers = {
        name: sub.DataReader(participant, topic(participant, _topic(name), message(kind)), qos=quality)
        for name, kind in kinds.items()
    }
    waiting = core.WaitSet(participant)
    clock = readers[names[0]]
    condition = core.ReadCondition(clock, core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead)
    waiting.attach(condition)
    heard = dict.fromkeys(names, time.monotonic())
    latest: dict[str, Numbers] = {}
    while True:
        waiting.wait(util.duration(seconds=LOOK_S))
        for name in names[1:]:
            for sample in _taken(readers[name]):
                heard[name], latest[name] = time.monotonic(), _named(name, kinds[name], sample)
            if time.monotonic() - heard[name] > silence:
                latest.pop(name, None)  # what is no longer said is missing, and not as it was
        for sample in _taken(clock):
            heard[names[0]], latest[names[0]] = time.monotonic(), _named(names[0], kinds[names[0]], sample)
            yield json.dumps({"time": _stamp(sample)} | {n: v for said in latest.values() for n, v in said.items()})
        if time.monotonic() - heard[names[0]] > silence:
            raise TimeoutError(f"nothing came for {silence:g} s")


def _topic(name: str) -> str:
    return f"rt/{name.strip('/')}"


def _kind(participant: Any, name: str) -> str:
    """The type of message that somebody publishes there."""
    builtin = require("cyclonedds.builtin", what="a DDS topic")
    found = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsPublication)
    known = {_on_dds(kind): kind for kind in MESSAGES}
    until, others = time.monotonic() + CONNECT_S, set[str]()
    while time.monotonic() < until:
        for publication in found.take(N=AT_ONCE):
            if getattr(publication, "topic_name", "") == _topic(name):
                if publication.type_name not in known:
                    raise ValueError(f"{name} is of {publication.type_name}; read are {', '.join(MESSAGES)}")
                return known[publication.type_name]
            if publication.topic_name.startswith("rt/"):
                others.add(publication.topic_name[2:])
        time.sleep(LOOK_S)
    there = f"; there are {', '.join(sorted(others))}" if others else ""
    raise OSError(f"nobody publishes {name}{there}")


def _taken(reader: Any) -> list[Any]:
    """Messages since the last look; what only says that a writer went is none."""
    return [
        sample for sample in reader.take(N=AT_ONCE) if hasattr(sample, "sample_info") and sample.sample_info.valid_data
    ]


def _named(name: str, kind: str, sample: Any) -> Numbers:
    return {f"{name.strip('/')}.{number}": value for number, value in MESSAGES[kind](sample).items()}


def _stamp(sample: Any) -> float:
    """The time in its header [s]; where it says none, when it was written."""
    stamp = getattr(getattr(sample, "header", None), "stamp", None)
    said = 0.0 if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
    return float(said or 1e-9 * sample.sample_info.source_timestamp)
