"""Recorded episodes by role: what to learn from, to calibrate on, and to test on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from asm_gym.data.crashes import crashes
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.comparison import LeftOut

NOMINAL_ROLES = ("fit", "calibration", "nominal")
"""Roles of episodes without a fault."""


class Recordings(NamedTuple):
    """The recordings of a run.

    Attributes:
        roles: recordings by role, without failed nominal episodes, and without scenes in which the robot crashes.
        left_out: number of nominal episodes left out.
        twins: every episode of the role nominal: a faulty one equals its twin until the onset.
    """

    roles: dict[str, list[Episode]]
    left_out: LeftOut
    twins: list[Episode]

    @classmethod
    def of(cls, recordings: Sequence[Episode]) -> Recordings:
        """Sort by role. Raises ValueError where there is nothing normal to learn from or to test on."""
        healthy = [r for r in recordings if r.labelled.role in NOMINAL_ROLES and r.success]
        told_by = [r.labelled.role != "nominal" for r in healthy]
        found = crashes(healthy, [r.labelled.task for r in healthy], told_by, torques=False)
        hit = {(healthy[n].labelled.task, healthy[n].labelled.seed) for n in found}
        roles: dict[str, list[Episode]] = {}
        failed = 0
        for recording in recordings:
            label = recording.labelled
            # An alarm in a failed episode would be no false one.
            if label.role in NOMINAL_ROLES and not recording.success:
                failed += 1
            elif (label.task, label.seed) not in hit:
                roles.setdefault(label.role, []).append(recording)
        for role in NOMINAL_ROLES:
            if not roles.get(role):
                raise ValueError(
                    f"none of the {role} episodes succeeded without a crash: "
                    "there is nothing normal to learn or to test on"
                )
        return cls(roles, LeftOut(failed, len(hit)), [r for r in recordings if r.labelled.role == "nominal"])


def labelled(folder: Path, labels: Sequence[EpisodeLabel]) -> list[Episode]:
    """Load the recordings of these labels."""
    return [load_episode(folder / label.path) for label in labels]


@lru_cache(maxsize=1)
def read(folder: Path, labels: tuple[EpisodeLabel, ...]) -> Recordings:
    """Load the recordings of these labels by role; the last ones are cached for the next monitor."""
    return Recordings.of(labelled(folder, labels))


def tasks_in(run: Path) -> list[str]:
    """Return the names of the tasks that a run has recorded."""
    return sorted(p.name for p in (run / "episodes").glob("*") if p.is_dir())


def files_in(run: Path, tasks: Sequence[str], *roles: str) -> list[Path]:
    """Return the recordings of a run, by task, then by role, then by name."""
    return [p for t in tasks for role in roles for p in sorted((run / "episodes" / t / role).glob("*.npz"))]


@lru_cache(maxsize=1)
def recorded(run: Path, tasks: tuple[str, ...]) -> Recordings:
    """Load every recording of these tasks but the harmless variations; the last ones are cached."""
    return Recordings.of([load_episode(p) for p in files_in(run, tasks, *NOMINAL_ROLES, "faulty")])
