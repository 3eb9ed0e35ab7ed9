"""A model of one's own, as a user would write it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asm_gym.detection import ModelOutput
from asm_gym.monitors.stream_model import StreamModel


class Seen(NamedTuple):
    last: np.ndarray  # (B, X)


class Persistence(StreamModel):
    """A model of one's own: each sense stays where it is, to ``margin`` standard deviations of its change."""

    kind = "persistence"

    def __init__(self, spec, margin=1.0):
        super().__init__(spec)
        self.margin = margin

    def fit(self, episodes, rng, progress):
        steps = np.concatenate(
            [np.diff(e.stream[:, self.spec.sensory].astype(float), axis=0) for e in episodes]
        )
        return self.restore({"spread": self.margin * steps.std(axis=0)})

    def start(self, batch, told=()):
        return Seen(np.full((batch, len(self.spec.sensory)), np.nan))

    def predict(self, state, rows):
        now = rows[:, self.spec.sensory]
        errors = np.nan_to_num((now - state.last) / self.learned_["spread"])
        return Seen(now), ModelOutput(errors, np.zeros((len(rows), 0)))
