"""From a model's errors to surprise, and from surprise to an alarm: each step a module, any model's errors will do."""

from __future__ import annotations

import warnings
from typing import Any

from asm_gym.detection import evidence, repetition, tails
from asm_gym.detection.adaptive import AdaptiveThreshold, RunningThreshold
from asm_gym.detection.base import Detection, ModelOutput, Nominal
from asm_gym.detection.conformal import Promise, conformal_episodes, conformal_threshold
from asm_gym.detection.detector import Detector, EvidenceDetection, EvidenceState
from asm_gym.detection.evidence import Evidence, accumulate, no_evidence, pool, strength
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
    "accumulate",
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

_RENAMED: dict[str, tuple[str, Any]] = {
    "Run": ("ModelOutput", ModelOutput),
    "LIGHT": ("tails.TAIL_INDEX", tails.TAIL_INDEX),
    "WORST": ("tails.NOMINAL_QUANTILE", tails.NOMINAL_QUANTILE),
    "DOUBT": ("tails.TAIL_PRIOR_COUNT", tails.TAIL_PRIOR_COUNT),
    "LATELY": ("evidence.CONTEXT_GAIN", evidence.CONTEXT_GAIN),
    "SURE": ("repetition.REPETITION_OFFSET", repetition.REPETITION_OFFSET),
}


def __getattr__(name: str) -> Any:
    """What a name of before is called now."""
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now, value = _RENAMED[name]
    warnings.warn(f"asm_gym.detection.{name} is now asm_gym.detection.{now}", DeprecationWarning, stacklevel=2)
    return value
