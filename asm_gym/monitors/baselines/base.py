"""What rivals add to a predictive monitor: a score of their own, as their authors published it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.detector import Run, whitening
from asm_gym.monitors.base import State
from asm_gym.monitors.monitor import Progress
from asm_gym.monitors.predictive import PredictiveMonitor, PredictiveState
from asm_gym.scaling import ScaledRows, StreamScaler

EVIDENCE = "+evidence"
"""What the name of a rival ends in where its errors are judged by the detection of the Neural ASM."""


class Baseline(PredictiveMonitor):
    """A model whose errors are scored as its authors did, or, with ``own_score`` False, as the Neural ASM's are.

    The arguments are those of ``PredictiveMonitor``; they matter for the latter only.
    """

    own_score: ClassVar[bool] = True

    def learn(self, streams: Sequence[NDArray[np.float32]], progress: Progress) -> dict[str, NDArray[Any]]:
        learned = super().learn(streams, progress)
        self.learned_ = learned
        return learned | self.learn_score(self._runs(streams))

    def shares(self, state: PredictiveState, rows: NDArray[np.float64]) -> tuple[PredictiveState, NDArray[np.float64]]:
        if not self.own_score:
            return super().shares(state, rows)
        model, errors, _ = self.predict(state.model, rows)
        parts = self.published(model, np.asarray(errors, np.float64))
        return state._replace(model=model), self.attribute(parts)

    def learn_score(self, runs: Sequence[Run]) -> dict[str, NDArray[Any]]:
        """What ``published`` needs to know of the errors in nominal episodes."""
        return {}

    def published(self, model: State, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """(B, X) each error's share of the score; >= 0. Here the sum of squares."""
        return errors**2


class Mahalanobis(Baseline):
    """A rival that scores by the Mahalanobis distance of its prediction errors: ‖M ε‖², C of nominal steps."""

    def learn_score(self, runs: Sequence[Run]) -> dict[str, NDArray[Any]]:
        return {"mahalanobis": whitening(np.concatenate([r.errors for r in runs]), self.shrinkage)}

    def published(self, model: State, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        parts: NDArray[np.float64] = (errors @ self.learned_["mahalanobis"]) ** 2
        return parts


class Rows(NamedTuple):
    """The rows a rival remembers, one a stream."""

    before: NDArray[np.float64]  # (B, D) the row seen last; what was not finite in it is as it was before
    steps: NDArray[np.int64]  # (B,) how many were seen

    def then(self, rows: NDArray[np.float64]) -> Rows:
        """With the next rows (B, D)."""
        return Rows(np.where(np.isfinite(rows), rows, self.before), self.steps + 1)


def no_rows(batch: int, size: int) -> Rows:
    """Nothing seen yet."""
    return Rows(np.zeros((batch, size)), np.zeros(batch, np.int64))


def read(senses: StreamScaler, seen: Rows, rows: NDArray[np.float64]) -> ScaledRows:
    """The next rows, as the Neural ASM reads them; before the first nothing has moved."""
    before = np.where(seen.steps[:, None] > 0, seen.before, rows)
    return senses.read(rows, before, before)


def with_evidence(rival: type[Baseline]) -> type[Baseline]:
    """The same model, judged by the detection of the Neural ASM; either reads what the other has saved."""
    return type(rival.__name__ + "Evidence", (rival,), {"own_score": False})
