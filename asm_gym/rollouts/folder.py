"""Folders of runs: a second call with the same settings goes on in one, a call with others is refused."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from typing import Any

import asm_gym


def versions() -> dict[str, str]:
    """Of what decides over an episode."""
    others = {p: metadata.version(p) for p in ("robosuite", "mujoco", "gymnasium", "numpy")}
    return {"asm_gym": asm_gym.__version__, **others}


def claim_folder(folder: Path, name: str, settings: dict[str, Any]) -> None:
    """Makes ``folder`` a run's own, or goes on with it.

    Args:
        name: of the file in it that says whose it is.
        settings: what all that is kept there depends on; versions are added.

    Raises:
        ValueError: it holds a run of other settings; the message names them.
    """
    ours = json.loads(json.dumps(settings, default=str)) | versions()
    path = folder / name
    if path.is_file():
        theirs = json.loads(path.read_text(encoding="utf-8"))
        other = [f"{n}: {theirs.get(n)!r} there, {ours[n]!r} here" for n in ours if theirs.get(n) != ours[n]]
        if other:
            raise ValueError(f"{folder} holds recordings of other settings ({'; '.join(other)}): name another --out")
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(ours, indent=2) + "\n", encoding="utf-8")
