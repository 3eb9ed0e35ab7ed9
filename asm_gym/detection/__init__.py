"""From a model's errors to surprise, and from surprise to an alarm."""

from asm_gym.detection.adaptive import AdaptiveThreshold
from asm_gym.detection.alarm_rule import alarms_in
from asm_gym.detection.base import Detection, ModelOutput, Nominal
from asm_gym.detection.conformal import Blocks, conformal_episodes, conformal_threshold
from asm_gym.detection.evidence_detection import EvidenceDetection

__all__ = [
    "AdaptiveThreshold",
    "Blocks",
    "Detection",
    "EvidenceDetection",
    "ModelOutput",
    "Nominal",
    "alarms_in",
    "conformal_episodes",
    "conformal_threshold",
]
