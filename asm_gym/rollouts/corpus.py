"""The corpus on which every table of detection is judged: recorded in rounds, and checked while it is read.

    FOLDER/manifest.json                              the files, with the SHA-256 of each
    FOLDER/POLICY/episodes/TASK/ROLE/KIND-SEVERITY-SEED.npz

Roles are ``fit`` to learn from, ``calibration`` for thresholds, ``nominal`` to test on, and ``faulty``: each the twin
of the nominal episode with its seed, alike in all that is random but the fault. A corpus with some of its rounds is a
smaller one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

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


class Entry(NamedTuple):
    """A file of the corpus: the policy, the episode's label, the file's checksum, and its length [s]."""

    policy: str
    label: EpisodeLabel
    sha256: str
    seconds: float

    @property
    def path(self) -> Path:
        """Path in the corpus."""
        return self.policy / self.label.path


@dataclass(frozen=True)
class Corpus:
    """A recorded corpus."""

    folder: Path
    entries: tuple[Entry, ...]

    @classmethod
    def open(cls, folder: str | Path) -> Corpus:
        """Read the manifest.

        Raises:
            FileNotFoundError: no corpus is there.
            ValueError: it is of another version, damaged, or lacks files.
        """
        folder = Path(folder)
        entries = read_manifest(folder)
        missing = [entry.path for entry in entries if not (folder / entry.path).is_file()]
        if missing:
            raise ValueError(
                f"{folder} is cut off: {len(missing)} of {len(entries)} files are missing, such as {missing[0]}; "
                "asm-gym corpus records what is missing"
            )
        return cls(folder, tuple(entries))

    def select(self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> list[Entry]:
        """Select by role, policy and task; all where none is named."""
        return [
            entry
            for entry in self.entries
            if (not roles or entry.label.role in roles)
            and (not policies or entry.policy in policies)
            and (not tasks or entry.label.task in tasks)
        ]

    def verified(self, entry: Entry) -> Path:
        """Return the path of a file. Raises ValueError where it is damaged."""
        path = self.folder / entry.path
        if digest(path) != entry.sha256:
            raise ValueError(f"{path} is damaged: its checksum is not the manifest's; delete it, and record it anew")
        return path

    def episodes(self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> list[Episode]:
        """Load episodes by role, policy and task, and compare each with its checksum; all where none is named."""
        return [load_episode(self.verified(entry)) for entry in self.select(*roles, policies=policies, tasks=tasks)]


def skill_files(folder: Path, tasks: Sequence[str] = SKILLS) -> list[Path]:
    """Return the files of the experts' skills, verified, and sorted by kind and severity."""
    corpus = Corpus.open(folder)
    kinds = [(kind, severity) for kind in ("", *KINDS) for severity in ("", *SEVERITIES)]
    chosen = corpus.select(policies=("scripted",), tasks=tasks)
    return [
        corpus.verified(entry) for entry in sorted(chosen, key=lambda e: kinds.index((e.label.kind, e.label.severity)))
    ]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_manifest(folder: Path, entries: Sequence[Entry]) -> None:
    """Write the manifest of these files, and the versions that recorded them."""
    about = {"format": "asm-gym corpus", "version": VERSION, "made_with": versions()}
    lines = []
    for entry in sorted(entries, key=lambda entry: entry.path):
        label = {name: getattr(entry.label, name) for name in _LABEL}
        lines.append(json.dumps({"policy": entry.policy, **label, "sha256": entry.sha256, "seconds": entry.seconds}))
    files = ",\n".join(lines)
    with written_whole(folder / MANIFEST) as file:
        file.write(f'{json.dumps(about)[:-1]}, "files": [\n{files}\n]}}\n'.encode())


def read_manifest(folder: Path) -> list[Entry]:
    """Return the files of a corpus.

    Raises:
        FileNotFoundError: no corpus is there.
        ValueError: it is of another version, or damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(2, "no corpus is there; asm-gym corpus records one", str(path))
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        version, lines = about["version"], about["files"]
        if version != VERSION:
            raise ValueError(f"it holds version {version!r} of the corpus, and this asm-gym reads {VERSION}")
        return [Entry(e["policy"], EpisodeLabel(**{n: e[n] for n in _LABEL}), e["sha256"], e["seconds"]) for e in lines]
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
    folder: Path, sources: Sequence[Source], number: int, rounds: int, workers: int | str, progress: Progress
) -> None:
    """Record what is missing of a round, source by source, and add it to the manifest."""
    known = {entry.path: entry for entry in read_manifest(folder)} if (folder / MANIFEST).is_file() else {}
    for source in sources:
        wanted = trials(source, number, rounds)
        paths = [Path(source.policy) / trial.label.path for trial in wanted]
        new = {path for path in paths if not (folder / path).is_file()}
        known = {path: entry for path, entry in known.items() if path not in new}
        files = record_missing(wanted, RolloutConfig(source.policy), folder / source.policy, workers, progress)
        for trial, path, file in zip(wanted, paths, files, strict=True):
            if path not in known:
                episode = load_episode(file)
                seconds = round(len(episode) * episode.spec.dt, 6)
                entry = Entry(source.policy, trial.label, digest(file), seconds)
                known[entry.path] = entry
        write_manifest(folder, list(known.values()))
