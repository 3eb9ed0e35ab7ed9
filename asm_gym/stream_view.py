"""Rows of a stream as a memory reads them that knows only a part of it, or also knows handled objects."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.exceptions import SpecMismatch
from asm_gym.spec import CARRIED_CHANNEL, HANDLED, StreamSpec

LOG = logging.getLogger("asm_gym.stream")

NO_OBJECT = -1.0  # what ``CARRIED_CHANNEL`` says where no object is tracked


class StreamView:
    """Give a memory the numbers that it knows, of rows that hold others too.

    Channels that the memory does not know are left out. Channels of the group ``HANDLED`` that the stream does not
    have, as of a robot without a tracker, say that no object is tracked: then nothing is judged or predicted by them.
    Whether a channel is a sense or a command is for the memory to say.

    Args:
        offered: the stream's spec.
        wanted: the memory's spec.

    Attributes:
        left_out: names of channels that the memory does not know.
        filled: names of channels of ``HANDLED`` that the stream does not have.

    Raises:
        SpecMismatch: another channel is missing or different, or the rates differ.

    Example:
        >>> import numpy as np
        >>> from asm_gym import Channel, StreamSpec
        >>> position, current = Channel("position", 1, "m"), Channel("current", 1, "A")
        >>> view = StreamView(StreamSpec((current, position), dt=0.05), StreamSpec((position,), dt=0.05))
        >>> view.left_out, view.rows(np.array([[7.0, 1.0]])).tolist()
        (('current',), [[1.0]])
    """

    def __init__(self, offered: StreamSpec, wanted: StreamSpec) -> None:
        misfits = misfits_of(wanted, offered)
        if misfits:
            raise SpecMismatch("the monitor", misfits)
        known = {channel.name for channel in wanted.channels}
        self.left_out = tuple(c.name for c in offered.channels if c.name not in known)
        self.filled: tuple[str, ...] = ()
        self._default = np.zeros(wanted.size, np.float32)
        columns: list[int] = []
        places: list[int] = []
        for channel in wanted.channels:
            own = wanted.slices[channel.name]
            if channel.name in offered.slices:
                there = offered.slices[channel.name]
                columns += range(there.start, there.stop)
                places += range(own.start, own.stop)
                continue
            self.filled += (channel.name,)
            if channel.name.endswith(CARRIED_CHANNEL):
                self._default[own] = NO_OBJECT
        self._columns = np.array(columns, np.intp)
        self._places = np.array(places, np.intp)
        everything = np.arange(wanted.size)
        same_columns = np.array_equal(self._columns, everything)
        self._is_identity = offered.size == wanted.size and same_columns

    def rows(self, offered: NDArray[Any]) -> NDArray[Any]:
        """Return rows (..., D) as the memory reads them, of rows (..., D') of the stream."""
        if self._is_identity:
            return offered
        rows = np.empty((*offered.shape[:-1], len(self._default)), offered.dtype)
        rows[...] = self._default
        rows[..., self._places] = offered[..., self._columns]
        return rows

    def written_back(self, row: NDArray[Any], offered: NDArray[Any]) -> NDArray[Any]:
        """Return a row (D',) of the stream, with the numbers of a row (D,) of the memory in their places."""
        written = np.array(offered)
        written[self._columns] = row[self._places]
        return written

    def describe(self) -> None:
        """Log what is left out, and what is filled in."""
        if self.left_out:
            LOG.warning(
                "the memory does not know %s: these channels are not watched",
                ", ".join(self.left_out),
            )
        if self.filled:
            LOG.warning(
                "the stream does not have %s: the memory goes by its other senses",
                ", ".join(self.filled),
            )


def misfits_of(wanted: StreamSpec, offered: StreamSpec) -> list[str]:
    """Return one line for each reason why a memory of ``wanted`` cannot read a part of the stream ``offered``."""
    known = {channel.name for channel in wanted.channels}
    common = tuple(channel for channel in offered.channels if channel.name in known)
    there = {channel.name for channel in common}
    needed = tuple(
        channel for channel in wanted.channels if channel.name in there or channel.group != HANDLED
    )
    if not common or not needed:
        return wanted.difference(offered)
    in_order = sorted(common, key=lambda channel: list(wanted.slices).index(channel.name))
    try:
        part = replace(offered, channels=tuple(in_order))
        need = replace(wanted, channels=needed)
    except ValueError:  # commands alone
        return wanted.difference(offered)
    return need.difference(part)
