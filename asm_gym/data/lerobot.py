"""Read LeRobot datasets, versions 2 and 3, without LeRobot.

    meta/info.json     version, rate (fps), and the features: dtype, shape, names
    data/**/*.parquet  a row a frame: observation.state, action, episode_index, frame_index, …
                       version 2 has a file for each episode, version 3 many episodes in one

Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from asm_gym.data.arrays import read_parquet
from asm_gym.data.tables import Columns, as_array

INFO = Path("meta") / "info.json"

SENSED, COMMANDED = "observation.", "action"  # features that are read begin so; pictures are left out


def read_lerobot(folder: Path) -> Iterator[tuple[Columns, float, bool]]:
    """Yield the columns of each episode, its rate [Hz], and whether it succeeded (by default it did)."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        version, rate, features = info["codebase_version"], float(info["fps"]), dict(info["features"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / INFO} is no LeRobot dataset's: {error!r}") from error
    if not str(version).startswith(("v2", "v3")):
        raise ValueError(f"{folder} is of LeRobot's {version}, and v2 and v3 can be read")
    read = {
        name: _names(feature)
        for name, feature in features.items()
        if name.startswith((SENSED, COMMANDED)) and str(feature.get("dtype", "")).startswith(("float", "int"))
    }
    if not any(name.startswith(SENSED) for name in read):
        raise ValueError(f"{folder} has no feature that is sensed, observation.… of numbers: {', '.join(features)}")
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise ValueError(f"{folder} holds no data/**/*.parquet")
    for file in files:
        columns = read_parquet(file)
        missing = [name for name in (*read, "episode_index") if name not in columns]
        if missing:
            raise ValueError(f"{file} lacks {', '.join(missing)}, which {INFO} declares")
        index = columns["episode_index"]
        for episode in dict.fromkeys(index.tolist()):
            rows = index == episode
            success = bool(columns["next.success"][rows].any()) if "next.success" in columns else True
            found = {name: as_array(columns[name][rows]) for name in read}
            made = {k: v for name in read for k, v in _split(name, found[name], read[name])}
            stamps = {"timestamp": columns["timestamp"][rows]} if "timestamp" in columns else {}
            yield stamps | made, rate, success  # frames that were lost are known by the stamps alone


def _names(feature: dict[str, Any]) -> list[str]:
    """Names of the numbers of a feature, in a list or in lists by what they name; empty where they have none."""
    names = feature.get("names") or []
    found = list(_words(list(names.values()) if isinstance(names, dict) else names))
    return found if len(set(found)) == len(found) else []


def _words(names: Any) -> Iterator[str]:
    """The names in lists at any depth."""
    for name in names if isinstance(names, list) else []:
        yield from _words(name) if isinstance(name, list) else [str(name)]


def _split(name: str, values: NDArray[Any], names: Sequence[str]) -> Iterator[tuple[str, NDArray[Any]]]:
    """A feature's columns, each by its name where there are names."""
    if values.ndim == 2 and len(names) == values.shape[1]:
        yield from ((f"{name}[{element}]", values[:, k]) for k, element in enumerate(names))
    else:
        yield name, values
