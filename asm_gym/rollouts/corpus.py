"""The corpus on which every table of detection is judged, recorded in rounds.

    FOLDER/manifest.json                              the files, with label and length of each
    FOLDER/POLICY/episodes/TASK/ROLE/KIND-SEVERITY-SEED.npz

Roles are ``fit`` to learn from, ``calibration`` for thresholds, ``nominal`` to test on, and ``faulty``: each the twin
of the nominal episode with its seed, alike in all that is random but the fault. A corpus with some of its rounds is a
smaller one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from asm_gym.data.episode import Episode, EpisodeLabel, load_episode
from asm_gym.faults.suite import KINDS, SEVERITIES, TEST, kinds_of, possible
from asm_gym.files import written_whole
from asm_gym.rollouts.collect import environment, record_missing
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.run_folder import versions
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec

VERSION = 2  # version of the recordings
SEED = 2026  # seed of the corpus; no shipped memory has learned from its episodes
SKILLS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblyRound", "PickPlaceMilk")
"""Tasks with episodes to learn from, to calibrate on and to test on."""
MANIFEST = "manifest.json"
_LABEL = ("task", "role", "kind", "severity", "seed", "onset")
COLUMNS = ("policy", *_LABEL, "seconds")  # of the manifest: the policy, the episode's label, and its length [s]


class Source(NamedTuple):
    """A policy in a task, and its number of episodes of each role."""

    task: str
    policy: str = "scripted"
    fit: int = 0
    calibration: int = 0
    nominal: int = 0
    faults: bool = False  # whether each kind and severity happens once per round


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


@dataclass(frozen=True)
class Corpus:
    """A recorded corpus: its folder, and a row for each file, whose index is the file's path in the folder."""

    folder: Path
    files: pd.DataFrame

    @classmethod
    def open(cls, folder: str | Path) -> Corpus:
        """Read the manifest.

        Raises:
            FileNotFoundError: no corpus is there.
            ValueError: it is of another version, damaged, or lacks files.
        """
        folder = Path(folder)
        files = read_manifest(folder)
        missing = [path for path in files.index if not (folder / path).is_file()]
        if missing:
            raise ValueError(
                f"{folder} is cut off: {len(missing)} of {len(files)} files are missing, such as {missing[0]}; "
                "asm-gym corpus records what is missing"
            )
        return cls(folder, files)

    def episodes(self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> list[Episode]:
        """Load episodes by role, policy and task; all where none is named."""
        chosen = self.files
        for name, values in (("role", roles), ("policy", policies), ("task", tasks)):
            chosen = chosen[chosen[name].isin(values)] if values else chosen
        return [load_episode(self.folder / path) for path in chosen.index]


def skill_files(folder: Path, fit: int | None = None) -> list[Path]:
    """Return the files of the experts' skills, by kind and severity; of each task at most ``fit`` to learn from."""
    files = Corpus.open(folder).files
    order = {name: n for n, name in enumerate(("", *KINDS, *SEVERITIES))}
    chosen = files[(files.policy == "scripted") & files.task.isin(SKILLS)]
    if fit is not None:
        chosen = chosen[(chosen.role != "fit") | (chosen.groupby(["task", "role"]).cumcount() < fit)]
    chosen = chosen.sort_values(["kind", "severity"], key=lambda names: names.map(order), kind="stable")
    return [folder / path for path in chosen.index]


def place(policy: str, label: EpisodeLabel) -> str:
    """Return the path of a file in the corpus."""
    return (policy / label.path).as_posix()


def write_manifest(folder: Path, files: dict[str, dict[str, Any]]) -> None:
    """Write the manifest of these files, and the versions that recorded them."""
    about = {"format": "asm-gym corpus", "version": VERSION, "made_with": versions()}
    lines = ",\n".join(json.dumps(files[path]) for path in sorted(files))
    with written_whole(folder / MANIFEST) as manifest:
        manifest.write(f'{json.dumps(about)[:-1]}, "files": [\n{lines}\n]}}\n'.encode())


def read_manifest(folder: Path) -> pd.DataFrame:
    """Return the files of a corpus: a row each, by path.

    Raises:
        FileNotFoundError: no corpus is there.
        ValueError: it is of another version, or damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(2, "no corpus is there; asm-gym corpus records one", str(path))
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        version, files = about["version"], about["files"]
        if version != VERSION:
            raise ValueError(f"it holds version {version!r} of the corpus, and this asm-gym reads {VERSION}")
        paths = [place(f["policy"], EpisodeLabel(**{name: f[name] for name in _LABEL})) for f in files]
        return pd.DataFrame(files, paths, COLUMNS, dtype=object)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be read: {error}; asm-gym corpus makes it anew") from error


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
    folder: Path, sources: Sequence[Source], number: int, rounds: int, workers: int, progress: Progress
) -> None:
    """Record what is missing of a round, source by source, and add it to the manifest."""
    there = (folder / MANIFEST).is_file()
    known: dict[str, dict[str, Any]] = read_manifest(folder).to_dict("index") if there else {}
    for source in sources:
        wanted = trials(source, number, rounds)
        paths = [place(source.policy, trial.label) for trial in wanted]
        new = {path for path in paths if path not in known or not (folder / path).is_file()}
        files = record_missing(wanted, RolloutConfig(source.policy), folder / source.policy, workers, progress)
        for trial, path, file in zip(wanted, paths, files, strict=True):
            if path in new:
                episode = load_episode(file)
                seconds = round(len(episode) * episode.spec.dt, 6)
                label = {name: getattr(trial.label, name) for name in _LABEL}
                known[path] = {"policy": source.policy, **label, "seconds": seconds}
        write_manifest(folder, known)
