"""Record the corpus of ``asm_gym.evaluation.corpus``, in rounds: a corpus with some of its rounds is a smaller one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from asm_gym.episode import load_episode
from asm_gym.evaluation.corpus import MANIFEST, SKILLS, Entry, digest, read_manifest, write_manifest
from asm_gym.faults.suite import SEVERITIES, TEST, kinds_of, possible
from asm_gym.rollouts.parallel import ParallelConfig, Progress
from asm_gym.rollouts.run_folder import make_missing, versions
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.staging import environment, record
from asm_gym.rollouts.trial import RolloutConfig, Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec

SEED = 2026
"""Seed of the corpus; no shipped memory has learned from its episodes."""


class Source(NamedTuple):
    """A policy in a task, and its number of episodes of each role.

    Attributes:
        faults: whether each kind and severity happens once per round.
    """

    task: str
    policy: str = "scripted"
    fit: int = 0
    calibration: int = 0
    nominal: int = 0
    faults: bool = False


PARTS: dict[str, tuple[Source, ...]] = {
    "skills": tuple(Source(task, "scripted", 40, 100, 335, faults=True) for task in SKILLS),
    "hours": (
        *(Source("Lift", "lift_sac", nominal=1190), Source("Stack", "stack_sac", nominal=790)),
        *(Source("Door", "door_sac", nominal=790), Source("NutAssemblySquare", nominal=450)),
        *(Source("PickPlaceBread", nominal=400), Source("PickPlaceCereal", nominal=400)),
    ),
}
"""Six skills of experts, to learn, to calibrate and to test on; and healthy motion of agents and in other tasks."""
ROUNDS = 5
QUICK = {"skills": (Source("Lift", "scripted", 2, 2, 2, faults=True),), "hours": (Source("Lift", "lift_sac", 0, 0, 2),)}


def trials(source: Source, number: int, rounds: int = ROUNDS) -> list[Trial]:
    """Return the trials of a source in a round; the first has all episodes to learn from and to calibrate on."""
    env_id, where = task_spec(source.task).id, f"{source.policy}/{source.task}"
    found = []
    for role, count in (("fit", source.fit), ("calibration", source.calibration)):
        found += nominal_trials(env_id, role, role_seeds(SEED, where, role, 0 if number else count))
    seeds = role_seeds(SEED, where, "nominal", source.nominal)[number::rounds]
    found += nominal_trials(env_id, "nominal", seeds)
    if source.faults:
        env: Any = environment(env_id).unwrapped
        faults = product((kind for kind in kinds_of((TEST,)) if possible(kind, env)), SEVERITIES)
        horizon = task_spec(source.task).horizon
        # A scene each, as far as there are as many.
        found += [faulty_trial(env_id, *fault, seeds[k % len(seeds)], horizon) for k, fault in enumerate(faults)]
    return found


def record_corpus(
    folder: Path, sources: Sequence[Source], number: int, rounds: int, parallel: ParallelConfig, progress: Progress
) -> None:
    """Record what is missing of a round, source by source, and add it to the manifest."""
    known = {entry.path: entry for entry in read_manifest(folder)} if (folder / MANIFEST).is_file() else {}
    for source in sources:
        wanted = trials(source, number, rounds)
        make = partial(record, config=RolloutConfig(source.policy), folder=folder.resolve() / source.policy)
        places = {trial: folder / source.policy / trial.label.path for trial in wanted}
        files = make_missing(make, wanted, places.__getitem__, parallel, progress)
        for trial, file in zip(wanted, files, strict=True):
            if Path(source.policy) / trial.label.path not in known:
                episode = load_episode(file)
                seconds = round(len(episode) * episode.spec.dt, 6)
                entry = Entry(source.policy, trial.label, digest(file), seconds)
                known[entry.path] = entry
        write_manifest(folder, list(known.values()), versions())
