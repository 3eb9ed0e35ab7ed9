"""Rows from a controller of Universal Robots, by its Real-Time Data Exchange on port 30004.

    >  V 2                                  the version of the protocol        <  V 1
    >  O 125 Hz, timestamp,actual_q,…       what is to be sent, how often      <  O recipe, DOUBLE,VECTOR6D,…
    >  S                                    begin                              <  S 1
    <  U recipe, numbers                    a row, and so on

Each package begins with its length in two bytes and its type in one; numbers are big-endian. Only outputs are asked
for: nothing is sent that moves anything. It has met a controller of the tests, never a real one.

Source: Universal Robots, “Real-Time Data Exchange (RTDE) guide”.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from typing import Any

PORT = 30004
VERSION = 2
REQUEST_VERSION, OUTPUTS, START, DATA, TEXT = (ord(c) for c in "VOSUM")
CLOCK = "timestamp"
CONNECT_S = 5.0
"""How long a controller may take to answer before the first row [s]."""

TYPES = {
    **{"DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I"},
    **{"BOOL": "?", "UINT8": "B", "INT32": "i", "UINT32": "I", "UINT64": "Q"},
}
"""What of ``struct`` a type is; all others are refused."""


def rtde_lines(place: str, names: Sequence[str], rate: float, silence: float) -> Iterator[str]:
    """Rows of these outputs as JSON lines, with the controller's own clock.

    Args:
        place: ``HOST`` or ``HOST:PORT``.
        names: of outputs, such as ``actual_q``.
        rate: rows a second [Hz]; a controller gives at most 125, an e-series 500.
        silence: seconds without a row from which on it has died, which ends the lines with a TimeoutError.

    Raises:
        ValueError: it speaks another protocol, or has no such output.
        OSError: there is no controller, or it closed the connection before the first row.
        TimeoutError: nothing came for so long, or it closed the connection.
    """
    host, _, port = place.partition(":")
    if not host or (port and not port.isdigit()):
        raise ValueError(f"rtde takes a controller, as in rtde:192.168.0.5, got {place!r}")
    with socket.create_connection((host, int(port or PORT)), timeout=CONNECT_S) as there:
        link = _Link(there)
        link.send(REQUEST_VERSION, struct.pack(">H", VERSION))
        if link.answer(REQUEST_VERSION) != b"\x01":
            raise ValueError(f"the controller at {place} does not speak version {VERSION} of RTDE")
        asked = [CLOCK, *names]
        link.send(OUTPUTS, struct.pack(">d", rate) + ",".join(asked).encode("ascii"))
        answer = link.answer(OUTPUTS)
        recipe, types = answer[:1], answer[1:].decode("ascii").split(",")
        unknown = [f"{name} ({kind})" for name, kind in zip(asked, types, strict=False) if kind not in TYPES]
        if unknown or len(types) != len(asked):
            raise ValueError(f"the controller at {place} has no such output: {', '.join(unknown) or types}")
        link.send(START, b"")
        if link.answer(START) != b"\x01":
            raise ValueError(f"the controller at {place} does not begin")
        there.settimeout(silence)
        yield from _rows(link, recipe, [struct.Struct(f">{TYPES[kind]}") for kind in types], asked)


def _rows(link: _Link, recipe: bytes, parts: Sequence[struct.Struct], names: Sequence[str]) -> Iterator[str]:
    size = sum(part.size for part in parts)
    while True:
        body = link.answer(DATA)
        if body[:1] != recipe or len(body) != 1 + size:
            raise ValueError(f"a row of {len(body) - 1} bytes came where one has {size}")
        row: dict[str, Any] = {}
        at = 1
        for name, part in zip(names, parts, strict=True):
            numbers = [float(number) for number in part.unpack_from(body, at)]
            row[name] = numbers if len(numbers) > 1 else numbers[0]
            at += part.size
        yield json.dumps(row)


class _Link:
    """Packages over a socket.

    Args:
        there: connected, with the time that may pass without a byte.
    """

    def __init__(self, there: socket.socket) -> None:
        self.there, self.rest = there, b""

    def send(self, kind: int, body: bytes) -> None:
        self.there.sendall(struct.pack(">HB", 3 + len(body), kind) + body)

    def answer(self, kind: int) -> bytes:
        """The body of the next package of this kind; what the controller says in words is passed over.

        Raises:
            TimeoutError: none came in time, or the connection was closed.
        """
        until = time.monotonic() + (self.there.gettimeout() or CONNECT_S)
        while True:
            while len(self.rest) < 3 or len(self.rest) < struct.unpack_from(">H", self.rest)[0]:
                if time.monotonic() > until:
                    raise TimeoutError("nothing came")
                found = self.there.recv(65_536)
                if not found:
                    raise TimeoutError("the controller closed the connection")
                self.rest += found
            length, said = struct.unpack_from(">HB", self.rest)
            if length < 3:
                raise ValueError(f"a package of {length} bytes is none of RTDE")
            body, self.rest = self.rest[3:length], self.rest[length:]
            if said == kind:
                return body
            if said not in (TEXT, DATA):
                raise ValueError(f"a package of type {chr(said)!r} came where {chr(kind)!r} was due")
