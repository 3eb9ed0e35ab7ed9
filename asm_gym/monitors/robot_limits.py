"""What healthy motion needs, as limits that a robot can be given.

    limit = margin · greatest healthy |value|                   torque, force, current, speed, distance of a target
    range = [least - p r, most + p r],  r = most - least        position; within the joint's stops

A healthy row is near a limit beyond ``NEAR`` of it, near the end of a range within p r of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from asm_gym.data.episode import CONTROLLER, Episode
from asm_gym.detection.healthy_ranges import LEAD, Floats, share_beyond
from asm_gym.exceptions import NotFitted
from asm_gym.spec import MOTOR, UNNAMED, Channel
from asm_gym.validation import check_number

MARGIN = 1.25
NEAR = 0.75  # share of a limit
RANGE_MARGIN = 0.05  # p

EXTERNAL_TORQUE = "external torque"
FORCE = "force"
TORQUE_AT_HAND = "hand torque"
POSITION = "joint position"
JOINT_SPEED = "joint speed"
HAND_SPEED = "hand speed"
TURNING_SPEED = "turning speed"
CURRENT = "current"
TARGET_DISTANCE = "distance of the target"

KINDS = {
    EXTERNAL_TORQUE: r"ext\w*[_ .]?(torque|tau|effort)|(torque|tau|effort)\w*[_ .]?ext",
    TORQUE_AT_HAND: r"(wrist|wrench|tcp|ee|hand|flange)\w*[_ .]?torque",
    FORCE: r"(wrist|wrench|tcp|ee|hand|flange)\w*[_ .]?force",
    TURNING_SPEED: r"(hand|tcp|ee)\w*angular",
    HAND_SPEED: r"(hand|tcp|ee)\w*(vel|speed)",
    CURRENT: r"current",
    JOINT_SPEED: r"joint\w*[_ .]?(vel|speed)|^(qd|dq|qvel|velocity|velocities|vel)$|\.vel$",
    POSITION: (
        r"joint\w*[_ .]?(pos|angle)|^(q|qpos|position|positions|pos)$|\.pos$|observation\.state"
    ),
}
"""What a channel senses, by its name; the first that fits counts."""


@dataclass(frozen=True)
class Limit:
    """One number that a robot can be limited in.

    Attributes:
        kind: what is limited, of ``KINDS`` or ``TARGET_DISTANCE``.
        label: of the number in the stream.
        unit: of all four values.
        low, high: the limit, with its margin.
        least, most: of healthy motion.
        near: share of healthy rows that come near the limit; None where nothing is counted.
    """

    kind: str
    label: str
    unit: str
    low: float
    high: float
    least: float
    most: float
    near: float | None = None


@dataclass(frozen=True)
class RobotLimits:
    """What healthy motion of a robot needs.

    Attributes:
        robot: its name; empty if unknown.
        rate: of the rows [Hz].
        margin: of the limits over healthy motion.
        limits: one for each number, in the order of the stream.
        senses: names of all channels that the memory has.
    """

    robot: str
    rate: float
    margin: float
    limits: tuple[Limit, ...]
    senses: tuple[str, ...]

    def of(self, kind: str) -> tuple[Limit, ...]:
        """Return the limits of a kind; empty without any."""
        return tuple(limit for limit in self.limits if limit.kind == kind)

    def passed(self, episode: Episode) -> tuple[Limit, ...]:
        """Return the limits that some row of an episode passes; a number that it lacks passes none."""
        labels = episode.spec.labels
        found = []
        for limit in self.limits:
            if limit.kind == TARGET_DISTANCE or limit.label not in labels:
                continue
            values = episode.stream[:, labels.index(limit.label)]
            if np.any((values < limit.low) | (values > limit.high)):
                found.append(limit)
        return tuple(found)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, as JSON holds them."""
        return {
            "robot": self.robot,
            "rate_hz": self.rate,
            "margin": self.margin,
            "limits": [asdict(limit) for limit in self.limits],
        }


def limits_of(monitor: Any, margin: float = MARGIN) -> RobotLimits:
    """Return what healthy motion needs, by the episodes that a monitor was calibrated on.

    Args:
        monitor: a ``CalibratedMonitor``.
        margin: of limits over the greatest healthy value, at least 1.

    Raises:
        NotFitted: it is not calibrated, or was by a version that kept no ranges.
        ValueError: the margin is below 1.
    """
    check_number("margin", margin, low=1.0)
    if monitor.ranges_ is None:
        raise NotFitted("this monitor", "has no healthy ranges", "calibrate(nominal_episodes)")
    spec = monitor.spec
    robot = spec.source
    if robot in UNNAMED:
        robot = ""
    return RobotLimits(
        robot=robot,
        rate=1.0 / spec.dt,
        margin=margin,
        limits=tuple(_of_ranges(monitor, margin)),
        senses=tuple(channel.name for channel in spec.channels),
    )


def kind_of(channel: Channel, element: str = "") -> str:
    """Return what a channel senses that a robot can be limited in; empty for anything else.

    Args:
        channel: of the stream.
        element: name of one of its numbers. One with a dot, as LeRobot's ``elbow_flex.current``, tells what it is.
    """
    name = channel.name.lower().removesuffix("_peak")
    if channel.group == MOTOR or "gripper" in name:
        return ""
    if "." in element:
        name = element.lower()
    for kind, pattern in KINDS.items():
        if re.search(pattern, name):
            return kind
    return ""


def _of_ranges(monitor: Any, margin: float) -> Iterator[Limit]:
    """Yield the limits of all senses, by the ranges that ``calibrate`` has kept."""
    spec = monitor.spec
    ranges = monitor.ranges_
    for channel in spec.channels:
        part = spec.slices[channel.name]
        columns = range(*part.indices(spec.size))
        if channel.group == MOTOR:
            if CONTROLLER not in monitor.about:  # a simulated controller takes changes
                yield from _of_targets(channel, ranges, columns, margin)
        elif f"{channel.name}_peak" not in spec.slices:
            yield from _of_senses(channel, ranges, columns, margin)


def _of_senses(channel: Channel, ranges: Floats, columns: range, margin: float) -> Iterator[Limit]:
    elements = channel.elements or ("",) * channel.size
    stops = channel.stops or ((-np.inf, np.inf),) * channel.size
    for n, column in enumerate(columns):
        kind = kind_of(channel, elements[n])
        label = channel.labels[n]
        least, most = float(ranges[0, column]), float(ranges[5, column])
        if kind == POSITION:
            yield _of_position(label, channel.unit, stops[n], ranges, column)
        elif kind:
            bound = margin * max(abs(least), abs(most))
            near = share_beyond(ranges, column, -NEAR * bound, NEAR * bound)
            yield _symmetric(kind, label, channel.unit, bound, (least, most), near)


def _of_position(
    label: str, unit: str, stops: tuple[float, float], ranges: Floats, column: int
) -> Limit:
    least, most = float(ranges[0, column]), float(ranges[5, column])
    room = RANGE_MARGIN * (most - least)
    low = max(least - room, min(stops[0], least))
    high = min(most + room, max(stops[1], most))
    return Limit(
        kind=POSITION,
        label=label,
        unit=unit,
        low=low,
        high=high,
        least=least,
        most=most,
        near=share_beyond(ranges, column, low + room, high - room),
    )


def _of_targets(channel: Channel, ranges: Floats, columns: range, margin: float) -> Iterator[Limit]:
    for label, column in zip(channel.labels, columns, strict=True):
        lead = float(ranges[LEAD, column])
        if lead > 0:
            yield _symmetric(TARGET_DISTANCE, label, channel.unit, margin * lead, (-lead, lead))


def _symmetric(
    kind: str,
    label: str,
    unit: str,
    bound: float,
    healthy: tuple[float, float],
    near: float | None = None,
) -> Limit:
    least, most = map(float, healthy)
    return Limit(
        kind=kind,
        label=label,
        unit=unit,
        low=-float(bound),
        high=float(bound),
        least=least,
        most=most,
        near=near,
    )
