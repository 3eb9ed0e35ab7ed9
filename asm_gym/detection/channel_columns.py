"""Columns of a stream, by what its channels are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import Channel, StreamSpec


def columns_where(spec: StreamSpec, selects: Callable[[Channel], bool]) -> NDArray[np.intp]:
    """Return the columns (N,) of the channels that ``selects`` is true of."""
    return np.flatnonzero([selects(channel) for channel in spec.channels for _ in channel.labels])
