"""Monitors: the Neural ASM and its baselines, behind one protocol."""

from __future__ import annotations

from asm_gym.monitors.calibrated_monitor import CalibratedMonitor as CalibratedMonitor
from asm_gym.monitors.memory_config import MemoryConfig as MemoryConfig
from asm_gym.monitors.monitor_protocol import ExpectsActions as ExpectsActions
from asm_gym.monitors.monitor_protocol import ExplainsItself as ExplainsItself
from asm_gym.monitors.monitor_protocol import ForgetsEvidence as ForgetsEvidence
from asm_gym.monitors.monitor_protocol import Monitor as Monitor
from asm_gym.monitors.monitor_protocol import Surprise as Surprise
from asm_gym.monitors.monitor_registry import DETECTIONS as DETECTIONS
from asm_gym.monitors.monitor_registry import MONITORS as MONITORS
from asm_gym.monitors.monitor_registry import load_monitor as load_monitor
from asm_gym.monitors.monitor_registry import make_monitor as make_monitor
from asm_gym.monitors.monitor_registry import monitor_class as monitor_class
from asm_gym.monitors.monitor_registry import register_monitor as register_monitor
from asm_gym.monitors.neural_asm import NeuralASM as NeuralASM
from asm_gym.monitors.shipped import pretrained as pretrained
from asm_gym.monitors.shipped import pretrained_for as pretrained_for
from asm_gym.monitors.stream_model import StreamModel as StreamModel
