"""Everything that can watch a stream: the Neural ASM and its rivals, behind one protocol."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from asm_gym.monitors.base import Monitor, Surprise
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.stream import StreamSpec

__all__ = ["MONITORS", "Monitor", "NeuralASM", "Surprise", "make_monitor"]

MONITORS: dict[str, Callable[..., Monitor]] = {"neural_asm": NeuralASM}
"""Every monitor by its name."""


def make_monitor(name: str, spec: StreamSpec, **kwargs: Any) -> Monitor:
    """A monitor by name, not yet fitted.

    Args:
        name: for example ``neural_asm``.
        spec: the stream it is to watch.
        **kwargs: hyperparameters of that monitor.

    Raises:
        ValueError: there is no monitor of that name.
    """
    if name not in MONITORS:
        raise ValueError(f"unknown monitor {name!r}; known are: {', '.join(sorted(MONITORS))}")
    return MONITORS[name](spec, **kwargs)
