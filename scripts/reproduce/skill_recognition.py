"""What a memory calls the skill that runs, and whether it takes a change of skill for a fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.episodes import Episode
from asm_gym.evaluation.repertoire import Alarms
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.benchmark import fitted
from asm_gym.rollouts.folder import recorded
from asm_gym.scripts.reproduce.skill_switch import Switch


class Naming(NamedTuple):
    """How one memory named what runs: a (T,) array of right or wrong for each episode."""

    nominal: list[NDArray[np.bool_]]
    switched: list[NDArray[np.bool_]]  # from the change of skill on
    alarms: Alarms


def name_skills(seed: int, run: Path, tasks: tuple[str, ...], rate: float, switches: Sequence[Path]) -> Naming:
    """What the memory of ``seed`` calls the skills of nominal test episodes, and of those that change skill."""
    recordings = recorded(run, tasks).roles
    memory = fitted(run, "neural_asm", recordings["fit"], seed)
    assert isinstance(memory, NeuralASM)
    memory.calibrate(recordings["calibration"], rate)
    memory.name_skills(recordings["fit"])
    nominal = [memory.skills(r.stream) == r.labelled.task for r in recordings["nominal"]]
    changes = [Switch.read(path, memory.spec) for path in switches]
    switched = [(memory.skills(s.episode.stream) == s.skills)[s.changed :] for s in changes]
    return Naming(nominal, switched, alarms_of(memory, recordings["nominal"], changes))


def alarms_of(memory: NeuralASM, nominal: Sequence[Episode], changes: Sequence[Switch]) -> Alarms:
    """What a calibrated memory makes of them."""

    def share(episodes: Sequence[Episode]) -> float:
        alarms = [s.value.max() > memory.threshold for s in memory.score_episodes(episodes)]
        return float(np.mean(alarms)) if alarms else math.nan

    return Alarms(share(nominal), share([s.episode for s in changes]))


def experienced(
    seed: int, run: Path, tasks: tuple[str, ...], rate: float, switches: Sequence[Path], experience: Sequence[Path]
) -> Alarms:
    """What a memory makes of a change of skill that has seen others, unlabelled among its episodes."""
    recordings = recorded(run, tasks).roles
    spec = recordings["fit"][0].spec
    changes = [Switch.read(path, spec).episode for path in experience]
    calibration = changes[: len(changes) // 3]
    memory = NeuralASM(spec, seed=seed).fit([*recordings["fit"], *changes[len(calibration) :]])
    memory.calibrate([*recordings["calibration"], *calibration], rate)
    return alarms_of(memory, recordings["nominal"], [Switch.read(path, spec) for path in switches])
