"""Everything that can watch a stream: the Neural ASM and its rivals, behind one protocol."""

from __future__ import annotations

import inspect
from typing import Any

from asm_gym.choices import check_choice
from asm_gym.monitors.autoregression import Autoregression
from asm_gym.monitors.base import Monitor, Surprise
from asm_gym.monitors.limits import ExternalTorqueLimit, ForceLimit
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.stream import StreamSpec

__all__ = ["MONITORS", "Monitor", "NeuralASM", "Surprise", "make_monitor"]

MONITORS: dict[str, type[Any]] = {
    "neural_asm": NeuralASM,
    "autoregression": Autoregression,
    "external_torque_limit": ExternalTorqueLimit,
    "force_limit": ForceLimit,
}
"""Every monitor by its name."""


def make_monitor(name: str, spec: StreamSpec, **kwargs: Any) -> Monitor:
    """A monitor by name, not yet fitted.

    Args:
        name: for example ``neural_asm``.
        spec: the stream it is to watch.
        **kwargs: hyperparameters of that monitor.

    Raises:
        ValueError: there is no monitor of that name, or it has no such hyperparameter; the message lists what exists.
    """
    check_choice("monitor", name, MONITORS)
    known = [p for p in inspect.signature(MONITORS[name]).parameters if p != "spec"]
    for parameter in kwargs:
        check_choice(f"hyperparameter of {name}", parameter, known)
    monitor: Monitor = MONITORS[name](spec, **kwargs)
    return monitor
