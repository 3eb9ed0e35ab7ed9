"""What everything that acts has in common: stable-baselines3's ``predict``."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

PolicyState = Any
"""What a policy carries from step to step: a value, passed in and handed back. None starts an episode."""


@runtime_checkable
class Policy(Protocol):
    """Acts. Every stable-baselines3 model is one."""

    def predict(
        self,
        observation: Any,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """The action for ``observation``, and the state to pass in next time."""
        ...


@runtime_checkable
class Reflex(Policy, Protocol):
    """A policy that is told of every step, and starts from what was done last."""

    def reset(self) -> None:
        """A new episode begins."""
        ...

    def feel(self, row: NDArray[np.floating[Any]], executed: NDArray[np.float32], acting: bool) -> None:
        """Take in what was sensed in a step, and what was done.

        Args:
            row: (D,) of the stream; NaN where it is missing.
            executed: (A,).
            acting: whether this reflex did it.
        """
        ...

    def begin(self, executed: NDArray[np.float32]) -> Any:
        """Return the state to start from, after ``executed`` (A,)."""
        ...


@runtime_checkable
class Seeded(Protocol):
    """What draws at random and can be told to draw the same again, as every stable-baselines3 model can."""

    def set_random_seed(self, seed: int) -> None:
        """All that is drawn from now on follows from ``seed``."""
        ...
