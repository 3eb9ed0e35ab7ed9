"""Where the numbers of a stream stand in an observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec


class ObservationMap:
    """Where the numbers of a stream stand in an observation of this space.

    ``layout`` are the parts of the observation in order, by the names of channels, and their sizes; ``own`` is the
    space of that layout. Without a stream of its own, observation and action are the stream. Raises ValueError where
    the environment does not say where they stand, or a wrapper inside has changed the observation.
    """

    def __init__(
        self,
        space: spaces.Space[Any],
        spec: StreamSpec,
        has_stream: bool,
        layout: dict[str, int] | None = None,
        own: spaces.Space[Any] | None = None,
    ) -> None:
        self._space, senses = space, len(spec.sensory)
        if not has_stream and isinstance(space, spaces.Box):
            self._places = [("", spec.sensory, np.arange(senses))]
        elif not has_stream or layout is None:
            raise ValueError("the environment does not say where its stream stands in its observation")
        elif own is not None and space != own:
            raise ValueError(f"a wrapper inside has changed the observation, which was {own}")
        else:
            self._places = _laid_out(layout, spec, space)
        self.shown = np.zeros(spec.size, bool)
        """(D,) which columns stand in the observation; a policy that sees nothing else cannot read the others."""
        for _, columns, _ in self._places:
            self.shown[columns] = True

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


def _laid_out(
    layout: dict[str, int], spec: StreamSpec, space: spaces.Space[Any]
) -> list[tuple[str, NDArray[np.intp], NDArray[np.intp]]]:
    """Return part, columns and entries of each channel in a flat observation, its ``state``, or a dict of arrays."""
    named = isinstance(space, spaces.Dict) and "state" not in space.spaces
    flat = "state" if isinstance(space, spaces.Dict) else ""
    found, start = [], 0
    for name, size in layout.items():
        if name in spec.slices:
            columns = np.arange(spec.size)[spec.slices[name]]
            found.append((name if named else flat, columns, np.arange(size) + (0 if named else start)))
        start += size
    return found
