"""Columns of a stream, by what its channels are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import HANDLED, Channel, StreamSpec


def columns_where(spec: StreamSpec, selects: Callable[[Channel], bool]) -> NDArray[np.intp]:
    """Return the columns (N,) of the channels that ``selects`` is true of."""
    return np.flatnonzero([selects(channel) for channel in spec.channels for _ in channel.labels])


def handled_columns(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the columns (N,) that tell of handled objects."""
    return columns_where(spec, lambda channel: channel.group == HANDLED)
