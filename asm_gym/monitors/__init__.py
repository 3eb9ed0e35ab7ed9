"""Monitors: the Neural ASM and its baselines, behind one protocol."""

from __future__ import annotations

from asm_gym.monitors.base import (
    ExpectsActions,
    ExplainsItself,
    ForgetsEvidence,
    Monitor,
    Surprise,
)
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.memory_config import MemoryConfig
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.monitors.registry import (
    DETECTIONS,
    EVIDENCE,
    MONITORS,
    load_monitor,
    make_monitor,
    monitor_class,
    register_monitor,
)
from asm_gym.monitors.shipped import pretrained, pretrained_for
from asm_gym.monitors.stream_model import StreamModel

__all__ = [
    "DETECTIONS",
    "EVIDENCE",
    "MONITORS",
    "CalibratedMonitor",
    "ExpectsActions",
    "ExplainsItself",
    "ForgetsEvidence",
    "MemoryConfig",
    "Monitor",
    "NeuralASM",
    "StreamModel",
    "Surprise",
    "load_monitor",
    "make_monitor",
    "monitor_class",
    "pretrained",
    "pretrained_for",
    "register_monitor",
]
