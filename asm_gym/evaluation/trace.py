"""What a monitor said during one episode, beside what was really happening."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

NOMINAL = "nominal"
"""The condition in which nothing is wrong."""

POLICY_ALONE = "policy alone"
"""The acting in which the monitor only watches."""


def spans(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The runs of True in ``mask`` (T,), as half-open [start, stop) steps."""
    edges = np.diff(np.concatenate([[0], np.asarray(mask, np.int8), [0]]))  # (T + 1,)
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Trace:
    """One watched episode of T control steps over D channels.

    Row t is what was sensed after control step t, which lasts from ``t * dt`` to ``(t + 1) * dt``. A fault active in
    step t therefore began at ``t * dt``, and an alarm in step t was raised at ``(t + 1) * dt``.

    Args:
        condition: ``"nominal"``, or the name of the fault.
        acting: ``"policy alone"`` where the monitor only watched, else what the alarm did, such as ``"hold"``.
        seed: what ``reset`` was given.
        dt: control period [s].
        threshold: what surprise must exceed for an alarm.
        surprise: (T,) ``inf`` where the stream was not finite, never NaN.
        alarm: (T,) bool.
        fault: (T,) bool, the ground truth.
        contact_force: (T,) [N].
        attribution: (T, D) each channel's share of the surprise.
        labels: D names.
        success: the task was solved at some step.
        ended_by_alarm: the alarm ended the episode.
        stream: (T, D) what was sensed, where it was kept.
        twin: (at least T, D) the stream of the same seed without the fault, where it is known.
    """

    condition: str
    acting: str
    seed: int
    dt: float
    threshold: float
    surprise: NDArray[np.floating[Any]]
    alarm: NDArray[np.bool_]
    fault: NDArray[np.bool_]
    contact_force: NDArray[np.floating[Any]]
    attribution: NDArray[np.floating[Any]]
    labels: tuple[str, ...]
    success: bool
    ended_by_alarm: bool = False
    stream: NDArray[np.floating[Any]] | None = None
    twin: NDArray[np.floating[Any]] | None = None

    def __post_init__(self) -> None:
        steps = len(self.surprise)
        shapes = {name: (steps,) for name in ("surprise", "alarm", "fault", "contact_force")}
        for name, shape in {**shapes, "attribution": (steps, len(self.labels))}.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must have the shape {shape}, got {getattr(self, name).shape}")
        for name in ("alarm", "fault"):
            if getattr(self, name).dtype != np.bool_:  # as integers, ~ and masks would silently mean something else
                raise ValueError(f"{name} must be bool, got {getattr(self, name).dtype}")
        if steps == 0:
            raise ValueError("a trace needs at least one step")
        if not self.dt > 0:
            raise ValueError(f"dt must be > 0, got {self.dt}")
        if np.isnan(self.surprise).any():
            raise ValueError("surprise must not be NaN: a row that cannot be judged has the surprise inf")
        if self.condition == NOMINAL and self.fault.any():
            raise ValueError("a nominal trace must not hold a fault")

    def __len__(self) -> int:
        return len(self.surprise)

    @property
    def watched_only(self) -> bool:
        """The monitor had no say: detection is measured on these traces."""
        return self.acting == POLICY_ALONE

    @property
    def onset(self) -> int | None:
        """The first step with a fault; None where there was none."""
        return int(np.argmax(self.fault)) if self.fault.any() else None

    @cached_property
    def alarms(self) -> tuple[int, ...]:
        """The steps at which an alarm was raised: each first True of a run."""
        return tuple(start for start, _ in spans(self.alarm))

    @property
    def false_alarms(self) -> tuple[int, ...]:
        """The alarms raised before the onset; all of them where there was no fault."""
        return self.alarms if self.onset is None else tuple(t for t in self.alarms if t < self.onset)

    @property
    def detected_after(self) -> int | None:
        """Steps from the onset to the first alarm raised at or after it; None where there was none.

        An alarm that was up already and merely stays up says nothing about the fault: it is a false alarm.
        """
        if self.onset is None:
            return None
        return next((t - self.onset for t in self.alarms if t >= self.onset), None)

    @property
    def delay(self) -> float | None:
        """Time from the beginning of the fault to the alarm [s], at least one ``dt``; None where it was missed."""
        return None if self.detected_after is None else (self.detected_after + 1) * self.dt
