"""Sends a band down before every control step, and says how far and when it was left."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors import Monitor, NeuralASM, Surprise
from asm_gym.monitors.monitor import MonitorState
from asm_gym.monitors.spinal import UNJUDGED, Band, SpinalBand
from asm_gym.protocols import FeelsWithinSteps
from asm_gym.validation import shown


class Left(NamedTuple):
    """A band that was left in a control step.

    Attributes:
        times: how many half-widths from its middle the arm felt; above 1.
        column: the number of the stream that was farthest.
        after_s: when, after the step began [s].
    """

    times: float
    column: int
    after_s: float

    def added_to(self, surprise: Surprise, threshold: float) -> Surprise:
        """Surprise of as many times its threshold, where it is less; what it is more by is that number's."""
        more = self.times * threshold - float(surprise.value[0])
        if not more > 0.0:
            return surprise
        attribution = surprise.attribution.copy()
        attribution[0, self.column] += more
        return surprise._replace(value=surprise.value + more, attribution=attribution)


class SpinalCord:
    """What connects a memory's band with one environment's physics substeps.

    Where the environment does not feel within steps, the band is compared with the row that ends a step, and a warning
    says so: the reflex then comes a step later.

    Args:
        env: wrapped or not; its stream has the channels of the band.
        band: calibrated.
        monitor: what watches; the memory of the band, or one with its weights.
        acts: the arm stays from the substep after the band was left.

    Raises:
        ValueError: the band is of another memory, or ``env`` has other arms.
        RuntimeError: the band was never calibrated.
    """

    def __init__(self, env: gym.Env[Any, Any], band: SpinalBand, monitor: Monitor, acts: bool) -> None:
        if not isinstance(band, SpinalBand):
            raise TypeError(f"spinal must be a SpinalBand, got {shown(band)}")
        if not isinstance(monitor, NeuralASM) or monitor.network_ is not band.memory.network_:
            raise ValueError("the band is of another memory than the one that watches: make it with that")
        self.promise = band.promise
        """Which share of nominal episodes stays within."""
        self._band, self._acts = band, acts
        inner = env.unwrapped
        self._arm = inner if isinstance(inner, FeelsWithinSteps) else None
        if self._arm is None:
            gym.logger.warn(f"{inner} does not feel within control steps: the band is compared once a step, at its end")
        elif (names := tuple(c.name for c in self._arm.felt_channels)) != band.names:
            raise ValueError(f"the band is for {', '.join(band.names)}, and this arm feels {', '.join(names)}")
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self._sent: Band | None = None
        self._unjudged = 0  # steps of the policy for which there is no band

    def pause(self) -> None:
        """Something else than the policy acts, from which the memory expects nothing that a nominal episode shows."""
        self._unjudged = UNJUDGED

    def send(self, state: MonitorState, action: NDArray[np.floating[Any]]) -> None:
        """Says what is expected of a step that is about to be made by the policy; nothing where it has just begun."""
        if self._unjudged:
            self._unjudged -= 1
            return
        self._sent = self._band.expect(state.model, action)
        if self._arm is not None and self._sent is not None:
            self._arm.expect(*self._sent, self._acts)

    def left(self, row: NDArray[np.floating[Any]]) -> Left | None:
        """How the band of the step that ended with ``row`` (D,) was left; None where it was not, or none was sent."""
        sent, self._sent = self._sent, None
        if sent is None:
            return None
        if self._arm is None:
            felt, after = self._band.felt_in(row), self._band.spec.dt
        elif self._arm.left_band_s is None:
            return None
        else:
            felt, after = self._arm.felt, self._arm.left_band_s
        times = sent.times(felt)
        farthest = int(np.argmax(times))
        if not times[farthest] > 1.0:
            return None
        return Left(float(times[farthest]), int(self._band.columns[farthest]), after)
