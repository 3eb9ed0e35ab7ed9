"""What an environment may be able to do beyond Gymnasium's contract, said as typed protocols."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.kinematics import Chain
from asm_gym.spec import Channel, StreamSpec


@runtime_checkable
class HasGrippers(Protocol):
    """Some numbers of its action command grippers."""

    gripper_actions: tuple[int, ...]


@runtime_checkable
class HoldsItself(Protocol):
    """It can stay where it is, whatever its controller, and whatever wrappers make of an action on its way."""

    holding: bool
    """Set, the arms stay in the next control step, and the grippers keep what they were told; the step unsets it."""

    keeps_holding: bool
    """Set, no step unsets ``holding``: for wrappers in between that make several steps of one."""


@runtime_checkable
class TurnsJoints(Protocol):
    """Its actions can be found that turn the arms' joints."""

    controller: str

    def action_for(self, turns: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """(A,) the action that turns the joints by so much [rad]."""
        ...


@runtime_checkable
class SensesWithinSteps(Protocol):
    """Its stream can run faster than control, and its action be replaced within a step."""

    row_hooks: list[Callable[[NDArray[np.float32]], None]]
    stream_freq: int

    def stream_spec_at(self, rate: int) -> StreamSpec:
        """Of the stream at another rate [Hz]. Raises ValueError for one that does not fit."""
        ...

    def command(self, action: NDArray[np.float32]) -> None:
        """From within a hook: another action for the rest of the control step."""
        ...


@runtime_checkable
class LimitsContact(Protocol):
    """It compares what its arms feel with limits in every physics substep, and stays where one is passed."""

    felt_channels: tuple[Channel, ...]
    contact_limits: ContactLimits | None
    """Of this episode; ``reset`` forgets them."""


@runtime_checkable
class LaysOutObservations(Protocol):
    """It says what its observations are made of."""

    observation_layout: dict[str, int]
    """Their parts in order, by the names of channels, and how many numbers each has."""


@runtime_checkable
class LocatesForces(Protocol):
    """It knows the geometry of its arm, and so what force would cause given torques in its joints."""

    def force_behind(self, torques: NDArray[np.floating[Any]]) -> tuple[str, NDArray[np.float64]]:
        """The link on which a force would explain external torques (J,) best [N m], and that force (3,) [N]."""
        ...


@runtime_checkable
class KnowsItsArms(Protocol):
    """It knows where its hands are by the angles of their arms' joints, and senses them by themselves too."""

    hand_chains: tuple[Chain, ...]
