"""Read ROS bags and MCAP files as tables of the joints and wrists.

    sensor_msgs/JointState           position[name], velocity[name], effort[name]
    geometry_msgs/WrenchStamped      force[x], …, torque[z]
    std_msgs/Float64MultiArray       data[0], …           such as commands

Each column is named after its topic, ``joint_states.position[panda_joint1]``. A row is a message of JointState: of the
ones with the same joints, on one topic, those with the most joints. It stands at the time in its header, with the
newest values of all others, such as a gripper on the same topic, as long as these are not old.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import HELD_PERIODS, Columns
from asm_gym.exceptions import DamagedFile
from asm_gym.extras import require

Numbers = dict[str, float]


def _joints(message: Any) -> Numbers:
    numbers = {}
    for kind in ("position", "velocity", "effort"):
        values = getattr(message, kind)
        if len(values) != len(message.name):
            continue  # nothing tells whose they are
        for name, value in zip(message.name, values, strict=True):
            numbers[f"{kind}[{name}]"] = value
    return numbers


def _wrench(message: Any) -> Numbers:
    numbers = {}
    for kind in ("force", "torque"):
        vector = getattr(message.wrench, kind)
        for axis in "xyz":
            numbers[f"{kind}[{axis}]"] = getattr(vector, axis)
    return numbers


def _array(message: Any) -> Numbers:
    return {f"data[{k}]": value for k, value in enumerate(message.data)}


JOINT_STATE = "sensor_msgs/msg/JointState"
MESSAGES: dict[str, Callable[[Any], Numbers]] = {
    JOINT_STATE: _joints,
    "geometry_msgs/msg/WrenchStamped": _wrench,
    "std_msgs/msg/Float64MultiArray": _array,
}
"""The numbers of a message, by its type."""

MENDS = {
    ".mcap": "mcap recover",
    ".bag": "rosbag reindex",
}
"""What mends a bag that was cut off, by its suffix."""


def read_bag(path: Path) -> Columns:
    """Return the columns of a bag, ``time`` [s] among them. Raises ValueError if it is damaged or has no JointState."""
    highlevel = require("rosbags.highlevel", what="a ROS bag")
    typesys = require("rosbags.typesys", what="a ROS bag")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as bag:
            return _columns(bag)
    except (ValueError, ImportError):
        raise
    except Exception as error:  # rosbags, SQLite, struct: whichever meets the damage first
        problem = str(error)
        if path.suffix in MENDS:
            problem += f"; where its recorder was killed, {MENDS[path.suffix]} mends it"
        raise DamagedFile("it", problem) from error


def _columns(bag: Any) -> Columns:
    """The columns of an open bag, in the order in which they first come."""
    if not any(c.msgtype == JOINT_STATE and c.msgcount for c in bag.connections):
        topics = ", ".join(f"{c.topic} ({c.msgtype})" for c in bag.connections)
        raise ValueError(
            f"it holds no sensor_msgs/JointState; its topics: {topics or 'none'}",
        )
    tables = _tables(bag)
    names = dict.fromkeys(chain.from_iterable(tables.values()))
    del names["came"]
    clock = max(tables, key=lambda publisher: (len(publisher), len(tables[publisher])))
    rows = tables.pop(clock)
    if tables:
        note(
            f"messages come at several rates: a row is one of {' '.join(clock)}, "
            "others keep their newest values"
        )
    for other in tables.values():
        rows = _with_newest(rows, other)
    rows["time"] -= rows["time"].iloc[0]  # seconds since 1970 would cost digits
    return {name: rows[name].to_numpy() for name in names}


def _tables(bag: Any) -> dict[tuple[str, ...], Any]:
    """The messages of each publisher as a frame of pandas.

    Returns:
        By a topic and the joints that its messages name: when messages came [s], their times [s], and their numbers.
    """
    import pandas as pd

    messages: dict[tuple[str, ...], list[Numbers]] = defaultdict(list)
    connections = [c for c in bag.connections if c.msgtype in MESSAGES]
    for connection, written, raw in bag.messages(connections=connections):
        kind = connection.msgtype
        topic = connection.topic.strip("/")
        message = bag.deserialize(raw, kind)
        came = 1e-9 * written
        row = {"came": came, "time": stamp_of(message) or came}
        row |= numbers_of(kind, topic, message)
        joints = sorted(getattr(message, "name", ()))
        messages[topic, *joints].append(row)
    return {publisher: pd.DataFrame(rows) for publisher, rows in messages.items()}


def _with_newest(rows: Any, other: Any) -> Any:
    """Rows with the newest values of another publisher, as long as these are not old."""
    import pandas as pd

    period = np.ptp(other["came"]) / max(len(other) - 1, 1)  # [s]
    new = other.columns.difference(rows.columns)
    return pd.merge_asof(
        rows,
        other[["came", *new]],
        on="came",
        tolerance=HELD_PERIODS * period,
    )


def numbers_of(kind: str, topic: str, message: Any) -> Numbers:
    """Return the numbers of a message of a type in ``MESSAGES``, each named after its topic."""
    numbers = MESSAGES[kind](message)
    return {f"{topic}.{name}": value for name, value in numbers.items()}


def stamp_of(message: Any) -> float:
    """Return the time in the header of a message [s]; 0 where it has none."""
    if not hasattr(message, "header"):
        return 0.0
    stamp = message.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)
