"""The corpus on which every table of detection is judged, checked while it is read.

    FOLDER/manifest.json                              the files, with the SHA-256 of each
    FOLDER/POLICY/episodes/TASK/ROLE/KIND-SEVERITY-SEED.npz

Roles are ``fit`` to learn from, ``calibration`` for thresholds, ``nominal`` to test on, and ``faulty``: each the twin
of the nominal episode with its seed, alike in all that is random but the fault.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.faults.suite import KINDS, SEVERITIES
from asm_gym.files import written_whole

VERSION = 2
"""Version of the recordings."""
SKILLS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblyRound", "PickPlaceMilk")
"""Tasks with episodes to learn from, to calibrate on and to test on."""
MANIFEST = "manifest.json"
_LABEL = ("task", "role", "kind", "severity", "seed", "onset")


@dataclass(frozen=True)
class Entry:
    """A file of the corpus.

    Args:
        policy: that acts.
        label: of the episode.
        sha256: of the file.
        seconds: length of the episode [s].
    """

    policy: str
    label: EpisodeLabel
    sha256: str
    seconds: float

    @property
    def path(self) -> Path:
        """Path in the corpus."""
        return Path(self.policy) / self.label.path

    def as_line(self) -> dict[str, Any]:
        """Return what the manifest says of it."""
        label = {n: getattr(self.label, n) for n in _LABEL}
        return {"policy": self.policy, **label, "sha256": self.sha256, "seconds": self.seconds}


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_manifest(folder: Path, entries: Sequence[Entry], made_with: dict[str, str]) -> None:
    """Write the manifest of these files, and the versions that recorded them."""
    about = {"format": "asm-gym corpus", "version": VERSION, "made_with": made_with}
    lines = ",\n".join(json.dumps(entry.as_line()) for entry in sorted(entries, key=lambda entry: entry.path))
    with written_whole(folder / MANIFEST) as file:
        file.write(f'{json.dumps(about)[:-1]}, "files": [\n{lines}\n]}}\n'.encode())


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


class Episodes(Sequence[Episode]):
    """Episodes of a corpus; each is read, and compared with its checksum, when it is accessed."""

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
        return load_episode(self._verified(self.entries[index]))

    def __iter__(self) -> Iterator[Episode]:
        return (self[k] for k in range(len(self)))

    def check(self) -> None:
        """Raise ValueError where a file is damaged."""
        for entry in self.entries:
            self._verified(entry)

    def _verified(self, entry: Entry) -> Path:
        path = self.folder / entry.path
        if digest(path) != entry.sha256:
            raise ValueError(f"{path} is damaged: its checksum is not the manifest's; delete it, and record it anew")
        return path


@dataclass(frozen=True)
class Corpus:
    """A recorded corpus.

    Example:
        >>> from asm_gym.evaluation.corpus import Corpus
        >>> corpus = Corpus.open("runs/corpus")  # doctest: +SKIP
        >>> nominal = corpus.episodes("nominal", tasks=("Lift",))  # doctest: +SKIP
    """

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

    def episodes(self, *roles: str, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> Episodes:
        """Select by role, policy and task; all where none is named."""
        chosen = (
            entry
            for entry in self.entries
            if (not roles or entry.label.role in roles)
            and (not policies or entry.policy in policies)
            and (not tasks or entry.label.task in tasks)
        )
        return Episodes(self.folder, list(chosen))


def skill_labels(folder: Path) -> list[EpisodeLabel]:
    """Return the labels of the experts' skills, sorted by kind and severity, once their files are verified."""
    skills = Corpus.open(folder).episodes(policies=("scripted",), tasks=SKILLS)
    skills.check()
    kinds = [(kind, severity) for kind in ("", *KINDS) for severity in ("", *SEVERITIES)]
    return sorted((e.label for e in skills.entries), key=lambda label: kinds.index((label.kind, label.severity)))
