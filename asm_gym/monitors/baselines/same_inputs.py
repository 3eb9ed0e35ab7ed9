"""Rivals that read what the memory's values are told by: friction by speed and weight by angles, as if commanded.

    u_t = φ(x_{t-1})        of the row before, for of its own row an innovation would be told by itself

They know nothing of arms by themselves, and are asked here whether that is all that they lack.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.baselines.arm_inputs import Derived
from asm_gym.spec import MOTOR, Channel, StreamSpec

FAINTEST = 1e-9


class Informed:
    """A monitor on streams with further inputs.

    Args:
        spec: of the streams without.
        make: the monitor of a spec.
        urdf: text of a body model; empty where sines of angles say weight.
    """

    def __init__(self, spec: StreamSpec, make: Callable[[StreamSpec], Any], urdf: str = "") -> None:
        self.spec, self.make, self._derived = spec, make, Derived.of(spec, friction=True, body=True, urdf=urdf)

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """The spreads of what was sensed, and the monitor."""
        values = [self._values(episode) for episode in episodes]
        self._spread = np.maximum(np.concatenate(values).std(axis=0), FAINTEST)
        steps = np.concatenate([np.diff(v, axis=0) for v in values])
        self._change = np.maximum(steps.std(axis=0), FAINTEST)
        self._monitor = self.make(self._informed(episodes[0]).spec).fit([self._informed(e) for e in episodes])
        return self

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """As the monitor does, of the same episodes with further inputs."""
        found: list[Surprise] = self._monitor.score_episodes([self._informed(e) for e in episodes])
        return found

    def _values(self, episode: Episode) -> NDArray[np.float64]:
        return episode.stream[:, self.spec.sensory].astype(np.float64)

    def _informed(self, episode: Episode) -> Episode:
        values = self._values(episode)
        steps = np.diff(values, axis=0, prepend=values[:1]) / self._change
        inputs = self._derived(values, steps, self._spread, self._change / self.spec.dt)
        if not inputs.shape[1]:
            return episode
        before = np.concatenate([inputs[:1], inputs[:-1]])
        spec = replace(self.spec, channels=(*self.spec.channels, Channel("of_arms", inputs.shape[1], group=MOTOR)))
        return Episode.from_stream(np.hstack([episode.stream, before]).astype(np.float32), spec)
