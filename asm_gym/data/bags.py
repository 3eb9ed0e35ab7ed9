"""Read ROS bags and MCAP files as tables of the joints and wrists.

    sensor_msgs/JointState           position[name], velocity[name], effort[name]
    geometry_msgs/WrenchStamped      force[x], …, torque[z]
    std_msgs/Float64MultiArray       data[0], …           such as commands

Each column is named after its topic, ``joint_states.position[panda_joint1]``. A row is a message of the topic of
JointState that has most of them, at the time in its header, with the newest values of the other topics.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.arrays import check_declared
from asm_gym.extras import require
from asm_gym.files import regular_file

Numbers = dict[str, float]


def _joints(message: Any) -> Numbers:
    found: Numbers = {}
    for kind in ("position", "velocity", "effort"):
        values = getattr(message, kind)
        if len(values) not in (0, len(message.name)):
            raise ValueError(f"a JointState of {len(message.name)} joints has {len(values)} {kind}s")
        found |= {f"{kind}[{name}]": float(v) for name, v in zip(message.name, values, strict=False)}
    return found


def _wrench(message: Any) -> Numbers:
    parts = {"force": message.wrench.force, "torque": message.wrench.torque}
    return {f"{name}[{axis}]": float(getattr(part, axis)) for name, part in parts.items() for axis in "xyz"}


def _array(message: Any) -> Numbers:
    return {f"data[{k}]": float(v) for k, v in enumerate(message.data)}


JOINT_STATE = "sensor_msgs/msg/JointState"
MESSAGES: dict[str, Callable[[Any], Numbers]] = {
    JOINT_STATE: _joints,
    "geometry_msgs/msg/WrenchStamped": _wrench,
    "std_msgs/msg/Float64MultiArray": _array,
}
"""The numbers of a message, by its type."""

MCAP_MAGIC, MCAP_CHUNK = 8, 0x06
"""Bytes before the first record of an MCAP file, and the opcode of a chunk (mcap.dev/spec)."""


def read_bag(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a bag (``.mcap``, ``.db3``, ``.bag``), ``time`` among them [s].

    Raises:
        ValueError: it is damaged, declares far more than it holds, or has no JointState; the message lists its topics.
        ImportError: rosbags is not installed.
    """
    size = regular_file(path)
    if path.suffix == ".mcap":
        check_declared(path, _bytes_in_chunks(path, size), size)
    highlevel, typesys = (require(f"rosbags.{name}", what="a ROS bag") for name in ("highlevel", "typesys"))
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as bag:
            return _columns(bag)
    except (ValueError, ImportError):
        raise
    except Exception as error:  # rosbags, SQLite, struct: whichever meets the damage first
        raise ValueError(f"{path} is damaged: {error}") from error


def _bytes_in_chunks(path: Path, size: int) -> int:
    """[bytes] that the chunks of an MCAP file declare, none of them expanded."""
    total = 0
    with path.open("rb") as file:
        file.seek(MCAP_MAGIC)
        while len(head := file.read(9)) == 9:  # opcode, length
            end = file.tell() + min(int.from_bytes(head[1:], "little"), size)
            if head[0] == MCAP_CHUNK:
                total += int.from_bytes(file.read(24)[16:], "little")  # after two times
            file.seek(end)
    return total


def _columns(bag: Any) -> dict[str, NDArray[np.float64]]:
    chosen = [c for c in bag.connections if c.msgtype in MESSAGES]
    states = [c for c in chosen if c.msgtype == JOINT_STATE]
    if not any(c.msgcount for c in states):
        topics = ", ".join(f"{c.topic} ({c.msgtype})" for c in bag.connections) or "none"
        raise ValueError(f"it holds no sensor_msgs/JointState; its topics: {topics}")
    clock = max(states, key=lambda c: c.msgcount).topic
    latest: Numbers = {}
    rows: list[Numbers] = []
    for connection, written, raw in bag.messages(connections=chosen):
        message = bag.deserialize(raw, connection.msgtype)
        numbers = MESSAGES[connection.msgtype](message)
        latest |= {f"{connection.topic.strip('/')}.{name}": value for name, value in numbers.items()}
        if connection.topic == clock:
            stamp = message.header.stamp
            rows.append({"time": stamp.sec + 1e-9 * stamp.nanosec or 1e-9 * written, **latest})
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    return columns | {"time": columns["time"] - columns["time"][0]}  # seconds since 1970 would cost digits
