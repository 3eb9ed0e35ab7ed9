"""What everything that watches a stream has in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.detection.events import EVENTS, KNOCK, STOP, Excused, event_of
from asm_gym.episode import Episode
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.notebook_display import lines_over_time
from asm_gym.spec import StreamSpec

Progress = Callable[[int, int], object]
"""Called as ``progress(done, total)``."""

State = Any
"""A monitor's running state: a value, passed in and handed back, never kept in the monitor."""

Told = Mapping[str, Any]
"""What an episode says of itself, its ``info``; ``"skill"`` and ``"goal"`` are what models may have to be told."""


class Surprise(NamedTuple):
    """How unexpected the last row of each stream in a batch was.

    Attributes:
        value: (B,) what the threshold applies to; ``inf`` where the row was not finite.
        attribution: (B, D) each number's share; adds up to ``value`` along the last axis.
        skill: (B,) the name of the skill that seems to be running, for people to read; None where none was named.
        of_body: (B,) at what no body does, where a monitor tells it from ``of_skill``; None where that is all of it.
        of_skill: (B,) at what no skill that was shown does; None where nobody listens for it.
        raw: (B,) what ``value`` would be without what the senses excuse; None where nothing is excused.
        excuse: (B,) by what it is, a place in ``detection.events.EVENTS``; None likewise.
    """

    value: NDArray[np.float64]
    attribution: NDArray[np.float64]
    skill: NDArray[np.str_] | None = None
    of_body: NDArray[np.float64] | None = None
    of_skill: NDArray[np.float64] | None = None
    raw: NDArray[np.float64] | None = None
    excuse: NDArray[np.int8] | None = None

    def __repr__(self) -> str:
        """In a line: of how many rows, the last and the largest."""
        if not len(self.value):
            return "<Surprise of no row>"
        return f"<Surprise of {len(self.value)}: last {self.value[-1]:.4g}, largest {self.value.max():.4g}>"

    def _repr_html_(self) -> str:
        """For notebooks: surprise over time, and the numbers that had the largest share."""
        shares = np.nan_to_num(np.atleast_2d(self.attribution))
        most = np.argsort(-shares.sum(axis=0))[:4]
        lines = {"surprise": self.value} | {f"share of number {k}": shares[:, k] for k in most}
        return lines_over_time(repr(self), lines)

    @property
    def parts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(B,) at the body, and (B,) at the skill, not a number where nobody listens for that."""
        body = self.value if self.of_body is None else self.of_body
        return body, np.full(len(body), np.nan) if self.of_skill is None else self.of_skill

    def of(self, stream: int) -> Surprise:
        """That of one stream, in a batch of one."""
        at = slice(stream, stream + 1)
        return Surprise(*(None if part is None else part[at] for part in self))  # type: ignore[arg-type]

    def event(self, threshold: float) -> str:
        """What the first of the batch is at this threshold, one of ``detection.events.EVENTS``."""
        value = float(self.value[0])
        if self.raw is None or self.excuse is None:
            return event_of(value, value, 0, threshold)
        return event_of(value, float(self.raw[0]), int(self.excuse[0]), threshold)

    @property
    def excused_by_event(self) -> dict[str, NDArray[np.float64]]:
        """(B,) ``raw`` where it is excused by a knock, and by a stop, 0 elsewhere; empty where nothing is excused."""
        if self.raw is None:
            return {}
        return {event: np.where(self.excuse == EVENTS.index(event), self.raw, 0.0) for event in (KNOCK, STOP)}

    def excused(self, by: Excused) -> Surprise:
        """What is left of it where the senses excuse some."""
        shares, value = self.attribution, self.value
        if (by.divisor != 1.0).any():
            shares, value = shares / by.divisor[:, None], value / by.divisor
        return self._replace(value=value, attribution=shares, raw=self.value, excuse=by.kind)

    def silenced(self, where: NDArray[np.bool_]) -> Surprise:
        """No surprise ``where`` (B,) nothing is judged."""

        def kept(value: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if value is None else np.where(where, 0.0, value)

        shares = np.where(where[:, None], 0.0, self.attribution)
        value, (body, skill, raw) = np.where(where, 0.0, self.value), map(kept, self._parts)
        return self._replace(value=value, attribution=shares, of_body=body, of_skill=skill, raw=raw)

    def without(self, columns: NDArray[np.bool_]) -> Surprise:
        """What is left of it where the precision of ``columns`` (D,) is 0."""
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
    """Watches a stream and says how surprising it is."""

    spec: StreamSpec

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm. Raises RuntimeError before ``calibrate``."""
        ...

    def fit(self, episodes: Sequence[Episode]) -> Self: ...

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self: ...

    def initial_state(self, batch: int = 1) -> State: ...

    def observe(self, state: State, stream: NDArray[np.floating[Any]]) -> tuple[State, Surprise]: ...

    def save(self, path: str | Path) -> None: ...


class Model(Protocol):
    """Expects each row of a stream, and says by how much it was wrong; what that means is for a detection to say.

    Arguments of ``__init__`` beside the stream's spec are hyperparameters, kept under their own names.

    Attributes:
        kind: its name, in ``make_monitor`` and in checkpoints.
        shortest: steps that an episode must have to be learned from.
        held_out: one in so many episodes is not learned, but shows how wrong the model usually is; 0 for none.
        learned_: what ``fit`` has found, by name; empty before.
        skills_: names of the skills it knows, where it was told any.
    """

    kind: str
    shortest: int
    held_out: int
    spec: StreamSpec
    learned_: Arrays
    skills_: tuple[str, ...]

    @property
    def error_columns(self) -> NDArray[np.intp]:
        """(X,) the column of the stream that each error belongs to; -1 for none, of which all senses have a share."""
        ...

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        """Learns from whole nominal episodes."""
        ...

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        """Takes what another has learned. Raises ValueError where that does not fit together."""
        ...

    def start(self, batch: int, told: Sequence[Told] = ()) -> State:
        """Before the first row of ``batch`` streams: a NamedTuple of arrays whose first axis is B.

        Args:
            told: of each stream its skill and goal, for models that have to be told; others do not look.
        """
        ...

    def predict(self, state: State, rows: NDArray[np.float64]) -> tuple[State, ModelOutput]:
        """The next rows (B, D), perhaps not all finite: the new state, and how wrong each expectation was."""
        ...


@runtime_checkable
class ForgetsEvidence(Protocol):
    """A monitor that adds up evidence, and can be told to start anew after an alarm that was acted on."""

    def reset_evidence(self, state: State) -> State:
        """The state with the evidence so far forgotten; the model goes on."""
        ...


@runtime_checkable
class ExpectsActions(Protocol):
    """A monitor that knows what is likely to be commanded next."""

    def expected_action(self, state: State) -> NDArray[np.float32]:
        """(B, A) in the units of the action, of the state as ``observe`` handed it back."""
        ...


@runtime_checkable
class ExplainsItself(Protocol):
    """A monitor that can say what causes its surprise, and complete what a faulty sense should say."""

    @property
    def diagnosis_(self) -> Diagnosis | None:
        """None where it was not learned."""
        ...


@runtime_checkable
class LearnsOnTheJob(Protocol):
    """A monitor that can learn from rows it has just observed, where they did not surprise it."""

    def adapt(
        self,
        before: State,
        stream: NDArray[np.floating[Any]],
        surprise: Surprise,
        rate: float = ...,
        below: float = ...,
    ) -> NDArray[np.bool_]:
        """(B,) which of the rows (B, D) were learned from; ``before`` is the state that ``observe`` was given."""
        ...


@runtime_checkable
class Specialises(Protocol):
    """A model that can go on from what it knows, with few episodes."""

    def specialise(self, episodes: Sequence[Episode]) -> Self:
        """Learns what these nominal episodes have of their own."""
        ...


@runtime_checkable
class NamesSkills(Protocol):
    """A monitor that can be taught the names of skills, and says which one runs."""

    def name_skills(self, episodes: Sequence[Episode]) -> Self:
        """Learns the names from episodes that say them, as ``NeuralASM.name_skills`` does."""
        ...

    def skills(self, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
        """(T,) the skill that seems to run in each step of a stream (T, D)."""
        ...
