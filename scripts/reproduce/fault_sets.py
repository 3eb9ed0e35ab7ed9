"""What faults are to be told in: letters with slips of the pen, and robosuite skills with faults."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.handwriting import copybook, repertoire
from asm_gym.scripts.reproduce.recordings import demonstrations, made
from asm_gym.scripts.reproduce.speed_accuracy import slips
from asm_gym.tasks import task as task_spec


class FaultSet(NamedTuple):
    """Episodes of one domain."""

    domain: str
    fit: list[Episode]
    calibration: list[Episode]
    nominal: list[Episode]
    faulty: list[tuple[str, int, Episode]]  # kind, onset


def written_fault_set(seed: int, count: int, writings: int) -> FaultSet:
    """``count`` letters, and letters with a slip of the pen."""
    rng = np.random.default_rng(seed)
    letters = repertoire(count, 2, rng)
    fit, calibration, nominal = (copybook(letters, writings, 2, rng) for _ in range(3))
    slipped, onset = slips(np.stack([e.stream for e in nominal], axis=1).astype(np.float64), rng)
    faulty = [
        ("slip", int(k), Episode.from_stream(slipped[:, n], e.spec, info=e.info))
        for n, (k, e) in enumerate(zip(onset, nominal, strict=True))
    ]
    return FaultSet("letters", fit, calibration, nominal, faulty)


def robot_fault_set(
    config: kit.Config,
    tasks: Sequence[str],
    episodes: int,
    kinds: Sequence[str],
    severity: str,
    faulty_episodes: int,
) -> FaultSet:
    """Robosuite skills, and the twins of nominal episodes with a fault each."""
    ask = partial(demonstrations, config, tasks)
    nominal = max(faulty_episodes, 12)
    labels = [
        EpisodeLabel(task, "faulty", kind, severity, seed, draw_onset(seed, task_spec(task).horizon))
        for task in tasks
        for kind in kinds
        for seed in role_seeds(0, task, "nominal", faulty_episodes)
    ]
    recordings = made(labels, config)
    faulty = [
        (x.kind, int(x.onset or 0), e) for x, e in zip(labels, recordings, strict=True) if len(e) > (x.onset or 0)
    ]
    fit, calibration = ask("fit", episodes), ask("calibration", episodes // 2)
    return FaultSet("robosuite", fit, calibration, ask("nominal", nominal), faulty)
