"""Recorded episodes by role: what to learn from, to calibrate on, and to test on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from asm_gym.data.crashes import crashes
from asm_gym.episode import Episode, load_episode

NOMINAL_ROLES = ("fit", "calibration", "nominal")
"""Roles of episodes without a fault."""


class Recordings(NamedTuple):
    """The recordings of a run.

    Attributes:
        roles: recordings by role, without failed nominal episodes, and without scenes in which the robot crashes.
        left_out: numbers of nominal episodes that failed, and of scenes with a crash.
        twins: every episode of the role nominal: a faulty one equals its twin until the onset.
    """

    roles: dict[str, list[Episode]]
    left_out: tuple[int, int]
    twins: list[Episode]

    @classmethod
    def of(cls, recordings: Sequence[Episode]) -> Recordings:
        """Sort by role. Raises ValueError where there is nothing normal to learn from or to test on."""
        healthy = [r for r in recordings if r.labelled.role in NOMINAL_ROLES and r.success]
        reference = [r.labelled.role != "nominal" for r in healthy]
        found = crashes(healthy, [r.labelled.task for r in healthy], reference, torques=False)
        crashed = {(healthy[n].labelled.task, healthy[n].labelled.seed) for n in found}
        roles: dict[str, list[Episode]] = {}
        failed = 0
        for recording in recordings:
            label = recording.labelled
            # An alarm in a failed episode would be no false one.
            if label.role in NOMINAL_ROLES and not recording.success:
                failed += 1
            elif (label.task, label.seed) not in crashed:
                roles.setdefault(label.role, []).append(recording)
        for role in NOMINAL_ROLES:
            if not roles.get(role):
                raise ValueError(
                    f"none of the {role} episodes succeeded without a crash: "
                    "there is nothing normal to learn or to test on"
                )
        return cls(roles, (failed, len(crashed)), [r for r in recordings if r.labelled.role == "nominal"])


@lru_cache(maxsize=1)
def read(paths: tuple[Path, ...]) -> Recordings:
    """Load these files by role; the last ones are cached for the next monitor."""
    return Recordings.of([load_episode(path) for path in paths])


def recorded(run: Path) -> Recordings:
    """Load every recording of a run of ``asm-gym evaluate`` but the harmless variations.

    Raises:
        ValueError: there is none.
    """
    paths = [p for role in (*NOMINAL_ROLES, "faulty") for p in sorted((run / "episodes").glob(f"*/{role}/*.npz"))]
    if not paths:
        raise ValueError(f"{run} holds no recordings: run asm-gym evaluate first")
    return read(tuple(paths))
