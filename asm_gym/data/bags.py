"""Read ROS bags and MCAP files as tables of the joints and wrists.

    sensor_msgs/JointState           position[name], velocity[name], effort[name]
    geometry_msgs/WrenchStamped      force[x], …, torque[z]
    std_msgs/Float64MultiArray       data[0], …           such as commands

Each column is named after its topic, ``joint_states.position[panda_joint1]``. A row is a message of JointState: of the
ones with the same joints, on one topic, those with the most joints. It stands at the time in its header, with the
newest values of all others, such as a gripper on the same topic, as long as these are not old.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from asm_gym.data.reader_notes import note
from asm_gym.data.tables import HELD, Columns
from asm_gym.extras import require

Numbers = dict[str, float]


def _joints(message: Any) -> Numbers:
    found: Numbers = {}
    for kind in ("position", "velocity", "effort"):
        values = getattr(message, kind)
        if len(values) == len(message.name):  # others are missing: nothing tells whose they are
            found |= {
                f"{kind}[{name}]": float(v) for name, v in zip(message.name, values, strict=True)
            }
    return found


def _wrench(message: Any) -> Numbers:
    parts = {"force": message.wrench.force, "torque": message.wrench.torque}
    return {
        f"{name}[{axis}]": float(getattr(part, axis))
        for name, part in parts.items()
        for axis in "xyz"
    }


JOINT_STATE = "sensor_msgs/msg/JointState"
MESSAGES: dict[str, Callable[[Any], Numbers]] = {
    JOINT_STATE: _joints,
    "geometry_msgs/msg/WrenchStamped": _wrench,
    "std_msgs/msg/Float64MultiArray": lambda message: {
        f"data[{k}]": float(v) for k, v in enumerate(message.data)
    },
}
"""The numbers of a message, by its type."""

MENDS = {".mcap": "mcap recover", ".bag": "rosbag reindex"}
"""What mends a bag that was cut off, by its suffix."""


def read_bag(path: Path) -> Columns:
    """Return the columns of a bag, ``time`` [s] among them. Raises ValueError if it is damaged or has no JointState."""
    highlevel, typesys = (
        require(f"rosbags.{name}", what="a ROS bag") for name in ("highlevel", "typesys")
    )
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as bag:
            return _columns(bag)
    except (ValueError, ImportError):
        raise
    except Exception as error:  # rosbags, SQLite, struct: whichever meets the damage first
        mend = (
            f"; where its recorder was killed, {MENDS[path.suffix]} mends it"
            if path.suffix in MENDS
            else ""
        )
        raise ValueError(f"it is damaged: {error}{mend}") from error


def _columns(bag: Any) -> Columns:
    import pandas as pd

    chosen = [c for c in bag.connections if c.msgtype in MESSAGES]
    states = [c for c in chosen if c.msgtype == JOINT_STATE]
    if not any(c.msgcount for c in states):
        topics = ", ".join(f"{c.topic} ({c.msgtype})" for c in bag.connections) or "none"
        raise ValueError(f"it holds no sensor_msgs/JointState; its topics: {topics}")
    said: dict[tuple[str, ...], list[Numbers]] = {}  # on a topic, of the same joints
    for connection, written, raw in bag.messages(connections=chosen):
        message = bag.deserialize(raw, connection.msgtype)
        numbers = MESSAGES[connection.msgtype](message)
        key = (connection.topic, *sorted(getattr(message, "name", ())))
        named = {f"{connection.topic.strip('/')}.{name}": value for name, value in numbers.items()}
        came = 1e-9 * written
        said.setdefault(key, []).append({"came": came, "time": stamp_of(message) or came} | named)
    of_states = {c.topic for c in states}
    clock = max(
        (key for key in said if key[0] in of_states), key=lambda key: (len(key), len(said[key]))
    )
    if len(said) > 1:
        note(
            f"messages come at several rates: a row is one of {' '.join(clock)}, others keep their newest values"
        )
    tables = {key: pd.DataFrame(messages) for key, messages in said.items()}
    rows = tables[clock]
    for other in (table for key, table in tables.items() if key != clock):
        old = HELD * (other["came"].iloc[-1] - other["came"].iloc[0]) / max(len(other) - 1, 1)
        new = other[["came", *other.columns.difference(rows.columns)]]
        rows = pd.merge_asof(rows, new, on="came", tolerance=old)
    rows["time"] -= rows["time"].iloc[0]  # seconds since 1970 would cost digits
    names = dict.fromkeys(name for table in tables.values() for name in table if name != "came")
    return {name: rows[name].to_numpy() for name in names}


def stamp_of(message: Any) -> float:
    """Return the time in the header of a message [s]; 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else float(stamp.sec + 1e-9 * stamp.nanosec)
