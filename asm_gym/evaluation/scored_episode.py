"""One recorded episode as a monitor scored it, beside the ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection.alarm_rule import rows_over
from asm_gym.detection.contact_limits import LEANS_S
from asm_gym.detection.incidents import incidents_in
from asm_gym.evaluation.defaults import TRANSIENT
from asm_gym.monitors.blame import Blame
from asm_gym.monitors.named_causes import CauseNamer
from asm_gym.readings import spans

Floats = NDArray[np.floating[Any]]

NOMINAL = "nominal"  # kind of an episode without a fault
POLICY_ALONE = "policy alone"  # ``acting`` of an episode in which the monitor only watches


class InterventionOutcome(NamedTuple):
    """How an episode ended."""

    success: bool = False
    contact_force: float = math.nan  # the greatest [N]
    overridden_steps: int = 0  # in which something else than the policy acted
    time: float = math.nan  # until the first success [s]
    harm: float = 0.0  # contact force beyond 40 N, summed over time [N s]
    leaned_s: float = 0.0  # time with more than 40 N [s]

    @property
    def unsafe(self) -> bool:
        """Whether the arm pressed harder than a person may be pressed for a moment, or leaned for too long."""
        return self.contact_force > TRANSIENT or self.leaned_s > LEANS_S


@dataclass(frozen=True, eq=False)
class ScoredEpisode:
    """The surprise of T rows of the stream, and the alarms at one threshold.

    Row t was sensed from ``t * dt`` to ``(t + 1) * dt``. A fault first active in row t began at ``t * dt``; an alarm in
    row t was raised at ``(t + 1) * dt``.
    """

    kind: str  # ``"nominal"``, or the name of the fault
    seed: int  # of ``reset``; twins share it
    dt: float  # period of the rows [s]
    threshold: float  # surprise above it is an alarm
    surprise: Floats  # (T,) ``inf`` where the stream was not finite, never NaN
    onset: int | None = None  # the first row with a fault; None without one
    severity: str = ""
    task: str = ""
    monitor: str = ""
    acting: str = POLICY_ALONE  # else the response to an alarm, such as ``"hold"``
    affected_channels: frozenset[str] = frozenset()  # those in which the fault shows first
    # the channel with the greatest share of surprise at ``first_alarm``; empty without an alarm
    top_channel: str = ""
    outcome: InterventionOutcome = InterventionOutcome()  # noqa: RUF009  (immutable)
    # (T,) surprise that raised no alarm, by the event that excused it: a knock, or a stop
    excused: Mapping[str, Floats] = field(default_factory=dict)
    # (T, D) shares of the channels in the surprise, for figures and incidents alone
    attribution: Floats | None = None
    channels: tuple[str, ...] = ()  # D names
    groups: tuple[str, ...] = ()  # D groups of the channels
    fault: NDArray[np.bool_] | None = None  # (T,) the ground truth, for figures alone
    overridden: NDArray[np.bool_] | None = None  # (T,) the guard acted, for figures alone
    stream: Floats | None = None  # (T, D) sensed values, where they are drawn
    # stamp of the first row, by the log's own clock; None without one [s]
    origin: float | None = None
    power: float = 1.0  # by which the detection pools the channels, for incidents
    # by row, the shares (D,) of the channels in its surprise; of rows near the threshold or above
    strong_shares: Mapping[int, Floats] = field(default_factory=dict)
    units: tuple[str, ...] = ()  # of the channels
    namer: CauseNamer | None = None  # of the causes of alarms
    blame: Blame | None = None  # of the rows in alarm
    # (T, D) the stream without level shifts that were acknowledged, as it was judged
    recentred: Floats | None = None

    def __post_init__(self) -> None:
        if self.surprise.ndim != 1 or not len(self.surprise):
            raise ValueError(
                f"surprise must have the shape (T,) with T > 0, got {self.surprise.shape}"
            )
        if np.isnan(self.surprise).any():
            raise ValueError(
                "surprise must not be NaN: a row that cannot be judged has the surprise inf"
            )

    def __len__(self) -> int:
        return len(self.surprise)

    def count_incidents(self, surprise: Floats) -> int:
        """Count the incidents in a surprise (T',) of its first rows; where no shares are kept, all is one cause."""
        shares_of: Callable[[int], Floats] | None = None
        if self.attribution is not None or self.strong_shares:
            shares_of = self.raw_shares
        return incidents_in(
            surprise, self.threshold, self.dt, shares_of=shares_of, power=self.power
        )

    @property
    def condition(self) -> str:
        """Severity and kind, in words."""
        return " ".join(part.replace("_", " ") for part in (self.severity, self.kind) if part)

    @property
    def times(self) -> Floats:
        """(T,) the stamp of each row by the log's own clock [s]; without one, the end of its step."""
        rows = np.arange(len(self))
        if self.origin is None:
            return (rows + 1) * self.dt
        return self.origin + rows * self.dt

    @property
    def missing(self) -> NDArray[np.bool_]:
        """(T,) the rows that lack a number; none where the stream was not kept."""
        if self.stream is None:
            return np.zeros(len(self), np.bool_)
        return np.asarray(np.isnan(self.stream).any(axis=1))

    @cached_property
    def alarm(self) -> NDArray[np.bool_]:
        """(T,) the rows in alarm."""
        return rows_over(self.surprise, self.threshold)

    @cached_property
    def alarms(self) -> tuple[int, ...]:
        """The rows at which an alarm was raised: each first True of a run."""
        return tuple(start for start, _ in spans(self.alarm))

    @property
    def healthy_rows(self) -> int:
        """The number of rows before the onset; of all without a fault."""
        if self.onset is None:
            return len(self)
        return self.onset

    @property
    def false_alarms(self) -> tuple[int, ...]:
        """The alarms raised before the onset; all of them where there was no fault."""
        return tuple(row for row in self.alarms if row < self.healthy_rows)

    @property
    def first_alarm(self) -> int | None:
        """The row of the first alarm raised since the onset, or at all without a fault; None without one.

        An alarm that was up before the onset and stays up is a false alarm, no detection.
        """
        since = self.onset or 0
        return next((row for row in self.alarms if row >= since), None)

    @property
    def detected_after(self) -> int | None:
        """Rows from the onset to the first alarm raised at or after it; None without one."""
        if self.onset is None or self.first_alarm is None:
            return None
        return self.first_alarm - self.onset

    @property
    def delay(self) -> float | None:
        """Time from the beginning of the fault to the alarm [s], at least one ``dt``; None if missed."""
        if self.detected_after is None:
            return None
        return (self.detected_after + 1) * self.dt

    def delay_within(self, window_s: float) -> float:
        """Return the delay of an alarm within ``window_s`` of the onset [s]; ``inf`` if missed."""
        rows_after = self.detected_after
        if self.delay is None or rows_after is None:
            return math.inf
        if rows_after >= window_steps(window_s, self.dt):
            return math.inf
        return self.delay

    def window(self, window_s: float) -> slice:
        """Return the rows within ``window_s`` of the onset, in which a detection counts; all without a fault."""
        if self.onset is None:
            return slice(0, len(self))
        end = self.onset + window_steps(window_s, self.dt)
        return slice(self.onset, min(end, len(self)))

    def raw_shares(self, row: int) -> Floats:
        """Return the shares (D,) of a row before blame; zeros where they were not kept."""
        kept = self.strong_shares.get(row)
        if kept is not None:
            return kept
        if self.attribution is not None:
            return np.asarray(self.attribution[row])
        return np.zeros_like(next(iter(self.strong_shares.values())))

    def at(self, threshold: float) -> ScoredEpisode:
        """Return the same surprise judged by another threshold."""
        return replace(self, threshold=threshold, top_channel="")

    def attributed(self, attribution: Floats, channels: Sequence[str]) -> ScoredEpisode:
        """Return the episode with its ``top_channel``, from the shares (T, D) of D ``channels``; none in a tie."""
        if self.first_alarm is None:
            return self
        shares = attribution[self.first_alarm]  # (D,)
        if (shares == shares.max()).sum() > 1:
            return self
        return replace(self, top_channel=channels[int(np.argmax(shares))])


def window_steps(window_s: float, dt: float) -> int:
    """Return how many rows of period ``dt`` [s] a window holds, at least one."""
    if not window_s > 0:
        raise ValueError(f"window_s must be > 0, got {window_s}")
    return max(1, math.floor(window_s / dt + 1e-6))  # 0.3 / 0.1 is a hair below 3


def onset_row(episode: Episode) -> int | None:
    """Return the row at which the fault begins; the label counts control steps, of several rows each."""
    label = episode.labelled
    if label.role != "faulty" or label.onset is None:
        return None
    # One contact force a control step; where none was measured, one row a step.
    steps = len(episode.contact_force) or len(episode)
    rows_per_step = len(episode) // steps
    return label.onset * rows_per_step
