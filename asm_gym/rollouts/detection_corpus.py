"""The corpus on which every table of detection is judged, recorded in rounds.

    FOLDER/recordings.json                            which corpus it is
    FOLDER/POLICY/episodes/TASK/ROLE/KIND-SEVERITY-SEED.npz

Roles are ``fit`` to learn from, ``calibration`` for thresholds, ``nominal`` to test on, and ``faulty``: each the twin
of the nominal episode with its seed, alike in all that is random but the fault. A corpus with some of its rounds is a
smaller one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, product
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from asm_gym.data.episode import Episode, load_episode
from asm_gym.faults.suite import KINDS, SEVERITIES, TEST, kinds_of, possible
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.run_trials import environment, record_missing
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec
from asm_gym.validation import check_choice

VERSION = 2  # version of the recordings
SEED = 2026  # seed of the corpus; no shipped memory has learned from its episodes
SKILLS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblyRound", "PickPlaceMilk")
"""Tasks with episodes to learn from, to calibrate on and to test on."""
CLAIM = "recordings.json"
COLUMNS = ("policy", "task", "role", "kind", "severity")  # of ``Corpus.files``


class Source(NamedTuple):
    """A policy in a task, and its number of episodes of each role."""

    task: str
    policy: str = "scripted"
    fit: int = 0
    calibration: int = 0
    nominal: int = 0
    faults: bool = False  # whether each kind and severity happens once per round


PARTS: dict[str, tuple[Source, ...]] = {
    "skills": tuple(
        Source(task, fit=100, calibration=100, nominal=335, faults=True) for task in SKILLS
    ),
    "hours": (
        Source("Lift", "lift_sac", nominal=1190),
        Source("Stack", "stack_sac", nominal=790),
        Source("Door", "door_sac", nominal=790),
        Source("NutAssemblySquare", nominal=450),
        Source("PickPlaceCan", "can_clone", nominal=300),
        Source("PickPlaceMilk", "milk_clone", nominal=300),
        Source("PickPlaceBread", "bread_clone", nominal=300),
        Source("PickPlaceCereal", "cereal_clone", nominal=400),
        Source("NutAssemblySquare", "square_clone", nominal=400),
        Source("PickPlaceBread", nominal=400),
        Source("PickPlaceCereal", nominal=400),
    ),
}
"""Six skills of experts, to learn, to calibrate and to test on; and healthy motion of agents and in other tasks."""
ROUNDS = 5
QUICK: dict[str, tuple[Source, ...]] = {
    "skills": (Source("Lift", fit=2, calibration=2, nominal=2, faults=True),),
    "hours": (Source("Lift", "lift_sac", nominal=2),),
}


@dataclass(frozen=True)
class Corpus:
    """A recorded corpus: its folder, and a row for each file, whose index is the file's path in the folder."""

    folder: Path
    files: pd.DataFrame

    @classmethod
    def open(cls, folder: str | Path) -> Corpus:
        """Find the files. Raises FileNotFoundError where no corpus is there, ValueError where it is another version."""
        folder = Path(folder)
        claim = folder / CLAIM
        if not claim.is_file():
            raise FileNotFoundError(2, "no corpus is there; asm-gym corpus records one", str(claim))
        version = json.loads(claim.read_text(encoding="utf-8")).get("corpus")
        if version != VERSION:
            raise ValueError(
                f"{claim} is of version {version!r} of the corpus, and this asm-gym reads {VERSION}"
            )
        paths = [path.relative_to(folder) for path in folder.glob("*/episodes/*/*/*.npz")]
        rows = {path.as_posix(): cls._row(path) for path in sorted(paths)}
        files = pd.DataFrame.from_dict(rows, orient="index", columns=COLUMNS, dtype=object)
        return cls(folder, files)

    @staticmethod
    def _row(path: Path) -> tuple[str, ...]:
        """Return ``COLUMNS`` of POLICY/episodes/TASK/ROLE/[KIND-SEVERITY-]SEED.npz."""
        policy, _, task, role, _ = path.parts
        fault = path.stem.split("-")[:-1]
        return policy, task, role, *(fault or ("", ""))

    def episodes(
        self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()
    ) -> list[Episode]:
        """Load episodes by role, policy and task; all where none is named."""
        chosen = self.files
        for name, values in (("role", roles), ("policy", policies), ("task", tasks)):
            if values:
                chosen = chosen[chosen[name].isin(values)]
        return [load_episode(self.folder / path) for path in chosen.index]


def skill_files(folder: Path, fit: int | None = None, tasks: Sequence[str] = SKILLS) -> list[Path]:
    """Return the files of the experts' skills, by kind and severity; of each task at most ``fit`` to learn from."""
    for task in tasks:
        check_choice("task of the corpus", task, SKILLS)
    files = Corpus.open(folder).files
    order = {name: n for n, name in enumerate(("", *KINDS, *SEVERITIES))}
    chosen = files[(files.policy == "scripted") & files.task.isin(tasks)]
    if fit is not None:
        number = chosen.groupby(["task", "role"]).cumcount()
        chosen = chosen[(chosen.role != "fit") | (number < fit)]
    chosen = chosen.sort_values(
        ["kind", "severity"], key=lambda names: names.map(order), kind="stable"
    )
    return [folder / path for path in chosen.index]


def trials(source: Source, number: int, rounds: int = ROUNDS) -> list[Trial]:
    """Return the trials of a source in a round; the first has all episodes to learn from and to calibrate on."""
    env_id = task_spec(source.task).id
    name = f"{source.policy}/{source.task}"
    planned = []
    if number == 0:
        for role, count in (("fit", source.fit), ("calibration", source.calibration)):
            planned += nominal_trials(env_id, role, role_seeds(SEED, name, role, count))
    seeds = role_seeds(SEED, name, "nominal", source.nominal)[number::rounds]
    planned += nominal_trials(env_id, "nominal", seeds)
    if source.faults:
        env: Any = environment(env_id).unwrapped
        kinds = [kind for kind in kinds_of((TEST,)) if possible(kind, env)]
        horizon = task_spec(source.task).horizon
        # a scene each, as far as there are as many
        for (kind, severity), seed in zip(product(kinds, SEVERITIES), cycle(seeds), strict=False):
            planned.append(faulty_trial(env_id, kind, severity, seed, horizon))
    return planned


def record_corpus(
    folder: Path,
    sources: Sequence[Source],
    number: int,
    rounds: int,
    workers: int,
    progress: Progress,
) -> None:
    """Record what is missing of a round, source by source."""
    for source in sources:
        planned = trials(source, number, rounds)
        config = RolloutConfig(source.policy)
        record_missing(planned, config, folder / source.policy, workers, progress)
