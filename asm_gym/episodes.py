"""Episodes: what happened between a reset and its end, as arrays of one length."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.stream import StreamSpec


def _empty() -> NDArray[np.float32]:
    return np.zeros((0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T control steps.

    Args:
        stream: (T, D) float32, the sensorimotor stream; row t was sensed after action t. (k T, D) where the stream runs
            k times faster than control.
        spec: names the D numbers.
        success: the task was solved at some step.
        seed: what ``reset`` was given.
        actions: (T, A) float32, as the policy commanded them.
        observations: (T + 1, O) float32, the first one from ``reset``.
        rewards: (T,) float32.
        faults: (T,) bool, a fault was active in that row of the stream (the ground truth).
        info: whatever else is worth keeping; JSON-serialisable.
    """

    stream: NDArray[np.float32]
    spec: StreamSpec
    success: bool = False
    seed: int | None = None
    actions: NDArray[np.float32] = field(default_factory=_empty)
    observations: NDArray[np.float32] = field(default_factory=_empty)
    rewards: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    faults: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    info: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stream.ndim != 2:
            raise ValueError(f"an episode's stream must have the shape (T, D), got {self.stream.shape}")
        self.spec.check_row(self.stream)

    def __len__(self) -> int:
        return len(self.stream)

    @classmethod
    def from_stream(cls, x: NDArray[np.floating[Any]], spec: StreamSpec, **fields: Any) -> Episode:
        """An episode from a stream recorded elsewhere, a real robot's included: ``x`` has the shape (T, D)."""
        return cls(np.ascontiguousarray(x, dtype=np.float32), spec, **fields)
