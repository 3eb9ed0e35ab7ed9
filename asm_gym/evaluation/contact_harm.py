"""Harm by contact: the contact forces of an episode, summed up.

    harm = ∫ max(f(t) - 40 N, 0) dt

f is the greatest contact force on the arm, in each physics substep.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import FREE_FORCE

FIRST_S = 0.1  # duration of the first blow, from its first substep on [s]


class ContactHarm(NamedTuple):
    """What the contact forces of an episode add up to."""

    harm: float  # force beyond ``FREE_FORCE``, summed over time [N s]
    peak: float  # the greatest force [N]
    first: float  # the greatest force of the first blow [N]
    over_s: float  # time with more than ``FREE_FORCE`` [s]


def harm_of(force: NDArray[np.floating[Any]], frequency: float) -> ContactHarm:
    """Return the harm in a contact force (T,) [N], sampled at ``frequency`` [Hz]."""
    excess = np.maximum(force - FREE_FORCE, 0.0)
    is_over = excess > 0
    first_blow = 0.0
    if is_over.any():
        start = int(is_over.argmax())
        stop = start + round(FIRST_S * frequency)
        first_blow = float(force[start:stop].max())
    return ContactHarm(
        harm=float(excess.sum() / frequency),
        peak=float(force.max(initial=0.0)),
        first=first_blow,
        over_s=float(is_over.sum() / frequency),
    )
