"""Surprise, and the protocols of a monitor and of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.detection.events import EVENTS, KNOCK, STOP, event_of
from asm_gym.episode import Episode
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import StreamSpec

Progress = Callable[[int, int], object]
"""Called as ``progress(done, total)``."""

State = Any
"""A monitor's running state: a value, passed in and returned, never kept in the monitor."""


class Surprise(NamedTuple):
    """How unexpected the last row of each stream in a batch was.

    Attributes:
        value: (B,) number that the threshold applies to; ``inf`` where the row is not finite.
        attribution: (B, D) share of each number of the row; adds up to ``value`` along the last axis.
        skill: (B,) name of the skill that seems to be running; None where no skill has a name.
        of_body: (B,) surprise of the body, where a monitor tells it from ``of_skill``; None elsewhere.
        of_skill: (B,) surprise of the skill; None where no skill model runs.
        raw: (B,) ``value`` before knocks and stops excuse part of it; None where nothing is excused.
        excuse: (B,) index in ``detection.events.EVENTS`` of the event that excuses it; None likewise.
    """

    value: NDArray[np.float64]
    attribution: NDArray[np.float64]
    skill: NDArray[np.str_] | None = None
    of_body: NDArray[np.float64] | None = None
    of_skill: NDArray[np.float64] | None = None
    raw: NDArray[np.float64] | None = None
    excuse: NDArray[np.int8] | None = None

    def __repr__(self) -> str:
        """Return one line: number of rows, last and largest value."""
        if not len(self.value):
            return "<Surprise of no row>"
        return f"<Surprise of {len(self.value)}: last {self.value[-1]:.4g}, largest {self.value.max():.4g}>"

    @property
    def parts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Surprise of the body (B,) and of the skill (B,); the latter is NaN where no skill model runs."""
        body = self.value if self.of_body is None else self.of_body
        return body, np.full(len(body), np.nan) if self.of_skill is None else self.of_skill

    def of(self, stream: int) -> Surprise:
        """Return the surprise of one stream, as a batch of one."""
        at = slice(stream, stream + 1)
        return Surprise(*(None if part is None else part[at] for part in self))  # type: ignore[arg-type]

    def event(self, threshold: float) -> str:
        """Return the event of the first stream at this threshold, one of ``detection.events.EVENTS``."""
        value = float(self.value[0])
        if self.raw is None or self.excuse is None:
            return event_of(value, value, 0, threshold)
        return event_of(value, float(self.raw[0]), int(self.excuse[0]), threshold)

    @property
    def excused_by_event(self) -> dict[str, NDArray[np.float64]]:
        """``raw`` (B,) of rows excused by a knock, and by a stop, 0 elsewhere; empty where nothing is excused."""
        if self.raw is None:
            return {}
        return {event: np.where(self.excuse == EVENTS.index(event), self.raw, 0.0) for event in (KNOCK, STOP)}

    def silenced(self, where: NDArray[np.bool_]) -> Surprise:
        """Return it with no surprise ``where`` (B,) nothing is judged."""

        def kept(value: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if value is None else np.where(where, 0.0, value)

        shares = np.where(where[:, None], 0.0, self.attribution)
        value, (body, skill, raw) = np.where(where, 0.0, self.value), map(kept, self._parts)
        return self._replace(value=value, attribution=shares, of_body=body, of_skill=skill, raw=raw)

    def without(self, columns: NDArray[np.bool_]) -> Surprise:
        """Return what is left of it where the precision of ``columns`` (D,) is 0."""
        if not columns.any():
            return self
        shares = np.where(columns, 0.0, self.attribution)
        left = np.ones(len(self.value))
        judged = np.isfinite(self.value) & (self.value > 0)
        left[judged] -= self.attribution[judged][:, columns].sum(axis=1) / self.value[judged]
        left = np.clip(left, 0.0, 1.0)

        def kept(value: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if value is None else np.where(judged, left * value, value)

        value = np.where(judged, left * self.value, self.value)
        body, skill, raw = map(kept, self._parts)
        return self._replace(value=value, attribution=shares, of_body=body, of_skill=skill, raw=raw)

    @property
    def _parts(self) -> tuple[NDArray[np.float64] | None, ...]:
        return self.of_body, self.of_skill, self.raw


class Monitor(Protocol):
    """Anything that watches a stream and returns a surprise a row."""

    spec: StreamSpec

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm. Raises RuntimeError before ``calibrate``."""
        ...

    def fit(self, episodes: Sequence[Episode]) -> Self: ...

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self: ...

    def initial_state(self, batch: int = 1) -> State: ...

    def observe(self, state: State, stream: NDArray[np.floating[Any]]) -> tuple[State, Surprise]: ...

    def save(self, path: str | Path) -> None: ...


class Model(Protocol):
    """Predicts each row of a stream, and returns its errors; a detection makes surprise of them.

    Arguments of ``__init__`` beside the stream's spec are hyperparameters, kept under their own names.

    Attributes:
        kind: its name, in ``make_monitor`` and in checkpoints.
        shortest: fewest steps of an episode to learn from.
        held_out: one in so many episodes is not learned, but shows how large errors usually are; 0 for none.
        learned_: arrays that ``fit`` has found, by name; empty before.
        skills_: names of the skills it knows; empty where it was given none.
    """

    kind: str
    shortest: int
    held_out: int
    spec: StreamSpec
    learned_: Arrays
    skills_: tuple[str, ...]

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """(X,) the column of the stream that each error belongs to; -1 for an error that all senses share."""
        ...

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        """Learn from whole nominal episodes."""
        ...

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        """Take over learned arrays. Raises ValueError where they do not fit together."""
        ...

    def start(self, batch: int) -> State:
        """Return the state before the first row of ``batch`` streams: a NamedTuple of arrays whose first axis is B."""
        ...

    def predict(self, state: State, rows: NDArray[np.float64]) -> tuple[State, ModelOutput]:
        """Return the new state after the next rows (B, D), perhaps not all finite, and the errors."""
        ...


@runtime_checkable
class ForgetsEvidence(Protocol):
    """A monitor that adds up evidence, and can start anew after an alarm that was acted on."""

    def reset_evidence(self, state: State) -> State:
        """Return the state without the evidence so far; the model goes on."""
        ...


@runtime_checkable
class ExpectsActions(Protocol):
    """A monitor that predicts the next command."""

    def expected_action(self, state: State) -> NDArray[np.float32]:
        """Return the command (B, A) in the units of the action, after the state that ``observe`` returned."""
        ...


@runtime_checkable
class LearnsOnTheJob(Protocol):
    """A monitor that learns from rows that did not surprise it."""

    def adapt(
        self, before: State, stream: NDArray[np.floating[Any]], surprise: Surprise, rate: float = ...
    ) -> NDArray[np.bool_]:
        """Return which of the rows (B, D) were learned from (B,); ``before`` is the state that ``observe`` got."""
        ...


@runtime_checkable
class ExplainsItself(Protocol):
    """A monitor that can name the cause of its surprise, and complete a faulty sense."""

    @property
    def diagnosis_(self) -> Diagnosis | None:
        """None where it was not learned."""
        ...
