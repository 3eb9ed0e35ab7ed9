"""Gymnasium wrappers: safety, faults and streams."""

from typing import TYPE_CHECKING, Any

from asm_gym.extras import needed_for
from asm_gym.wrappers.recording import StreamRecorder
from asm_gym.wrappers.safety import NeuralASMSafety
from asm_gym.wrappers.vector_safety import VectorNeuralASMSafety

if TYPE_CHECKING:
    from asm_gym.wrappers.faults import FaultInjection

__all__ = [
    "FaultInjection",
    "NeuralASMSafety",
    "StreamRecorder",
    "VectorNeuralASMSafety",
]


def __getattr__(name: str) -> Any:
    """Import the wrapper that needs more than watching a stream does, once it is asked for."""
    if name != "FaultInjection":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with needed_for(name):
        from asm_gym.wrappers.faults import FaultInjection
    return FaultInjection
