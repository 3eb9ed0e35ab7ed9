"""Faults that any environment with Box spaces can have, each kind at three severities, and where they act on it.

A sense is wrong by so many σ: its declared noise, or else how far it moves in a nominal episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.faults import action, sensor
from asm_gym.faults.base import Fault, Interface
from asm_gym.faults.suite import SEVERITIES
from asm_gym.validation import check_choice


class Struck(NamedTuple):
    """What is drawn for an episode: where a fault strikes."""

    channel: str
    element: int
    sigma: float  # of that sense
    axis: int  # of the action
    half: float  # of that axis's range
    everything: tuple[str, ...]  # channels
    onset: int
    seed: int

    @property
    def sense(self) -> dict[str, Any]:
        return {"channel": self.channel, "element": self.element} | self.when

    @property
    def when(self) -> dict[str, Any]:
        return {"onset": self.onset, "seed": self.seed}


Kind = Callable[[Struck, int], tuple[Fault, ...]]


def _all(d: Struck, kind: type[sensor.SensorFault], **how: Any) -> tuple[Fault, ...]:
    """The same fault of every channel."""
    return tuple(kind(channel=name, element=None, **how, **d.when) for name in d.everything)


KINDS: dict[str, Kind] = {
    "frozen_sense": lambda d, s: (sensor.Freeze(**d.sense, duration=(5, 15, None)[s]),),
    "sense_offset": lambda d, s: (sensor.Bias(**d.sense, amount=(1, 3, 10)[s] * d.sigma),),
    "sense_drift": lambda d, s: (sensor.Drift(**d.sense, rate=(0.05, 0.2, 0.8)[s] * d.sigma),),
    "sense_noise": lambda d, s: (sensor.Noise(**d.sense, std=(0.3, 1, 3)[s] * d.sigma),),
    "sense_scale": lambda d, s: (sensor.Scale(**d.sense, factor=(1.05, 1.15, 1.5)[s]),),
    "sense_dropout": lambda d, s: (sensor.Dropout(**d.sense, probability=(0.05, 0.2, 0.5)[s]),),
    "sense_delay": lambda d, s: (sensor.Delay(**d.sense, steps=(1, 3, 6)[s]),),
    "late_rows": lambda d, s: _all(d, sensor.Delay, steps=(1, 3, 6)[s]),
    "lost_rows": lambda d, s: _all(d, sensor.Freeze, duration=(1, 5, 15)[s]),
    "action_scale": lambda d, s: (action.ActionScale(factor=(0.9, 0.75, 0.5)[s], **d.when),),
    "action_delay": lambda d, s: (action.ActionDelay(steps=(1, 3, 6)[s], **d.when),),
    "action_drop": lambda d, s: (action.ActionDrop(probability=(0.1, 0.3, 0.7)[s], **d.when),),
    "action_repeat": lambda d, s: (action.ActionRepeat(steps=(2, 4, 8)[s], **d.when),),
    "action_bias": lambda d, s: (
        action.ActionBias(axis=d.axis, amount=(0.05, 0.15, 0.4)[s] * min(d.half, 5.0), **d.when),
    ),
    "sign_flip": lambda d, s: (action.SignFlip(axis=d.axis, duration=(3, 10, None)[s], **d.when),),
}
"""Faults of each kind for an episode, at severity 0 to 2. Lost rows: every sense keeps its last value meanwhile."""


def sigmas(env: Interface, streams: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """(X,) of each sense: its noise, or its spread in the episode where it moves least; 0 of one that stays.

    Args:
        streams: (T, X) what was sensed in nominal episodes.
    """
    spread = np.min([np.std(stream, axis=0, dtype=np.float64) for stream in streams], axis=0)
    noise = env.measured_spec.noise
    return np.where(spread > 0, np.where(noise > 0, noise, spread), 0.0)


def faults_anywhere(
    kind: str, env: Interface, sigma: NDArray[np.float64], severity: str, onset: int, seed: int
) -> tuple[Fault, ...]:
    """The faults of one kind and severity for the episode with this seed.

    Args:
        sigma: (X,) of each sense, as ``sigmas`` makes it; one that never moves is not struck.

    Raises:
        ValueError: an unknown kind or severity, or no sense that moves.
    """
    check_choice("kind of fault", kind, KINDS)
    check_choice("severity", severity, SEVERITIES)
    moving = np.flatnonzero(sigma > 0)
    if not len(moving):
        raise ValueError("no sense of this environment moves, so that none can be struck")
    rng = np.random.default_rng([seed, 2])
    spec, struck = env.measured_spec, int(rng.choice(moving))
    name, place = next((n, span) for n, span in spec.slices.items() if span.start <= struck < span.stop)
    axis = int(rng.integers(len(_halves(env))))
    drawn = Struck(
        channel=name,
        element=struck - place.start,
        sigma=float(sigma[struck]),
        axis=axis,
        half=float(_halves(env)[axis]),
        everything=tuple(spec.slices),
        onset=onset,
        seed=seed,
    )
    return KINDS[kind](drawn, SEVERITIES.index(severity))


def _halves(env: Interface) -> NDArray[np.float64]:
    """(A,) half of the range of each number of the action."""
    space: Any = env.action_space
    return np.ravel(0.5 * (space.high - space.low)).astype(np.float64)
