"""Gymnasium wrappers: safety, faults, streams and pictures."""

from asm_gym.wrappers.faults import FaultInjection
from asm_gym.wrappers.overlay import SurpriseOverlay
from asm_gym.wrappers.recording import StreamRecorder
from asm_gym.wrappers.safety import NeuralASMSafety
from asm_gym.wrappers.vector import VectorNeuralASMSafety

__all__ = ["FaultInjection", "NeuralASMSafety", "StreamRecorder", "SurpriseOverlay", "VectorNeuralASMSafety"]
