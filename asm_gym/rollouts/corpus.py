"""One corpus that every table of detection is judged on: recorded once, split for good, and checked when it is read.

    FOLDER/manifest.json                              what there is, with the SHA-256 of each file
    FOLDER/POLICY/episodes/TASK/ROLE/KIND-SEVERITY-SEED.npz

Roles are ``fit`` to learn from, ``calibration`` for thresholds, ``nominal`` to test on and ``faulty``, each the twin of
the nominal episode with its seed: all that is random in it, but for the fault, is the same. It is made in rounds, so
that a corpus of which only some are there is a smaller one of the same make.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, overload

from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.faults.suite import SEVERITIES, TEST, kinds_of, possible
from asm_gym.files import written_whole
from asm_gym.rollouts.parallel import ParallelConfig, Progress
from asm_gym.rollouts.record import record
from asm_gym.rollouts.run_folder import make_missing, versions
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.staging import environment
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.tasks import task as task_spec

VERSION = 2
"""Of what is recorded: another one has other episodes."""
SEED = 2026
"""Of which those of all episodes are drawn; no memory that is shipped has learned from them."""
MANIFEST = "manifest.json"


class Source(NamedTuple):
    """A policy in a task, and how many of its episodes there are of each role.

    Attributes:
        faults: whether each kind and severity happens once a round.
    """

    task: str
    policy: str = "scripted"
    fit: int = 0
    calibration: int = 0
    nominal: int = 0
    faults: bool = False


SKILLS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblyRound", "PickPlaceMilk")
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
"""To see that everything runs."""


@dataclass(frozen=True)
class Entry:
    """A file of the corpus.

    Args:
        policy: what acts.
        label: what happens.
        sha256: of the file.
        seconds: that it lasts [s].
    """

    policy: str
    label: EpisodeLabel
    sha256: str = ""
    seconds: float = 0.0

    @property
    def path(self) -> Path:
        """Where in the corpus it lies."""
        return Path(self.policy) / self.label.path

    @classmethod
    def of(cls, line: dict[str, Any]) -> Entry:
        """What ``as_line`` made."""
        about = {name: line.pop(name) for name in ("policy", "sha256", "seconds")}
        return cls(label=EpisodeLabel(**line), **about)

    def as_line(self) -> dict[str, Any]:
        """For the manifest."""
        label = {n: getattr(self.label, n) for n in ("task", "role", "kind", "severity", "seed", "onset")}
        return {"policy": self.policy, **label, "sha256": self.sha256, "seconds": self.seconds}


def wanted(source: Source, number: int, rounds: int = ROUNDS) -> list[Entry]:
    """What of a source is recorded in a round; of the first are all episodes to learn from and to calibrate on."""
    task, where = source.task, f"{source.policy}/{source.task}"

    def nominal(role: str, count: int) -> list[EpisodeLabel]:
        return [EpisodeLabel(task, role, seed=seed) for seed in role_seeds(SEED, where, role, count)]

    labels = [] if number else nominal("fit", source.fit) + nominal("calibration", source.calibration)
    tested = nominal("nominal", source.nominal)[number::rounds]
    labels += tested
    if source.faults:
        env: Any = environment(task_spec(task).id).unwrapped
        faults = product((kind for kind in kinds_of((TEST,)) if possible(kind, env)), SEVERITIES)
        seeds = [label.seed for label in tested]  # a scene each, as far as there are as many
        pairs = [(fault, seeds[k % len(seeds)]) for k, fault in enumerate(faults)]
        horizon = task_spec(task).horizon
        labels += [EpisodeLabel(task, "faulty", *fault, s, draw_onset(s, horizon)) for fault, s in pairs]
    return [Entry(source.policy, label) for label in labels]


def record_corpus(
    folder: Path, sources: Sequence[Source], number: int, rounds: int, parallel: ParallelConfig, progress: Progress
) -> None:
    """Records what of a round is missing, source by source, and adds it to the manifest."""
    known = {entry.path: entry for entry in read_manifest(folder)} if (folder / MANIFEST).is_file() else {}
    for source in sources:
        entries = wanted(source, number, rounds)
        make = partial(_record, config=RolloutConfig(source.policy), folder=folder.resolve())
        make_missing(make, entries, lambda entry: folder / entry.path, parallel, progress)
        for entry in entries:
            if entry.path not in known:
                episode = load_episode(folder / entry.path)
                seconds = round(len(episode) * episode.spec.dt, 6)
                known[entry.path] = Entry(entry.policy, entry.label, digest(folder / entry.path), seconds)
        about = {"format": "asm-gym corpus", "version": VERSION, "made_with": versions()}
        lines = ",\n".join(json.dumps(entry.as_line()) for _, entry in sorted(known.items()))
        with written_whole(folder / MANIFEST) as file:
            file.write(f'{json.dumps(about)[:-1]}, "files": [\n{lines}\n]}}\n'.encode())


def _record(entry: Entry, config: RolloutConfig, folder: Path) -> Path:
    return record(entry.label, config, folder / entry.policy)


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_manifest(folder: Path) -> list[Entry]:
    """What there is.

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
        entries = [Entry.of(dict(line)) for line in lines] if version == VERSION else []
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged or cut off: {error}; asm-gym corpus makes it anew") from error
    if version != VERSION:
        raise ValueError(
            f"{folder} holds version {version!r} of the corpus, this asm-gym reads {VERSION}: record it anew"
        )
    return entries


class Episodes(Sequence[Episode]):
    """Episodes of a corpus, each read, and compared with its checksum, when it is asked for."""

    def __init__(self, folder: Path, entries: Sequence[Entry]) -> None:
        self.folder, self.entries = folder, list(entries)

    def __len__(self) -> int:
        return len(self.entries)

    @overload
    def __getitem__(self, index: int) -> Episode: ...
    @overload
    def __getitem__(self, index: slice) -> Episodes: ...
    def __getitem__(self, index: int | slice) -> Episode | Episodes:
        if isinstance(index, slice):
            return Episodes(self.folder, self.entries[index])
        return load_episode(self._whole(self.entries[index]))

    def __iter__(self) -> Iterator[Episode]:
        return (self[k] for k in range(len(self)))

    def check(self) -> None:
        """Raises ValueError where a file is damaged."""
        for entry in self.entries:
            self._whole(entry)

    def _whole(self, entry: Entry) -> Path:
        path = self.folder / entry.path
        if digest(path) != entry.sha256:
            raise ValueError(
                f"{path} is damaged: its bytes are not what the manifest says; delete it, and record it anew"
            )
        return path


@dataclass(frozen=True)
class Corpus:
    """A corpus that is there.

    Example:
        >>> from asm_gym.rollouts.corpus import Corpus
        >>> corpus = Corpus.open("runs/corpus")  # doctest: +SKIP
        >>> nominal = corpus.episodes("nominal", tasks=("Lift",))  # doctest: +SKIP
    """

    folder: Path
    entries: tuple[Entry, ...]

    @classmethod
    def open(cls, folder: str | Path) -> Corpus:
        """Reads the manifest.

        Raises:
            FileNotFoundError: no corpus is there.
            ValueError: it is of another version, damaged, or cut off.
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

    def episodes(self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> Episodes:
        """Those of these roles, policies and tasks; of any where none is named."""
        chosen = (
            entry
            for entry in self.entries
            if (not roles or entry.label.role in roles)
            and (not policies or entry.policy in policies)
            and (not tasks or entry.label.task in tasks)
        )
        return Episodes(self.folder, list(chosen))
