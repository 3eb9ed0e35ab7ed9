"""What ``asm-gym evaluate`` recorded, as the studies read it; and what their networks must be wide enough for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.comparison import Detectability
from asm_gym.evaluation.recordings import recorded, tasks_in
from asm_gym.evaluation.scoring import detectability_of
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.validation import check_number


@dataclass(frozen=True)
class RunConfig(kit.Config):
    """Options of a study of what ``asm-gym evaluate`` recorded."""

    run: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of an evaluation, whose recordings are learned from and judged."""
    false_alarm_rate: float = option(defaults.FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    window: float = option(defaults.WINDOW_S, check=partial(check_number, "window", above=0))
    """How soon after its onset a fault must be noticed [s]."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """What the run has recorded; ValueError where there is nothing."""
        return tasks_recorded(self.run)

    @property
    def roles(self) -> Mapping[str, Sequence[Episode]]:
        """The recordings by role."""
        return recorded(self.run, self.tasks).roles

    def detectable(self, faulty: Sequence[Episode]) -> list[Detectability]:
        """Which of these faults an ideal observer could see."""
        return detectability_of(recorded(self.run, self.tasks).twins, faulty, self.window)


def tasks_recorded(run: Path) -> tuple[str, ...]:
    """Names of the tasks that an evaluation has recorded.

    Raises:
        ValueError: there are none.
    """
    tasks = tuple(tasks_in(run))
    if not tasks:
        raise ValueError(f"{run} holds no recordings: run asm-gym evaluate first")
    return tasks


def in_turn(episodes: Sequence[Episode], seed: int) -> list[Episode]:
    """All of them, one of each task after another, beginning elsewhere for each seed."""
    tasks: dict[str, list[Episode]] = {}
    for episode in episodes:
        tasks.setdefault(episode.labelled.task, []).append(episode)
    rng = np.random.default_rng(seed)
    shuffled = [[own[i] for i in rng.permutation(len(own))] for own in tasks.values()]
    return [e for turn in zip_longest(*shuffled) for e in turn if e is not None]


def wide_enough(hidden: int, channels: int) -> None:
    """Raises ValueError where a network has fewer hidden units than numbers to predict."""
    if hidden < channels:
        raise ValueError(f"hidden must be at least the number of channels, {channels}, got {hidden}")
