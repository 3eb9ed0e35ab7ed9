"""Skill surprise: whether a row is how any skill that was shown goes on, whatever the body does.

    [x̂_t, â_t] = D [c_{t-1}, 1]        c: the traces of ``memory.traces``; D by ridge regression, in closed form
    ε_t = ([x_t, a_t] - [x̂_t, â_t]) / s

There is no efference copy: the command is judged too. Under a policy that is lost the body moves as always, but no
skill that was shown goes on like that.

Source: Hoerl and Kennard 1970 for ridge regression; ``memory.linear`` for how its penalty is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.linear import check_inputs, learn_linear
from asm_gym.memory.state import RowHistory
from asm_gym.memory.traces import DECAYS, advance, at_rest, fit_gains
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler, rows_apart
from asm_gym.spec import StreamSpec

FAINTEST = 1e-4
"""Smallest spread of an error, in standard deviations of what is expected."""

Rows = NDArray[np.float64]


class SkillState(NamedTuple):
    """Where a skill is, one entry a stream; a value, never changed in place."""

    traces: NDArray[np.float32]  # (B, I) c
    history: RowHistory


class SkillModel(ScaledModel):
    """Ridge regression of the next row on the traces; no context."""

    kind = "memory_skill"

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec, rows_apart(spec.dt))

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """Of values, of the changes of slow channels, and of the command."""
        return np.concatenate([self.spec.sensory, self.senses_.slow, self.spec.motor])

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams, self.lag)
        N = senses.size + len(self.spec.motor)
        check_inputs(N + len(DECAYS) * (N + 1) + 1)
        rows = [_row(senses.read_episode(s))[:: self.lag] for s in streams]
        gains = fit_gains(rows)
        before = np.concatenate([_traces(r, gains)[:-1] for r in rows])
        now = np.concatenate([r[1:, :N] for r in rows])
        known = np.hstack([now, before, np.ones((len(now), 1), np.float32)])
        D = learn_linear(known, np.zeros(N, np.intp), slice(0, N))[:, N:]
        left = np.sqrt(np.mean((now - known[:, N:] @ D.T) ** 2, axis=0))
        return self.restore({**senses.arrays, "gains": gains, "D": D, "remainder": np.maximum(left, FAINTEST)})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        super().restore(learned, skills)
        N = self.senses_.size + len(self.spec.motor)
        shape = N, len(DECAYS) * (N + 1) + 1
        if learned["D"].shape != shape:
            raise ValueError(f"D of a skill should be of shape {shape}, found {learned['D'].shape}")
        return self

    def start(self, batch: int) -> SkillState:
        width = self.senses_.size + len(self.spec.motor) + 1
        return SkillState(at_rest(batch, width), super().start(batch))

    def predict(self, state: SkillState, rows: Rows) -> tuple[SkillState, ModelOutput]:
        (history, reading, _), found = read_next(self.senses_, state.history, rows), self.learned_
        steps = state.history.steps
        row, N = _row(reading), found["D"].shape[0]
        expected = state.traces @ found["D"][:, :-1].T + found["D"][:, -1]  # (B, N)
        seen = np.hstack([reading.seen, reading.finite[:, self.spec.motor]])
        error = seen * (row[:, :N] - expected) / found["remainder"]
        # Nothing is expected of the first row, nor of rows in between, which the traces do not take up.
        due = (steps % self.lag == 0)[:, None]
        error[~due[:, 0] | (steps == 0)] = 0.0
        row[:, :N] = np.where((seen > 0) | (steps == 0)[:, None], row[:, :N], expected)
        traces = np.where(due, advance(state.traces, row, found["gains"]), state.traces)
        return SkillState(traces, history), ModelOutput(error, no_context(rows))


def _row(reading: ScaledRows) -> NDArray[np.float32]:
    """Return what the traces take up (B, N + 1): senses, command and 1."""
    return np.hstack([reading.senses, reading.commands])


def _traces(rows: NDArray[np.float32], gains: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the traces c_t (T, I) of rows (T, R)."""
    c, found = at_rest(1, rows.shape[1]), []
    for row in np.ascontiguousarray(rows):
        c = advance(c, row[None], gains)
        found.append(c[0])
    return np.array(found)
