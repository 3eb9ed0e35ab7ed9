"""How far each sense goes at its worst in healthy episodes, as evidence counts it and the senses excuse it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import Excuses
from asm_gym.detection.evidence_detection import EvidenceDetection
from asm_gym.episode import Episode
from asm_gym.monitors.base import Model
from asm_gym.monitors.stream_model import model_outputs

AT_ONCE = 400
"""Episodes: what is made of all rows of many hours would fill the memory."""


def worst_of(
    model: Model, detection: EvidenceDetection, excuses: Excuses | None, episodes: Sequence[Episode]
) -> NDArray[np.float64]:
    """(N, G, X) the largest v in each of N episodes.

    Surprise is v to some power of a half or less, so that v counts less by the square of what divides surprise.
    """
    detector = detection.detector_
    assert detector is not None
    found = []
    for first in range(0, len(episodes), AT_ONCE):
        some = episodes[first : first + AT_ONCE]
        for episode, output in zip(some, model_outputs(model, some), strict=True):
            strengths, _ = detector.strengths(output)
            if excuses is not None:
                strengths /= excuses.divisors(episode.stream)[:, None, None] ** 2
            found.append(strengths.max(axis=0))
    return np.array(found)
