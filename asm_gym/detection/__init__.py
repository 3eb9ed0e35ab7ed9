"""From a model's errors to surprise, and from surprise to an alarm."""

from __future__ import annotations

from asm_gym.detection.adaptive import AdaptiveThreshold, RunningThreshold
from asm_gym.detection.base import Detection, ModelOutput, Nominal
from asm_gym.detection.conformal import Promise, conformal_episodes, conformal_threshold
from asm_gym.detection.detector import Detector
from asm_gym.detection.evidence import Evidence, accumulated, no_evidence, pool, strength
from asm_gym.detection.evidence_detection import EvidenceDetection, EvidenceState
from asm_gym.detection.hourly import Blocks, alarms_in, check_per_hour, hourly_promise, hourly_threshold
from asm_gym.detection.tails import worst_case
from asm_gym.detection.whitening import bounded, whitening

__all__ = [
    "AdaptiveThreshold",
    "Blocks",
    "Detection",
    "Detector",
    "Evidence",
    "EvidenceDetection",
    "EvidenceState",
    "ModelOutput",
    "Nominal",
    "Promise",
    "RunningThreshold",
    "accumulated",
    "alarms_in",
    "bounded",
    "check_per_hour",
    "conformal_episodes",
    "conformal_threshold",
    "hourly_promise",
    "hourly_threshold",
    "no_evidence",
    "pool",
    "strength",
    "whitening",
    "worst_case",
]
