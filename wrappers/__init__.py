"""Gymnasium wrappers: safety, faults, streams and pictures."""

from asm_gym.wrappers.fault_injection import FaultInjection
from asm_gym.wrappers.safety import NeuralASMSafety
from asm_gym.wrappers.stream_recorder import StreamRecorder
from asm_gym.wrappers.surprise_overlay import SurpriseOverlay
from asm_gym.wrappers.vector_safety import VectorNeuralASMSafety

__all__ = ["FaultInjection", "NeuralASMSafety", "StreamRecorder", "SurpriseOverlay", "VectorNeuralASMSafety"]
