"""From a model's errors to surprise, and from surprise to an alarm."""

from asm_gym.detection.adaptive import AdaptiveThreshold
from asm_gym.detection.base import Detection, ModelOutput, Nominal
from asm_gym.detection.conformal import (
    Blocks,
    Promise,
    alarms_in,
    check_per_hour,
    conformal_episodes,
    conformal_threshold,
    hourly_promise,
    hourly_threshold,
)
from asm_gym.detection.detector import Detector
from asm_gym.detection.evidence_detection import EvidenceDetection

__all__ = [
    "AdaptiveThreshold",
    "Blocks",
    "Detection",
    "Detector",
    "EvidenceDetection",
    "ModelOutput",
    "Nominal",
    "Promise",
    "alarms_in",
    "check_per_hour",
    "conformal_episodes",
    "conformal_threshold",
    "hourly_promise",
    "hourly_threshold",
]
