"""Follow lines as they come: from standard input, a file that grows, datagrams, or topics of ROS 2 over DDS.

A source that falls silent has died. A new source is one row of ``LIVE``. ROS itself is not needed for its topics:

    /joint_states      on DDS rt/joint_states, of type sensor_msgs::msg::dds_::JointState_
    a row              a message of the first topic, at the time in its header, with the newest of the others; of
                       several publishers there, one with the most joints
    numbers            named as those of a bag are, joint_states.position[panda_joint1] (``asm_gym.data.bags``)

Source: ROS 2 design, "Topic and Service name mapping to DDS".
"""

from __future__ import annotations

import json
import math
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from io import UnsupportedOperation
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from asm_gym.data.bags import MESSAGES, stamp_of
from asm_gym.data.rows import Publishers, SourceDied
from asm_gym.data.text import decoded
from asm_gym.extras import require
from asm_gym.files import named, no_links, regular_file
from asm_gym.validation import check_number

POLL_S = 0.002  # how often a source is looked at for more [s]
LARGEST = 65_535  # bytes of a datagram
LONGEST = 100 * LARGEST  # bytes of a line: more than a row of any robot
CONNECT_S = 5.0  # how long a topic may take to be found [s]
WAIT_S = 0.05  # how often the end of a topic is looked for while nothing comes [s]
AT_ONCE = (
    2048  # messages of a topic taken, and kept for the reader, at once: four seconds of 500 Hz
)

FIELDS: dict[str, dict[str, str]] = {
    "builtin_interfaces/msg/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/msg/Header": {"stamp": "builtin_interfaces/msg/Time", "frame_id": "str"},
    "sensor_msgs/msg/JointState": {"header": "std_msgs/msg/Header", "name": "[str]"}
    | dict.fromkeys(("position", "velocity", "effort"), "[float64]"),
    "geometry_msgs/msg/Vector3": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/msg/Wrench": dict.fromkeys(("force", "torque"), "geometry_msgs/msg/Vector3"),
    "geometry_msgs/msg/WrenchStamped": {
        "header": "std_msgs/msg/Header",
        "wrench": "geometry_msgs/msg/Wrench",
    },
    "std_msgs/msg/String": {"data": "str"},
    "std_msgs/msg/MultiArrayDimension": {"label": "str", "size": "uint32", "stride": "uint32"},
    "std_msgs/msg/MultiArrayLayout": {
        "dim": "[std_msgs/msg/MultiArrayDimension]",
        "data_offset": "uint32",
    },
    "std_msgs/msg/Float64MultiArray": {
        "layout": "std_msgs/msg/MultiArrayLayout",
        "data": "[float64]",
    },
}
"""Fields of the messages, from their .msg files."""


class LiveSource(NamedTuple):
    """A source that is followed."""

    example: str  # of its name
    open: Callable[[str, TextIO, float, float], Iterator[str]]
    """Takes what follows the prefix, standard input, silence [s], and how long the first line may take [s]."""
    returns: bool = False  # whether it may come back after it died


def live_source(source: str) -> LiveSource | None:
    """Return the live source of this name; None where it names a recording."""
    return LIVE.get(source if source == "-" else f"{source.partition(':')[0]}:")


def lines_from(
    source: str, stdin: TextIO, silence: float, first: float = math.inf
) -> Iterator[str]:
    """Return the lines of a live source, as they come.

    Sources are ``-`` for standard input, ``tail:FILE`` for a file that grows, ``udp:PORT`` for datagrams of this
    machine, ``udp:PORT@ADDRESS`` or ``udp:PORT@ADDRESS:PORT`` for those of one sender, and ``dds:/joint_states`` for
    topics of ROS 2. Without a line for ``silence`` [s], or ``first`` before the first line, SourceDied is raised.
    """
    found = live_source(source)
    if found is None:
        raise ValueError(
            f"unknown source {source!r}; known: {', '.join(s.example for s in LIVE.values())}"
        )
    return found.open(source.partition(":")[2], stdin, silence, first)


def _follow_pipe(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    try:
        number = stdin.fileno()
    except (UnsupportedOperation, AttributeError):  # no pipe, but text in memory
        yield from stdin
        return

    def more() -> bytes | None:
        ready, _, _ = select.select([number], [], [], POLL_S)
        return os.read(number, LARGEST) if ready else None

    yield from _lines(more, silence, first)


def _follow_file(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    path = Path(place)
    regular_file(path)
    with path.open("rb") as file:

        def more() -> bytes | None:
            found = file.read(LARGEST)
            if not found:
                if path.stat().st_size < file.tell():
                    raise ValueError(f"{path} became shorter while it was followed")
                time.sleep(POLL_S)
            return found or None

        yield from _lines(more, silence, first)


def _follow_datagrams(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    """Yield the lines of datagrams, whatever they hold, to a port of this machine from itself or from one sender."""
    number, at, sender = place.partition("@")
    host, colon, own = sender.partition(":")
    if not number.isdigit() or (at and not host) or (colon and not own.isdigit()):
        raise ValueError(
            f"udp takes a port of this machine, as in udp:9870, or udp:9870@127.0.0.1:5005, got {place!r}"
        )
    port = int(check_number("port", int(number), low=1, high=65_535, whole=True))
    believed = IPv4Address(host or "127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1" if believed.is_loopback else "0.0.0.0", port))
        receiver.settimeout(POLL_S)

        def more() -> bytes | None:
            try:
                found, (address, source) = receiver.recvfrom(LARGEST)
            except TimeoutError:
                return None
            if (host and IPv4Address(address) != believed) or (own and source != int(own)):
                return None
            return (found.rstrip(b"\n") or b"an empty datagram") + b"\n"

        yield from _lines(more, silence, first)


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
    return _dds("idl").make_idl_struct(
        name.rpartition("/")[2], _type_name(name).replace("::", "."), fields
    )


def _type_name(name: str) -> str:
    """The name of a type on DDS: ``sensor_msgs::msg::dds_::JointState_``."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def _participant() -> Any:
    """Join the domain of ROS. Raises ValueError where ROS_DOMAIN_ID is no number."""
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not domain.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number, got {domain!r}")
    return _dds("domain").DomainParticipant(int(domain))


def publisher(topic: str) -> Callable[[str], None]:
    """Return what publishes a text on a topic of ROS 2, as std_msgs/msg/String; who joins late gets the last one too.

    Raises ValueError where ROS_DOMAIN_ID is no number.
    """
    policy, kind, participant = _dds("core").Policy, message("std_msgs/msg/String"), _participant()
    lasting = (
        policy.Reliability.Reliable(0),
        policy.Durability.TransientLocal,
        policy.History.KeepLast(1),
    )
    there = _dds("topic").Topic(participant, f"rt/{topic.strip('/')}", kind)
    writer = _dds("pub").DataWriter(participant, there, qos=_dds("core").Qos(*lasting))
    return lambda text: writer.write(kind(text))


def _follow_topics(topics: str, silence: float) -> Iterator[str]:
    """Yield rows of topics, ``/joint_states`` or several with commas between, as JSON lines, with their times [s].

    The first topic is the clock; after ``silence`` [s] without a row of it the source has died.

    Raises:
        ValueError: no such names, or a topic is of another type, or ROS_DOMAIN_ID is no number.
        OSError: nobody publishes one of them, or no first row came.
    """
    names = [name.strip().strip("/") for name in topics.split(",")]
    if not all(names):
        raise ValueError(f"dds takes topics, as in dds:/joint_states, got {topics!r}")
    core, participant = _dds("core"), _participant()
    kinds = {name: _kind(participant, name) for name in names}
    quality = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(AT_ONCE))
    readers = {}
    for name, kind in kinds.items():
        topic = _dds("topic").Topic(participant, f"rt/{name}", message(kind))
        readers[name] = _dds("sub").DataReader(participant, topic, qos=quality)
    clock, *others = names
    waiting = core.WaitSet(participant)
    waiting.attach(
        core.ReadCondition(
            readers[clock], core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead
        )
    )
    publishers, rows, last = Publishers(silence), 0, time.monotonic()
    while time.monotonic() - last <= silence:
        waiting.wait(_dds("util").duration(seconds=WAIT_S))
        for name in (*others, clock):
            for sample in readers[name].take(N=AT_ONCE):
                if not getattr(getattr(sample, "sample_info", None), "valid_data", False):
                    continue  # it only says that a writer went
                joints = [f"{name}.{joint}" for joint in getattr(sample, "name", ())] or [name]
                numbers = {
                    f"{name}.{number}": v for number, v in MESSAGES[kinds[name]](sample).items()
                }
                row = publishers.row(numbers, joints, now := time.monotonic(), leads=name == clock)
                last = now if name == clock else last
                if row is not None:
                    rows += 1
                    seconds = stamp_of(sample) or 1e-9 * sample.sample_info.source_timestamp
                    yield json.dumps({"time": seconds} | row)
    if not rows:
        raise OSError(f"no row came from {topics} for {silence:g} s")
    raise SourceDied(f"nothing came for {silence:g} s")


def _kind(participant: Any, name: str) -> str:
    """The type of message that somebody publishes there."""
    builtin = _dds("builtin")
    found = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsPublication)
    known = {_type_name(kind): kind for kind in MESSAGES}
    until, there = time.monotonic() + CONNECT_S, dict[str, str]()
    while f"rt/{name}" not in there and time.monotonic() < until:
        time.sleep(WAIT_S)
        there |= {
            p.topic_name: p.type_name for p in found.take(N=AT_ONCE) if hasattr(p, "topic_name")
        }
    kind = there.get(f"rt/{name}")
    if kind is None:
        others = ", ".join(sorted(topic[2:] for topic in there if topic.startswith("rt/")))
        raise OSError(f"nobody publishes /{name}" + (f"; there are {others}" if others else ""))
    if kind not in known:
        raise ValueError(f"/{name} has the type {kind}; readable types: {', '.join(MESSAGES)}")
    return known[kind]


LIVE = {
    "-": LiveSource("-", _follow_pipe),
    "tail:": LiveSource("tail:FILE", _follow_file),
    "udp:": LiveSource("udp:PORT", _follow_datagrams, returns=True),
    "dds:": LiveSource(
        "dds:/TOPIC",
        lambda place, stdin, silence, first: _follow_topics(place, silence),
        returns=True,
    ),
}
"""Live sources by prefix."""


def _lines(more: Callable[[], bytes | None], silence: float, first: float) -> Iterator[str]:
    """Lines of what ``more`` returns: bytes, none at the end, or None where there are none yet."""
    rest, last, most = b"", time.monotonic(), first
    while (found := more()) != b"":
        if found is None:
            if time.monotonic() - last > most:
                raise SourceDied(f"nothing came for {most:g} s")
            continue
        last, most = time.monotonic(), silence
        *whole, rest = (rest + found).split(b"\n")
        rest = rest[: LONGEST + 1]  # what is longer is no row, and costs no memory
        for line in whole:
            yield (
                f"a line of more than {LONGEST} bytes" if len(line) > LONGEST else decoded(line)[0]
            )
    if rest.strip():
        yield decoded(rest)[0]


def record(lines: Iterable[str], to: Path, minutes: float) -> tuple[float, str]:
    """Write rows to a file until the time is over or the source ends; return the seconds, and why it ended."""
    to.parent.mkdir(parents=True, exist_ok=True)
    why, seconds, rows, start = "the source ended", 0.0, 0, 0.0
    with named(to), open(to, "w", encoding="utf-8", opener=no_links) as file:
        try:
            for line in filter(str.strip, lines):
                start = start or time.monotonic()
                rows, seconds = rows + 1, time.monotonic() - start
                file.write(line.rstrip("\n") + "\n")
                if seconds >= 60 * minutes:
                    why = "the time is over"
                    break
        except SourceDied as error:
            why = f"the source has died, {error}"
    if not rows:
        raise ValueError("no row came")
    return seconds, f"{why}: {rows} rows in {seconds:.0f} s"
