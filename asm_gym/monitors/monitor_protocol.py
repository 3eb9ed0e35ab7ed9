"""Surprise, and the protocols of a monitor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection.alarm_rule import BENIGN_EVENTS, EVENTS
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import StreamSpec

Progress = Callable[[int, int], object]  # called as ``progress(done, total)``

State = Any  # a monitor's running state: a value, passed in and returned, never kept in the monitor


class Surprise(NamedTuple):
    """Hold the surprise of the last row of each stream in a batch.

    Attributes:
        value: (B,) number that the threshold applies to; ``inf`` where the row is not finite.
        attribution: (B, D) share of each number of the row; adds up to ``value`` along the last axis.
        skill: (B,) name of the skill that seems to be running; None where no skill has a name.
        raw: (B,) ``value`` before benign events excuse part of it; None where nothing is excused.
        excuse: (B,) index in ``detection.alarm_rule.EVENTS`` of the event that excuses it; None likewise.
    """

    value: NDArray[np.float64]
    attribution: NDArray[np.float64]
    skill: NDArray[np.str_] | None = None
    raw: NDArray[np.float64] | None = None
    excuse: NDArray[np.int8] | None = None

    def __repr__(self) -> str:
        """Return one line: number of rows, last and largest value."""
        if not len(self.value):
            return "<Surprise of no row>"
        last = self.value[-1]
        largest = self.value.max()
        return f"<Surprise of {len(self.value)}: last {last:.4g}, largest {largest:.4g}>"

    def of(self, stream: int) -> Surprise:
        """Return the surprise of one stream, as a batch of one."""
        fields = {}
        for name, array in self._asdict().items():
            if array is not None:
                fields[name] = array[stream : stream + 1]
        return Surprise(**fields)

    @property
    def excused_by_event(self) -> dict[str, NDArray[np.float64]]:
        """``raw`` (B,) of rows excused by each benign event, 0 elsewhere; empty where nothing is excused."""
        if self.raw is None:
            return {}
        by_event = {}
        for event in BENIGN_EVENTS:
            by_event[event] = np.where(self.excuse == EVENTS.index(event), self.raw, 0.0)
        return by_event

    def silenced(self, where: NDArray[np.bool_]) -> Surprise:
        """Return it with no surprise ``where`` (B,) nothing is judged."""
        silent = self._replace(
            value=np.where(where, 0.0, self.value),
            attribution=np.where(where[:, None], 0.0, self.attribution),
        )
        if self.raw is None:
            return silent
        return silent._replace(raw=np.where(where, 0.0, self.raw))

    def without(self, columns: NDArray[np.bool_]) -> Surprise:
        """Return the surprise without the shares of ``columns`` (D,); a value that is not finite stays."""
        if not columns.any():
            return self
        has_share = np.isfinite(self.value) & (self.value > 0)
        of_columns = self.attribution[has_share][:, columns].sum(axis=1)
        share_left = np.ones(len(self.value))
        share_left[has_share] = np.clip(1.0 - of_columns / self.value[has_share], 0.0, 1.0)
        rest = self._replace(
            value=np.where(has_share, share_left * self.value, self.value),
            attribution=np.where(columns, 0.0, self.attribution),
        )
        if self.raw is None:
            return rest
        return rest._replace(raw=np.where(has_share, share_left * self.raw, self.raw))


class Monitor(Protocol):
    """Watch a stream and return the surprise of each row; any object with these methods is a monitor."""

    spec: StreamSpec

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm. Raises RuntimeError before ``calibrate``."""
        ...

    def fit(self, episodes: Sequence[Episode]) -> Self: ...

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self: ...

    def initial_state(self, batch: int = 1) -> State: ...

    def observe(
        self, state: State, stream: NDArray[np.floating[Any]]
    ) -> tuple[State, Surprise]: ...

    def save(self, path: str | Path) -> None: ...


@runtime_checkable
class ForgetsEvidence(Protocol):
    """A monitor that accumulates evidence, and can clear it after the response to an alarm."""

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
class ExplainsItself(Protocol):
    """A monitor that can name the cause of its surprise, and complete a faulty sense."""

    @property
    def diagnosis_(self) -> Diagnosis | None:
        """None where it was not learned."""
        ...
