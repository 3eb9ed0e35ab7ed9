"""What the arms of one environment are to feel in the control step that begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.contact_limits import NO_LIMITS, ContactLimits
from asm_gym.spec import Channel
from asm_gym.validation import shown


class Expected(NamedTuple):
    """What the arms are to feel in the substeps of a control step, as ``Simulation.felt`` lays it out."""

    low: NDArray[np.float64]  # (N,) [N m], [N]
    high: NDArray[np.float64]  # (N,)
    most: NDArray[np.float64]  # (N,) contact limits, infinite where there are none
    stays: bool  # the arms stay from the substep after that in which they felt anything else


class Expectation:
    """Limits that hold for long, and a band for one step within them."""

    def __init__(self) -> None:
        self._known: ContactLimits | None = None
        self._within: Expected | None = None  # as the limits that are known have it
        self.forget()

    def forget(self) -> None:
        """There is no band."""
        self._band: tuple[NDArray[np.float64], NDArray[np.float64], bool] | None = None

    def expect(self, felt: Sequence[Channel], low: NDArray[np.float64], high: NDArray[np.float64], stays: bool) -> None:
        """Takes up a band for the next step; see ``RobosuiteEnv.expect``."""
        bounds = np.asarray(low, np.float64), np.asarray(high, np.float64)
        size = sum(c.size for c in felt)
        if any(b.shape != (size,) for b in bounds) or not (bounds[0] <= bounds[1]).all():
            raise ValueError(f"a band needs a least and a most for each of {size} numbers, got {shown(bounds)}")
        self._band = (*bounds, stays)

    def taken(self, felt: Sequence[Channel], limits: ContactLimits | None) -> Expected | None:
        """What is expected in this step; the same object as before where nothing has changed. None for anything."""
        band, self._band = self._band, None
        if band is None and limits is None:
            return None
        if self._within is None or limits is not self._known:
            most = (limits or NO_LIMITS).most(felt)
            self._known, self._within = limits, Expected(-most, most, most, limits is not None and limits.stays)
        within = self._within
        if band is None:
            return within
        low, high = np.maximum(band[0], within.low), np.minimum(band[1], within.high)
        return Expected(low, high, within.most, band[2] or within.stays)
