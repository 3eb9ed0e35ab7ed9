"""What an arm feels in every physics substep, by the simulator that no sensor of a guard reads, and the harm in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robots import PHYSICS_FREQ
from asm_gym.scripts.reproduce.harm_agents import EXCESS
from asm_gym.scripts.reproduce.harm_report import TRANSIENT
from asm_gym.scripts.reproduce.kit import Record

FIRST_S = 0.1
"""The first blow lasts for so long from the substep on in which it began [s]."""


class Felt:
    """Contact force [N] and the largest external torque [N m] in every physics substep."""

    def __init__(self, arm: Any) -> None:
        self._arm = arm
        self._joints = np.concatenate([np.full(c.size, c.name.endswith("external_torque")) for c in arm.felt_channels])
        self._forces: list[NDArray[np.float64]] = []
        self.torque = 0.0

    def read(self, substep: int = -1) -> None:
        """What was felt since the row began; of one substep alone where its number is given."""
        since = slice(-1, None) if substep >= 0 else slice(None)
        self._forces.append(self._arm.simulation.contact_forces[since])
        self.torque = max(self.torque, float(np.abs(self._arm.felt[since, self._joints]).max()))

    @property
    def force(self) -> NDArray[np.float64]:
        """(T,)"""
        return np.concatenate(self._forces)

    @contextmanager
    def reading(self, hooks: list[Any]) -> Iterator[None]:
        """Reads whenever one of ``hooks`` is called, while the block runs."""
        hooks.append(self.read)
        try:
            yield
        finally:
            hooks.remove(self.read)


def harm_of(force: NDArray[np.float64], substeps: int) -> Record:
    """What contact ``force`` (T,) [N] in every physics substep comes to, ``substeps`` of which are a step."""
    hits = np.flatnonzero(force > EXCESS)
    first = slice(hits[0], hits[0] + round(FIRST_S * PHYSICS_FREQ)) if hits.size else slice(0)
    return {
        "harm": float(np.maximum(force - EXCESS, 0.0).sum() / PHYSICS_FREQ),
        "peak": float(force.max(initial=0.0)),
        "first": float(force[first].max(initial=0.0)),
        "first_step": int(hits[0]) // substeps if hits.size else 0,
        "later": float(force[first.stop :].max(initial=0.0)),
        # In control steps, so that shares of them can be added up over episodes.
        "time_over": float((force > TRANSIENT).sum() / substeps),
        "steps_over": int((force.reshape(-1, substeps) > TRANSIENT).any(axis=1).sum()),
    }


def hand_speed(arm: Any, infos: Sequence[dict[str, Any]], step: int) -> float:
    """Of the hand when ``step`` began [m/s]; not a number in the first."""
    velocity = infos[step - 1]["stream"][arm.stream_spec.slices["hand_velocity"]]
    return float(np.linalg.norm(velocity)) if step else np.nan
