"""Where the numbers of a stream stand in an observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec


class Place(NamedTuple):
    """Where columns of a stream stand in a part of an observation."""

    part: str  # of a dict; empty for an array
    columns: NDArray[np.intp]
    entries: NDArray[np.intp]


class ObservationMap:
    """Where the numbers of a stream stand in the observation.

    Args:
        space: of the observation.
        spec: of the stream.
        has_stream: the environment says its stream; else observation and action are it.
        layout: parts of the observation in order, by the names of channels, and how many numbers each has.
        own: the space that the layout is of; it must be that of the observation.

    Raises:
        ValueError: it is not known where they stand: the environment does not say, or a wrapper inside has changed the
            observation.
    """

    def __init__(
        self,
        space: spaces.Space[Any],
        spec: StreamSpec,
        has_stream: bool,
        layout: dict[str, int] | None = None,
        own: spaces.Space[Any] | None = None,
    ) -> None:
        self._space = space
        if layout is not None and has_stream:
            if own is not None and space != own:
                raise ValueError(f"a wrapper inside has changed the observation, which was {own}")
            self._places = _laid_out(layout, spec, space)
        elif not has_stream and isinstance(space, spaces.Box):
            self._places = [Place("", spec.sensory, np.arange(len(spec.sensory)))]
        else:
            raise ValueError("the environment does not say where its stream stands in its observation")
        self.shown = np.zeros(spec.size, bool)
        """(D,) which columns stand in the observation; a policy that sees nothing else cannot read the others."""
        for place in self._places:
            self.shown[place.columns] = True

    def repaired(self, observation: Any, row: NDArray[np.float32], missing: NDArray[np.bool_]) -> Any:
        """Return the observation with the numbers of ``row`` (D,) where they are ``missing`` (D,)."""
        for part, columns, entries in self._places:
            wrong = missing[columns]
            if not wrong.any():
                continue
            array = np.array(observation[part] if part else observation)
            array.reshape(-1)[entries[wrong]] = row[columns[wrong]]
            box = self._space[part] if isinstance(self._space, spaces.Dict) else self._space
            if isinstance(box, spaces.Box):
                array = np.clip(array, box.low, box.high).astype(box.dtype)
            observation = {**observation, part: array} if part else array
        return observation


def _laid_out(layout: dict[str, int], spec: StreamSpec, space: spaces.Space[Any]) -> list[Place]:
    """Return the places of channels in a flat observation, in its ``state``, or in a dict of named arrays."""
    named = isinstance(space, spaces.Dict) and "state" not in space.spaces
    flat = "state" if isinstance(space, spaces.Dict) else ""
    found, start = [], 0
    for name, size in layout.items():
        if name in spec.slices:
            columns = np.arange(spec.size)[spec.slices[name]]
            entries = np.arange(size) + (0 if named else start)
            found.append(Place(name if named else flat, columns, entries))
        start += size
    return found
