"""Rows of measurements: all sensors read at once, the stream that carries some of them, and a policy's observation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.backend import ObjectSensors
from asm_gym.envs.sensors import Corruption
from asm_gym.envs.simulation import Simulation
from asm_gym.spec import MOTOR, Channel, StreamSpec

# Channels of the robot that a policy observes: configuration and motion, no torques.
_OBSERVED = (
    *("joint_position", "joint_velocity", "hand_position", "hand_orientation"),
    *("gripper_opening", "gripper_velocity"),
)
_BOUND = 100.0
"""Observations are clipped to this, which keeps the Box true; nothing a task does comes near it."""


class Reading(NamedTuple):
    """One row of measurements."""

    row: NDArray[np.float64]  # (M,) everything
    stream: NDArray[np.float32]  # (D,) the part that the stream carries
    row_finite: bool
    stream_finite: bool


class Senses:
    """Reads the sensors of one environment.

    Args:
        channels: of the arms and objects.
        actions: size of an action.
        dt: time between two rows [s].
        source: name of the robots.
        groups: the channel groups that the stream carries.
        noise: scale of the sensors' noise; at 0 readings are exact, without resolution.
        flat: observations are one array, not a dict of named ones.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        actions: int,
        dt: float,
        source: str,
        groups: Sequence[str],
        noise: float,
        flat: bool,
    ) -> None:
        spec = self.measured_spec = StreamSpec((*channels, Channel("action", actions, "1", 0.0, MOTOR)), dt, source)
        """Everything that is measured, whether or not the stream carries it."""
        chosen = tuple(c for c in spec.channels if c.group in groups)
        self.stream_spec = StreamSpec(chosen, dt, source) if chosen else None
        self._carried = _indices(spec, [c.name for c in chosen])
        self._noise = spec.noise * noise
        self._steps = spec.resolution if noise else np.zeros(spec.size)
        self._needs_objects = "object" in groups
        names = [c.name for c in spec.channels if c.name.endswith(_OBSERVED) or c.group == "object"]
        self._observed = _indices(spec, names)
        self._slices = {name: spec.slices[name] for name in names}
        self._flat = flat
        self.sizes = {name: s.stop - s.start for name, s in self._slices.items()}
        """The observation's parts in order, and how many numbers each has."""

    def read(
        self,
        simulation: Simulation,
        objects: ObjectSensors,
        action: NDArray[np.float32],
        faults: Sequence[Corruption],
        rng: np.random.Generator,
        within_step: bool = False,
    ) -> Reading:
        """Read every sensor once, over the time since the last row of the stream: noise, faults, resolution.

        Within a step, objects keep their last pose if the stream does not carry them.
        """
        if faults or self._needs_objects or not within_step:
            self._object_poses = np.concatenate([*objects.read(), np.zeros(0)])
        row = simulation.sense(np.concatenate([self._object_poses, action]), self._noise, rng)
        for corrupt in faults:
            corrupt(row)
        stream = np.empty(len(self._carried), np.float32)
        return Reading(row, stream, *kernels.quantise(row, self._steps, self._carried, stream))

    def space(self) -> spaces.Space[Any]:
        """Return the space of observations."""
        if self._flat:
            return _box(len(self._observed))
        return spaces.Dict({name: _box(size) for name, size in self.sizes.items()})

    def observation(self, row: NDArray[np.float64]) -> Any:
        """Return the observation of a row (M,); finite whatever the row holds."""
        if self._flat:
            return _clipped(row[self._observed])
        row32 = _clipped(row)
        return {name: row32[s] for name, s in self._slices.items()}


def _clipped(row: NDArray[np.float64]) -> NDArray[np.float32]:
    if not np.isfinite(row).all():
        row = np.nan_to_num(row)
    return row.clip(-_BOUND, _BOUND).astype(np.float32)


def _box(size: int) -> spaces.Space[Any]:
    return spaces.Box(-_BOUND, _BOUND, (size,), np.float32)


def _indices(spec: StreamSpec, names: list[str]) -> NDArray[np.intp]:
    return np.array([i for n in names for i in range(spec.size)[spec.slices[n]]], dtype=np.intp)
