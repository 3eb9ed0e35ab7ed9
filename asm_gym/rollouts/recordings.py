"""The recordings of an evaluation, by role."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from asm_gym.episodes import Episode, load_episode
from asm_gym.rollouts.benchmark import sorted_by_role


@lru_cache(maxsize=1)
def recorded(run: Path, tasks: tuple[str, ...]) -> tuple[dict[str, list[Episode]], list[Episode]]:
    """Recordings by role, and the twins of faulty ones."""
    folders = [run / "episodes" / t / role for t in tasks for role in ("fit", "calibration", "nominal", "faulty")]
    found, _, twins = sorted_by_role([load_episode(p) for folder in folders for p in sorted(folder.glob("*.npz"))])
    return found, twins
