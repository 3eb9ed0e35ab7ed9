"""Where the numbers of a stream stand in an observation, and how estimates replace them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec


@dataclass(frozen=True, eq=False)
class ObservationPart:
    """N numbers of the stream in one array of the observation."""

    key: str  # of the array in a dict observation; empty where the observation is an array
    space: gym.spaces.Space[Any] | None  # of the array
    columns: NDArray[np.intp]  # (N,) of the stream
    entries: NDArray[np.intp]  # (N,) of the flat array

    def replaced(self, array: Any, row: NDArray[np.float32], missing: NDArray[np.bool_]) -> Any:
        """Return a copy of the array with the numbers of a row (D,) where ``missing`` (D,)."""
        wrong = missing[self.columns]
        changed = np.array(array)
        changed.reshape(-1)[self.entries[wrong]] = row[self.columns[wrong]]
        if isinstance(self.space, gym.spaces.Box):
            changed = np.clip(changed, self.space.low, self.space.high).astype(self.space.dtype)
        return changed


class ObservationMap:
    """Where the numbers of a stream stand in an observation.

    Args:
        parts: of the observation.
        size: D, how many columns the stream has.
    """

    def __init__(self, parts: Sequence[ObservationPart], size: int) -> None:
        self._parts = parts
        self.observed = np.zeros(size, bool)
        """(D,) the columns in the observation, which are all that a policy can read."""
        for part in parts:
            self.observed[part.columns] = True

    def repaired(
        self,
        observation: Any,
        row: NDArray[np.float32],
        missing: NDArray[np.bool_],
    ) -> Any:
        """Return the observation with the numbers of a row (D,) where ``missing`` (D,)."""
        for part in self._parts:
            if not missing[part.columns].any():
                continue
            if part.key:
                array = part.replaced(observation[part.key], row, missing)
                observation = {**observation, part.key: array}
            else:
                observation = part.replaced(observation, row, missing)
        return observation


def parts_of(
    layout: dict[str, int],
    spec: StreamSpec,
    space: gym.spaces.Space[Any],
) -> list[ObservationPart]:
    """Return where the channels of a stream stand in an observation.

    Args:
        layout: the sizes of the observation's channels in order, by name.
        spec: of the stream.
        space: a Box of all channels, a dict with such a Box as ``state``, or a dict with an
            array for each channel.
    """
    arrays: Any = {"": space}
    if isinstance(space, gym.spaces.Dict):
        arrays = space.spaces
    flat_key = next((key for key in ("", "state") if key in arrays), None)

    parts = []
    start = 0
    for name, size in layout.items():
        key = name
        entries = np.arange(size)
        if flat_key is not None:
            key = flat_key
            entries += start
            start += size
        if name in spec.slices:
            columns = np.arange(spec.size)[spec.slices[name]]
            parts.append(ObservationPart(key, arrays.get(key), columns, entries))
    return parts
