"""Estimators of scikit-learn as models: whatever has ``fit`` and ``score_samples``, such as ``IsolationForest``.

    features    v_t, Δ_t, u_t          standardised values and changes of the senses, and the command
    error       (m - score(features)) / σ    m and σ of nominal rows that it has not learned; of no sense in particular

A file keeps the rows that it learned from, never a pickle: it is fitted anew when it is read, from the same seed.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.state import RowHistory
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec

MOST_ROWS = 20_000
"""What it learns from at most, drawn evenly: many estimators take the square of their number in time."""


class EstimatorModel(ScaledModel):
    """An estimator's score of each row, by itself.

    Args:
        spec: the stream it is to expect.
        seed: of the estimator, where it takes a ``random_state``.
    """

    kind = "estimator"
    estimator: ClassVar[Any]
    """The class, made with its own defaults."""

    def __init__(self, spec: StreamSpec, seed: int = 0) -> None:
        super().__init__(spec)
        self.seed = seed

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return np.array([-1], np.intp)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams)
        rows = np.concatenate([_features(senses.read_episode(stream)) for stream in streams])
        chosen = rng.permutation(len(rows))[: 2 * MOST_ROWS]
        half = (len(chosen) + 1) // 2
        return self.restore({**senses.arrays, "rows": rows[chosen[:half]], "others": rows[chosen[half:]]})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        seeded = "random_state" in inspect.signature(self.estimator).parameters
        made = self.estimator(**({"random_state": self.seed} if seeded else {}))
        made.fit(np.asarray(learned["rows"], np.float32))
        usual = _scores(made, np.asarray(learned["others"], np.float32))
        self._fitted, self._centre, self._spread = made, float(usual.mean()), max(float(usual.std()), 1e-9)
        return super().restore(learned, skills)

    def predict(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, reading, _ = read_next(self.senses_, state, rows)
        error = np.maximum(0.0, self._centre - _scores(self._fitted, _features(reading))) / self._spread
        return state, ModelOutput(reading.whole * error[:, None], no_context(rows))


def adapted(kind: type[Any]) -> type[EstimatorModel]:
    """The model of a class of estimators; it goes by the name of the class, in small letters."""
    return type(f"{kind.__name__}Model", (EstimatorModel,), {"kind": kind.__name__.lower(), "estimator": kind})


def _features(reading: ScaledRows) -> NDArray[np.float32]:
    """(B, F) of rows that were read."""
    return np.hstack([reading.senses, reading.changes, reading.commands[:, :-1]])


def _scores(estimator: Any, features: NDArray[np.float32]) -> NDArray[np.float64]:
    """(B,) the higher the more usual. Raises ValueError for any other shape."""
    found = np.asarray(estimator.score_samples(features), np.float64)
    if found.shape != (len(features),):
        name = type(estimator).__name__
        raise ValueError(f"score_samples of {name} must give ({len(features)},) for as many rows, got {found.shape}")
    return found
