"""The measured numbers that the stream carries, and those that a policy observes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

# Channels of the robot that a policy observes: configuration and motion, no torques.
_OBSERVED = (
    "joint_position",
    "joint_velocity",
    "hand_position",
    "hand_orientation",
    "gripper_opening",
    "gripper_velocity",
)
# Observations are clipped to this, which keeps the Box true; nothing a task does comes near it.
_BOUND = 100.0


class Layout:
    """Cuts rows of measurements into streams and observations.

    Args:
        measured: names a row.
        groups: the channel groups that the stream carries.
        flat: observations are one array, not a dict of named ones.
    """

    def __init__(self, measured: StreamSpec, groups: Sequence[str], flat: bool) -> None:
        chosen = tuple(c for c in measured.channels if c.group in groups)
        self.stream_spec = StreamSpec(chosen, measured.dt, measured.source) if chosen else None
        self.carried = _indices(measured, [c.name for c in chosen])
        """(D,) indices of the numbers that the stream carries."""
        names = [c.name for c in measured.channels if c.name.endswith(_OBSERVED) or c.group == "object"]
        self._to_observation = _indices(measured, names)
        self._slices = {name: measured.slices[name] for name in names}
        self._flat = flat
        self.sizes = {name: s.stop - s.start for name, s in self._slices.items()}
        """The observation's parts in order, and how many numbers each has."""

    def space(self, pictures: dict[str, spaces.Space[Any]]) -> spaces.Space[Any]:
        """Return the space of observations with ``pictures`` added."""
        if not self._flat:
            return spaces.Dict({name: _box(size) for name, size in self.sizes.items()} | pictures)
        state = _box(len(self._to_observation))
        return spaces.Dict({"state": state} | pictures) if pictures else state

    def observation(self, row: NDArray[np.float64], pictures: dict[str, NDArray[np.uint8]]) -> Any:
        """Return the observation of a row (M,); finite whatever the row holds."""
        if not self._flat:
            row32 = _clipped(row)
            return {name: row32[s] for name, s in self._slices.items()} | pictures
        state = _clipped(row[self._to_observation])
        return {"state": state} | pictures if pictures else state


def _clipped(row: NDArray[np.float64]) -> NDArray[np.float32]:
    if not np.isfinite(row).all():
        row = np.nan_to_num(row)
    return row.clip(-_BOUND, _BOUND).astype(np.float32)


def _box(size: int) -> spaces.Space[Any]:
    return spaces.Box(-_BOUND, _BOUND, (size,), np.float32)


def _indices(spec: StreamSpec, names: list[str]) -> NDArray[np.intp]:
    return np.array([i for n in names for i in range(spec.size)[spec.slices[n]]], dtype=np.intp)
