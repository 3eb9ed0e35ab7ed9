"""The simplest baseline: what each sense is, so many steps after the beginning.

    s_t = Σ_i ((x_t,i - m_t,i) / σ_t,i)²        mean and spread over nominal episodes at step t

Whoever starts late or moves slower is wrong all along: it shows how much of a detection is only timing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.stream_model import StreamModel

SMOOTH = 2
"""Steps before and after whose rows count too."""


class _Clock(NamedTuple):
    steps: NDArray[np.int64]  # (B,)


class ElapsedTime(StreamModel):
    """Mean and spread of every sense at every step."""

    kind = "elapsed_time"

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        xs = [e.stream[:, self.spec.sensory].astype(np.float64) for e in episodes]
        overall = np.maximum(np.concatenate(xs).std(axis=0), 1e-6)
        mean, spread = [], []
        for t in range(max(map(len, xs))):
            near = np.concatenate([x[max(0, t - SMOOTH) : t + SMOOTH + 1] for x in xs])
            mean.append(near.mean(axis=0))
            spread.append(near.std(axis=0) + 0.01 * overall)
        return self.restore({"mean": np.array(mean), "spread": np.array(spread)})

    def start(self, batch: int, told: Sequence[Told] = ()) -> _Clock:
        return _Clock(np.zeros(batch, np.int64))

    def predict(self, state: _Clock, rows: NDArray[np.float64]) -> tuple[_Clock, ModelOutput]:
        t = np.minimum(state.steps, len(self.learned_["mean"]) - 1)
        error = (rows[:, self.spec.sensory] - self.learned_["mean"][t]) / self.learned_["spread"][t]
        return _Clock(state.steps + 1), ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))
