"""No threshold that a strong fault could not pass: a monitor that is blind to a channel says so, to most is refused.

One channel that hardly moved while learning, and moved while calibrating, can set a threshold that nothing else comes
up to. Asked of each sense: would its own errors, at the bound where they count no more, and for ever, raise an alarm?
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

LOG = logging.getLogger("asm_gym.monitors")

MOST = 0.6
"""A monitor that is blind to more than this share of the channels is refused."""

SHOWN = 6
"""Channels that a message names."""


def blind_to(detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float) -> list[str]:
    """Labels of the senses whose errors alone could never pass the threshold, where the detection knows.

    Args:
        detection: one that may say what each error can reach.
        errors: (X,) where each error belongs in the stream; -1 for none.
    """
    if not hasattr(detection, "reach_of"):
        return []
    reach = np.zeros(spec.size)
    own = np.flatnonzero(errors >= 0)
    np.maximum.at(reach, errors[own], detection.reach_of(own))
    judged = np.unique(errors[own])
    return [spec.labels[i] for i in judged if not reach[i] > threshold]


def require_sight(detection: Any, errors: NDArray[np.intp], spec: StreamSpec, threshold: float) -> None:
    """Says in which channels no fault could pass the threshold. Raises ValueError where they are most.

    From few episodes some are no more than a bad threshold, which the next calibration mends.
    """
    blind = blind_to(detection, errors, spec, threshold)
    if not blind:
        return
    named = ", ".join(blind[:SHOWN]) + (f" and {len(blind) - SHOWN} more" if len(blind) > SHOWN else "")
    said = (
        f"the threshold came to {threshold:.3g}, which no fault of {named} could pass, however strong: an episode "
        "to calibrate on is unlike those learned from, or a channel hardly moved in them: learn from more"
    )
    if len(blind) > MOST * len(np.unique(errors[errors >= 0])):
        raise ValueError(said)
    LOG.warning(said)
