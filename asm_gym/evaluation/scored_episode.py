"""What a monitor said during one episode, beside what was really happening."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import spans

Floats = NDArray[np.floating[Any]]

NOMINAL = "nominal"
"""The kind of an episode in which nothing is wrong."""

POLICY_ALONE = "policy alone"
"""The acting in which the monitor only watches."""

IDEAL = "ideal"
"""The acting in which a reflex is told of the fault, and senses that would be at fault are not."""


class InterventionOutcome(NamedTuple):
    """How an episode ended, and what the arm went through.

    Attributes:
        success: the task was solved at some step.
        ended_by_alarm: the wrapper ended the episode.
        contact_force: the greatest contact force [N].
    """

    success: bool = False
    ended_by_alarm: bool = False
    contact_force: float = math.nan


@dataclass(frozen=True, eq=False)
class TraceDetail:
    """What a trace keeps only of an episode that is to be drawn: T rows of D channels.

    Args:
        attribution: (T, D) each channel's share of the surprise.
        channels: D names.
        fault: (T,) bool, the ground truth.
        stream: (T, D) what was sensed.
        twin: (at least T, D) the stream of the same seed without the fault, where it is known.
    """

    attribution: Floats
    channels: tuple[str, ...]
    fault: NDArray[np.bool_]
    stream: Floats | None = None
    twin: Floats | None = None

    def __post_init__(self) -> None:
        steps = len(self.attribution)
        if self.attribution.shape != (steps, len(self.channels)):
            shape = f"(T, {len(self.channels)})"
            raise ValueError(f"attribution must have the shape {shape}, got {self.attribution.shape}")
        if self.fault.shape != (steps,):
            raise ValueError(f"fault must have the shape {(steps,)}, got {self.fault.shape}")
        if self.fault.dtype != np.bool_:  # as integers, ~ and masks would silently mean something else
            raise ValueError(f"fault must be bool, got {self.fault.dtype}")


@dataclass(frozen=True, eq=False)
class ScoredEpisode:
    """One episode of T rows of the stream, as a monitor with this threshold judged it.

    Row t is what was sensed from ``t * dt`` to ``(t + 1) * dt``. A fault that is first active in row t therefore began
    at ``t * dt``, and an alarm in row t was raised at ``(t + 1) * dt``.

    Args:
        kind: ``"nominal"``, or the name of the fault or the harmless variation.
        seed: what ``reset`` was given; twins share it.
        dt: period of the rows [s].
        threshold: what surprise must exceed for an alarm.
        surprise: (T,) ``inf`` where the stream was not finite, never NaN.
        onset: the first row with a fault; None without one.
        severity: of the fault, such as ``"mild"``; empty where there is but one.
        task, monitor: which, by name; empty where there is but one.
        acting: ``"policy alone"`` where the monitor only watched, else what the alarm did, such as ``"hold"``.
        affected_channels: those in which an attentive observer would see the fault first.
        top_channel: the one with the greatest share of surprise at ``first_alarm``; empty without an alarm.
        outcome: how the episode ended.
        excused: (T,) surprise in the rows of knocks, and of stops, but for what excuses it; 0 in others. By event.
        detail: what only figures need.
    """

    kind: str
    seed: int
    dt: float
    threshold: float
    surprise: Floats
    onset: int | None = None
    severity: str = ""
    task: str = ""
    monitor: str = ""
    acting: str = POLICY_ALONE
    affected_channels: frozenset[str] = frozenset()
    top_channel: str = ""
    outcome: InterventionOutcome = InterventionOutcome()  # noqa: RUF009  (immutable)
    excused: Mapping[str, Floats] = field(default_factory=dict)
    detail: TraceDetail | None = None

    def __post_init__(self) -> None:
        if self.surprise.ndim != 1 or not len(self.surprise):
            raise ValueError(f"surprise must have the shape (T,) with T > 0, got {self.surprise.shape}")
        if np.isnan(self.surprise).any():
            raise ValueError("surprise must not be NaN: a row that cannot be judged has the surprise inf")
        if not self.dt > 0:
            raise ValueError(f"dt must be > 0, got {self.dt}")
        if self.kind == NOMINAL and self.onset is not None:
            raise ValueError(f"a nominal trace must not hold a fault, got one at step {self.onset}")
        if self.onset is not None and self.onset < 0:
            raise ValueError(f"onset must be >= 0, got {self.onset}")
        if self.detail is not None:
            if len(self.detail.fault) != len(self):
                raise ValueError(f"detail must be of {len(self)} rows, got {len(self.detail.fault)}")
            if (self.kind == NOMINAL or self.onset is not None) and self.detail.fault[: self.onset].any():
                raise ValueError(f"a fault is active where none should be, before the onset {self.onset}")

    def __len__(self) -> int:
        return len(self.surprise)

    @property
    def condition(self) -> str:
        """The kind and how bad it was, in words."""
        return " ".join(part.replace("_", " ") for part in (self.severity, self.kind) if part)

    @property
    def title(self) -> str:
        """The condition and the task."""
        return f"{self.condition} in {self.task}" if self.task else self.condition

    @property
    def watched_only(self) -> bool:
        """The monitor had no say: detection is measured on these traces."""
        return self.acting == POLICY_ALONE

    @cached_property
    def alarm(self) -> NDArray[np.bool_]:
        """(T,) the rows in alarm."""
        over: NDArray[np.bool_] = self.surprise > self.threshold
        return over

    @cached_property
    def alarms(self) -> tuple[int, ...]:
        """The rows at which an alarm was raised: each first True of a run."""
        return tuple(start for start, _ in spans(self.alarm))

    @property
    def false_alarms(self) -> tuple[int, ...]:
        """The alarms raised before the onset; all of them where there was no fault."""
        return self.alarms if self.onset is None else tuple(t for t in self.alarms if t < self.onset)

    @property
    def first_alarm(self) -> int | None:
        """The row of the first alarm raised since the onset, or at all where there was no fault; None without one.

        An alarm that was up already and merely stays up says nothing about the fault: it is a false alarm.
        """
        return next((t for t in self.alarms if t >= (self.onset or 0)), None)

    @property
    def detected_after(self) -> int | None:
        """Rows from the onset to the first alarm raised at or after it; None where there was none."""
        return None if self.onset is None or self.first_alarm is None else self.first_alarm - self.onset

    @property
    def delay(self) -> float | None:
        """Time from the beginning of the fault to the alarm [s], at least one ``dt``; None where it was missed."""
        return None if self.detected_after is None else (self.detected_after + 1) * self.dt

    def window(self, window_s: float) -> slice:
        """The rows in which a detection counts: those within ``window_s`` of the onset, or all without a fault."""
        if self.onset is None:
            return slice(0, len(self))
        return slice(self.onset, min(self.onset + window_steps(window_s, self.dt), len(self)))

    def at(self, threshold: float) -> ScoredEpisode:
        """The same surprise judged by another threshold."""
        return replace(self, threshold=threshold, top_channel="")

    def attributed(self, attribution: Floats, channels: Sequence[str]) -> ScoredEpisode:
        """The trace with its ``top_channel``, read from the shares (T, D) of the surprise of D ``channels``.

        Where several have the largest share alike, none is blamed.
        """
        step = self.first_alarm
        if step is None or (attribution[step] == attribution[step].max()).sum() > 1:
            return self
        return replace(self, top_channel=channels[int(np.argmax(attribution[step]))])


def window_steps(window_s: float, dt: float) -> int:
    """How many rows a window holds, at least one."""
    if not window_s > 0:
        raise ValueError(f"window_s must be > 0, got {window_s}")
    return max(1, math.floor(window_s / dt + 1e-6))  # 0.3 / 0.1 is a hair below 3


class AlarmMoment(NamedTuple):
    """An alarm, and how it began.

    Attributes:
        trace: in which.
        start, stop: its rows.
        channel: which number surprised most in the first of them; later others follow, and may surprise more.
        excess: how surprising the worst of them was, in thresholds; infinite where it was not finite.
    """

    trace: ScoredEpisode
    start: int
    stop: int
    channel: int
    excess: float


def moments_of(trace: ScoredEpisode) -> list[AlarmMoment]:
    """The alarms of an episode, in order. Raises ValueError where the trace has no detail."""
    if trace.detail is None:
        raise ValueError("this trace was kept without the detail that says which channel surprised")
    found = []
    for start, stop in spans(trace.alarm):
        channel = int(np.argmax(trace.detail.attribution[start]))
        found.append(
            AlarmMoment(trace, start, stop, channel, float(trace.surprise[start:stop].max() / trace.threshold))
        )
    return found
