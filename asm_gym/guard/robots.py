"""What the engine knows of the robots that it guards."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.kinematics import Chain
from asm_gym.spec import Channel, StreamSpec

NO_COLUMNS = np.zeros(0, np.intp)

NOTHING: Mapping[int, Any] = MappingProxyType({})
"""Where there is nothing to say of any robot."""


@dataclass(frozen=True, eq=False)
class Robots:
    """n robots of one kind, as far as a guard asks.

    Args:
        count: n.
        low, high: (A,) bounds of the actions.
        rest: (A,) the action for which a robot stays, or what comes nearest to it.
        rests: ``rest`` is known to make a robot stay.
        brakes: the robots stay by themselves where they are told to, whatever the action is.
        grip: (G,) places of the action that command grippers.
        dt: control period [s].
        chains: of each arm, its kinematics in each of the n robots.
        felt_channels: what the arms feel in physics substeps; empty where they feel nothing there.
        limits_contact: the robots compare what they feel with contact limits in every physics substep.
        read: (D,) which columns of the stream stand in the observation; None where that is not known.
        turn: the action (A,) that turns the joints of robot i by so much (J,) [rad]; None where there is none.
        force_behind: link and force (3,) [N] that explain external torques (J,) of robot i; None where not known.
        refused: for each reflex that these robots cannot do, why.
    """

    count: int
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    rest: NDArray[np.float32]
    rests: bool = True
    brakes: bool = False
    grip: NDArray[np.intp] = field(default_factory=lambda: NO_COLUMNS)
    dt: float = 1.0
    chains: tuple[tuple[Chain, ...], ...] = ()
    felt_channels: tuple[Channel, ...] = ()
    limits_contact: bool = False
    read: NDArray[np.bool_] | None = None
    turn: Callable[[int, NDArray[np.floating[Any]]], NDArray[np.float32]] | None = None
    force_behind: Callable[[int, NDArray[np.floating[Any]]], tuple[str, NDArray[np.float64]]] | None = None
    refused: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def felt_size(self) -> int:
        """F, how many numbers the arms feel in physics substeps."""
        return sum(c.size for c in self.felt_channels)

    @classmethod
    def unknown(cls, spec: StreamSpec, read: NDArray[np.bool_] | None = None) -> Self:
        """Return one robot of which nothing is known but its stream."""
        size = len(spec.motor)
        unbounded = np.full(size, np.inf, np.float32)
        return cls(1, -unbounded, unbounded, np.zeros(size, np.float32), dt=spec.dt, read=read)
