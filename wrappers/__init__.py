"""Gymnasium wrappers: safety, faults, streams and pictures."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from asm_gym.extras import needed_for
from asm_gym.wrappers.recording import StreamRecorder
from asm_gym.wrappers.safety import NeuralASMSafety
from asm_gym.wrappers.vector import VectorNeuralASMSafety

if TYPE_CHECKING:
    from asm_gym.wrappers.faults import FaultInjection
    from asm_gym.wrappers.overlay import SurpriseOverlay

__all__ = [
    "FaultInjection",
    "NeuralASMSafety",
    "StreamRecorder",
    "SurpriseOverlay",
    "VectorNeuralASMSafety",
]

_NEED_MORE = {"FaultInjection": "faults", "SurpriseOverlay": "overlay"}
"""Those that need more than watching a stream does, and are imported when they are asked for."""


def __getattr__(name: str) -> Any:
    if name not in _NEED_MORE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needed_for(name):
        return getattr(import_module(f"asm_gym.wrappers.{_NEED_MORE[name]}"), name)
