"""The sensorimotor stream: ``x_t = [sensed_t, commanded_t]``, one row a control step, or several.

The sensors are read after the control step in which the action was commanded (the efference copy).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain
from numbers import Real
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.exceptions import DamagedFile, SpecMismatch
from asm_gym.validation import check_number, short_repr, typed

LOG = "table"  # source of streams that were read from logs
UNNAMED = {"", "spaces", LOG}  # sources of streams that do not say which robot it is
MOTOR = "action"  # the group that holds the commanded action
HANDLED = "handled"  # the group of the object at the hand, as a tracker of poses sees it
CARRIED_CHANNEL = "object_carried"  # its channel that says how the object moves


@dataclass(frozen=True)
class Channel:
    """Describe one named signal of one or more numbers.

    Args:
        name: for example ``joint_position``.
        size: how many numbers it has.
        unit: SI unit, ``"1"`` without a unit.
        noise: standard deviation of the sensor noise [unit]; 0 if unknown.
        group: for example ``joint`` or ``wrench``; a memory predicts each group from the others. The group ``action``
            is the commanded action.
        elements: a name for each number; by default ``0, 1, …``.
        resolution: smallest difference of two readings [unit]; 0 if unknown or computed from several sensors.
        stops: (least, most) of each joint [unit]; empty if unknown.
        commanded: a controller has put it out, as a commanded torque or a desired current. It is a command (an
            efference copy) as the group ``action`` is: it predicts the senses, and is not judged.

    Example:
        >>> from asm_gym import Channel
        >>> wrist = Channel("wrench", 3, "N", noise=0.5, elements=("x", "y", "z"))
        >>> wrist.labels
        ('wrench[x]', 'wrench[y]', 'wrench[z]')
    """

    name: str
    size: int
    unit: str = "1"
    noise: float = 0.0
    group: str = "sense"
    elements: tuple[str, ...] = ()
    resolution: float = 0.0
    stops: tuple[tuple[float, float], ...] = ()
    commanded: bool = False

    def __post_init__(self) -> None:
        who = f"channel {self.name!r}"
        check_number(f"{who}: size", self.size, low=1, whole=True)
        check_number(f"{who}: noise", self.noise, low=0.0, infinite=True)
        check_number(f"{who}: resolution", self.resolution, low=0.0)
        if not isinstance(self.elements, tuple):
            raise TypeError(
                f"{who}: elements must be a tuple of names, got {short_repr(self.elements)}"
            )
        if not isinstance(self.stops, tuple) or not all(map(_is_pair, self.stops)):
            raise TypeError(
                f"{who}: stops must be a tuple of pairs (least, most), got {short_repr(self.stops)}"
            )
        for what, values in (("element names", self.elements), ("pairs of stops", self.stops)):
            if values and len(values) != self.size:
                raise ValueError(f"{who} has size {self.size} but {len(values)} {what}")

    @property
    def is_command(self) -> bool:
        """Whether it is a command, and not a sense."""
        return self.commanded or self.group == MOTOR

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of each number, such as ``joint_position[3]``; the bare name for a single number."""
        if self.size == 1 and not self.elements:
            return (self.name,)
        elements: Iterable[object] = self.elements or range(self.size)
        return tuple(f"{self.name}[{element}]" for element in elements)


def _is_pair(stops: Any) -> bool:
    """Return whether a joint's stops are two numbers, the least first."""
    if not isinstance(stops, tuple) or len(stops) != 2:
        return False
    are_numbers = all(isinstance(stop, Real) for stop in stops)
    return are_numbers and bool(stops[0] < stops[1])


@dataclass(frozen=True)
class StreamSpec:
    """Describe the numbers of a stream row, and the rate of rows.

    Args:
        channels: in their order in a row.
        dt: time between two rows [s]: the control period, or a fraction of it.
        source: name of the robot, for example ``Panda``; not compared between specs.

    Example:
        >>> from asm_gym import Channel, StreamSpec
        >>> spec = StreamSpec((Channel("position", 2, "m"), Channel("command", 1, "m/s", group="action")), dt=0.01)
        >>> spec.size, spec.labels
        (3, ('position[0]', 'position[1]', 'command'))
    """

    channels: tuple[Channel, ...]
    dt: float
    source: str = ""

    def __post_init__(self) -> None:
        is_tuple = isinstance(self.channels, tuple)
        if not is_tuple or not all(isinstance(channel, Channel) for channel in self.channels):
            raise TypeError(
                f"channels must be a tuple of Channel objects, got {short_repr(self.channels)}"
            )
        names = [channel.name for channel in self.channels]
        if len(set(names)) != len(names):
            raise ValueError(f"channel names must be unique, got {names}")
        if all(channel.is_command for channel in self.channels):
            raise ValueError("a stream needs at least one channel that is not an action")
        check_number("dt", self.dt, above=0.0)

    def __repr__(self) -> str:
        """Return source, rate, and size and unit of each channel."""
        parts = [f"{c.name} ({c.size}) [{c.unit}]" for c in self.channels]
        source = self.source or "a stream"
        return f"<StreamSpec of {source} at {1 / self.dt:g} Hz: {', '.join(parts)}>"

    @cached_property
    def size(self) -> int:
        """D, the length of a row."""
        return sum(channel.size for channel in self.channels)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """D names, one for each number in a row."""
        return tuple(label for channel in self.channels for label in channel.labels)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Columns of each channel in a row."""
        slices = {}
        start = 0
        for channel in self.channels:
            slices[channel.name] = slice(start, start + channel.size)
            start += channel.size
        return slices

    @property
    def units(self) -> tuple[str, ...]:
        """D units, one for each of ``labels``."""
        return tuple(self._of_each_number("unit"))

    @property
    def groups(self) -> tuple[str, ...]:
        """D groups, one for each of ``labels``."""
        return tuple(self._of_each_number("group"))

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """(D,) standard deviation of the sensor noise [unit of each channel]."""
        return np.array(self._of_each_number("noise"), np.float64)

    @cached_property
    def resolution(self) -> NDArray[np.float64]:
        """(D,) smallest difference of two readings [unit of each channel]; 0 where unknown."""
        return np.array(self._of_each_number("resolution"), np.float64)

    @cached_property
    def motor(self) -> NDArray[np.intp]:
        """Indices of the commanded action, which a policy gives."""
        return np.flatnonzero([group == MOTOR for group in self.groups])

    @cached_property
    def commanded(self) -> NDArray[np.intp]:
        """Indices of all commands: the action, and what controllers put out."""
        return np.flatnonzero(self._of_each_number("is_command"))

    @cached_property
    def sensory(self) -> NDArray[np.intp]:
        """Indices of everything that is sensed."""
        return np.flatnonzero(np.logical_not(self._of_each_number("is_command")))

    def _of_each_number(self, attribute: str) -> list[Any]:
        """Return D values: an attribute of the channel that each number belongs to."""
        return [getattr(channel, attribute) for channel in self.channels for _ in channel.labels]

    def check_row(self, stream: NDArray[np.floating[Any]]) -> None:
        """Raise ValueError unless the last axis of ``stream`` is D long."""
        if stream.ndim < 1 or stream.shape[-1] != self.size:
            names = ", ".join(channel.name for channel in self.channels)
            raise ValueError(
                f"a stream of this spec has {self.size} numbers a step ({names}), "
                f"got an array of shape {stream.shape}"
            )

    def difference(self, other: StreamSpec) -> list[str]:
        """Return one line for each reason why a memory of this spec cannot read streams of ``other``."""
        own_channels = {channel.name: channel for channel in self.channels}
        other_channels = {channel.name: channel for channel in other.channels}
        lines = [f"{name}: missing" for name in own_channels if name not in other_channels]
        lines += [f"{name}: new" for name in other_channels if name not in own_channels]
        for name, own in own_channels.items():
            if name in other_channels:
                lines += _channel_difference(own, other_channels[name])
        if not lines and list(own_channels) != list(other_channels):
            lines.append(f"order: {', '.join(own_channels)} against {', '.join(other_channels)}")
        if abs(self.dt - other.dt) > 1e-9:
            lines.append(f"dt: {self.dt} s against {other.dt} s")
        return lines

    def require(self, other: StreamSpec, whose: str) -> None:
        """Raise SpecMismatch naming the channels that differ, unless ``other`` can be read with this spec."""
        lines = self.difference(other)
        if lines:
            raise SpecMismatch(whose, lines)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    @typed
    def from_json(cls, text: str) -> StreamSpec:
        """Read what ``to_json`` wrote. Raises DamagedFile where it is something else."""
        try:
            raw = json.loads(text)
            channels = tuple(_channel_from_json(saved) for saved in raw["channels"])
            return cls(channels, raw["dt"], raw["source"])
        except (ValueError, TypeError, KeyError) as error:
            reason = f"{error}, in {short_repr(text)}"
            raise DamagedFile("the text of a stream's spec", reason) from error

    @classmethod
    @typed
    def from_spaces(
        cls, observation: spaces.Space[Any], action: spaces.Space[Any], dt: float = 1.0
    ) -> StreamSpec:
        """Return the spec of an environment that has no stream of its own: its observation, then the action.

        A dict observation has a channel for each key, ``outer.inner`` where nested; discrete values are one-hot.

        Raises:
            TypeError: either space cannot be read as a row of numbers.
        """
        for name, space in (("observation", observation), ("action", action)):
            if not space.is_np_flattenable:
                raise TypeError(
                    f"the {name} space must be numbers to be read as a stream, got {space}"
                )
        motor = Channel("action", spaces.flatdim(action), group=MOTOR)
        return cls((*_channels_of_space(observation), motor), dt, "spaces")


def _channel_difference(own: Channel, other: Channel) -> list[str]:
    """Return the first way in which a channel differs from one of the same name, as a line or none."""
    for attribute in ("size", "unit", "group"):
        expected = getattr(own, attribute)
        got = getattr(other, attribute)
        if expected != got:
            return [f"{own.name}: {attribute} {expected} against {got}"]
    return []


def _channel_from_json(saved: dict[str, Any]) -> Channel:
    """Return the channel that JSON holds."""
    elements = tuple(saved["elements"])
    stops = tuple(map(tuple, saved.get("stops", ())))
    return Channel(**saved | {"elements": elements, "stops": stops})


def _channels_of_space(space: spaces.Space[Any], keys: tuple[str, ...] = ()) -> list[Channel]:
    """Return a channel for each key of a dict, in Gymnasium's order of flattening; one of anything else."""
    if isinstance(space, spaces.Dict):
        parts = [_channels_of_space(part, (*keys, str(key))) for key, part in space.items()]
        return list(chain.from_iterable(parts))
    size = spaces.flatdim(space)
    if not size:
        return []
    return [Channel(".".join(keys) or "observation", size)]


def flat(space: spaces.Space[Any], value: Any) -> NDArray[Any]:
    """Return an observation or action (n,) as ``StreamSpec.from_spaces`` lays it out."""
    if isinstance(space, spaces.Box):
        return np.ravel(value)
    return np.asarray(spaces.flatten(space, value))


def flat_rows(space: spaces.Space[Any], values: Any, rows: int) -> NDArray[np.float32]:
    """Return (rows, n) of so many observations or actions, which dicts hold by key."""
    if isinstance(space, spaces.Dict):
        return np.hstack([flat_rows(part, values[key], rows) for key, part in space.items()])
    if not isinstance(space, spaces.Box):
        values = [spaces.flatten(space, value) for value in values]
    return np.array(values, np.float32).reshape(rows, -1)
