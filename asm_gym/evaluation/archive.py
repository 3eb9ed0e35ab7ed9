"""Recorded episodes as files: one each, complete or not there, so that a run can be killed and go on."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from asm_gym.episodes import Episode
from asm_gym.stream import StreamSpec

FORMAT = 1


@dataclass(frozen=True)
class Label:
    """What an episode was recorded as.

    Args:
        task: a task's name.
        role: ``"fit"``, ``"calibration"``, ``"nominal"``, ``"faulty"`` or ``"harmless"``.
        kind: of the fault or the harmless variation; empty for the others.
        severity: of the fault; empty for the others.
        seed: of the environment and of the policy. Episodes that share it are twins.
        onset: the first step with the fault or variation; None without one.
    """

    task: str
    role: str
    kind: str = ""
    severity: str = ""
    seed: int = 0
    onset: int | None = None

    @property
    def path(self) -> Path:
        """Where in a run's folder the episode lies."""
        parts = [part for part in (self.kind, self.severity) if part]
        return Path("episodes") / self.task / self.role / "-".join([*parts, f"{self.seed}.npz"])


@dataclass(frozen=True, eq=False)
class Recording:
    """One recorded episode with its label.

    Args:
        label: what it is.
        episode: stream, success, ground truth.
        contact_force: (T,) [N].
        guilty: channels in which an attentive observer would see the fault first.
    """

    label: Label
    episode: Episode
    contact_force: NDArray[np.float32]
    guilty: frozenset[str] = frozenset()


def write(folder: Path, recording: Recording) -> Path:
    """Writes one recording to its place under ``folder``; it appears there only when it is complete."""
    path = folder / recording.label.path
    path.parent.mkdir(parents=True, exist_ok=True)
    episode = recording.episode
    header = {
        "format": FORMAT,
        "label": asdict(recording.label),
        "spec": episode.spec.to_json(),
        "success": bool(episode.success),
        "guilty": sorted(recording.guilty),
    }
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            np.savez_compressed(
                file,
                header=np.frombuffer(json.dumps(header).encode(), np.uint8),
                stream=episode.stream,
                faults=episode.faults,
                contact_force=recording.contact_force,
            )
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def read(path: Path) -> Recording:
    """What ``write`` wrote.

    Raises:
        ValueError: the file is damaged, or of a format this version does not know.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header: dict[str, Any] = json.loads(arrays["header"].tobytes())
            if header["format"] != FORMAT:
                raise ValueError(f"format {header['format']}, this version reads {FORMAT}")
            label = Label(**header["label"])
            episode = Episode(
                stream=arrays["stream"],
                spec=StreamSpec.from_json(header["spec"]),
                success=header["success"],
                seed=label.seed,
                faults=arrays["faults"],
                info={"skill": label.task},
            )
            return Recording(label, episode, arrays["contact_force"], frozenset(header["guilty"]))
    except (OSError, EOFError, KeyError, TypeError, ValueError, BadZipFile) as error:
        raise ValueError(f"{path} is not a recording that can be read: {error}") from error
