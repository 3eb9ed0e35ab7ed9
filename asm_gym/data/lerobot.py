"""LeRobot datasets, versions 2 and 3: read, and written so that a LeRobot user can train on them.

    meta/info.json     version, rate (fps), and the features: dtype, shape, names
    data/**/*.parquet  a row a frame: observation.state, action, episode_index, frame_index, …
                       version 2 has a file for each episode, version 3 many episodes in one

Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3. Files are written as version 2.1, which it converts.
The library itself is not asked by any test: it cannot be installed beside robosuite.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.tabular import read_parquet
from asm_gym.episode import Episode
from asm_gym.extras import require

INFO = Path("meta") / "info.json"
CHECKSUMS = "SHA256SUMS"
"""What our exports carry beside what LeRobot reads; ``sha256sum --check SHA256SUMS`` asks it."""
VERSION = "v2.1"
DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
CHUNK = 1000
"""Episodes in a folder."""

SENSED, COMMANDED = "observation.", "action"
"""Features that are read begin so; pictures are not."""


def read_lerobot(folder: Path) -> Iterator[tuple[dict[str, NDArray[Any]], float, bool]]:
    """The columns of each episode, its rate [Hz], and whether it succeeded (where nobody says, it did).

    Raises:
        ValueError: what the folder says of itself cannot be read, is of another version, or is not in its files; a
            file is not as it was written.
    """
    _check_whole(folder)
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
            yield {k: v for name in read for k, v in _split(name, columns[name][rows], read[name])}, rate, success


def _names(feature: dict[str, Any]) -> list[str]:
    """Of the numbers of a feature; empty where they have none. LeRobot has a list, or lists by what they name."""
    names = feature.get("names") or []
    lists = names.values() if isinstance(names, dict) else [names]
    found = [str(name) for part in lists if isinstance(part, list) for name in part]
    return found if len(set(found)) == len(found) else []


def _split(name: str, values: NDArray[Any], names: Sequence[str]) -> Iterator[tuple[str, NDArray[Any]]]:
    """A feature's columns, named where its numbers are."""
    if values.ndim == 2 and len(names) == values.shape[1]:
        yield from ((f"{name}[{element}]", values[:, k]) for k, element in enumerate(names))
    else:
        yield name, values


def write_lerobot(folder: Path, episodes: Sequence[Episode], task: str, robot: str = "unknown") -> Path:
    """Writes episodes as a LeRobot dataset to an empty or new folder: senses as observation.state, then action.

    Args:
        task: what the robot did, in words.
        robot: LeRobot's ``robot_type``.

    Raises:
        ValueError: no episode, episodes of several specs, a stream without an action, or a folder that holds something.
    """
    pa, parquet = (require(name, what="a LeRobot dataset") for name in ("pyarrow", "pyarrow.parquet"))
    if not episodes:
        raise ValueError("a dataset needs at least one episode, got none")
    spec = episodes[0].spec
    for n, episode in enumerate(episodes):
        spec.require(episode.spec, f"episode {n}")
    if not len(spec.motor):
        raise ValueError("a LeRobot dataset needs actions, and this stream has none")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} holds something already: name another folder")
    rate = 1 / spec.dt
    parts = {"observation.state": spec.sensory, "action": spec.motor}
    counts = "frame_index", "episode_index", "index", "task_index"
    scalars = {"timestamp": "float32", **dict.fromkeys(counts, "int64")}
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(where)], "names": [spec.labels[i] for i in where]}
        for name, where in parts.items()
    }
    features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in scalars.items()}
    total, listed, stats = 0, [], []
    for n, episode in enumerate(episodes):
        T = len(episode)
        arrays = {name: episode.stream[:, where] for name, where in parts.items()}
        numbers = {
            "timestamp": np.arange(T, dtype=np.float32) * np.float32(spec.dt),
            "frame_index": np.arange(T),
            "episode_index": np.full(T, n),
            "index": np.arange(total, total + T),
            "task_index": np.zeros(T, np.int64),
        }
        columns = {k: pa.FixedSizeListArray.from_arrays(v.ravel(), v.shape[1]) for k, v in arrays.items()}
        file = folder / DATA.format(episode_chunk=n // CHUNK, episode_index=n)
        file.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(columns | {k: pa.array(v) for k, v in numbers.items()}), file)
        listed.append({"episode_index": n, "tasks": [task], "length": T})
        stats.append({"episode_index": n, "stats": {k: _stats(v) for k, v in (arrays | numbers).items()}})
        total += T
    info = {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": total,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": (len(episodes) - 1) // CHUNK + 1,
        "chunks_size": CHUNK,
        "fps": round(rate) if abs(rate - round(rate)) < 1e-6 else rate,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA,
        "video_path": None,
        "features": features,
    }
    (folder / "meta").mkdir()
    (folder / INFO).write_text(json.dumps(info, indent=4), encoding="utf-8")
    lines = {"episodes": listed, "tasks": [{"task_index": 0, "task": task}], "episodes_stats": stats}
    for name, rows in lines.items():
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (folder / "meta" / f"{name}.jsonl").write_text(text, encoding="utf-8")
    written = sorted(f for f in folder.rglob("*") if f.is_file())
    sums = "".join(f"{_digest(file)}  {file.relative_to(folder).as_posix()}\n" for file in written)
    (folder / CHECKSUMS).write_text(sums, encoding="utf-8")
    return folder


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _check_whole(folder: Path) -> None:
    """Raises ValueError unless the files are those that were written; datasets of others have no checksums."""
    if not (folder / CHECKSUMS).is_file():
        return
    for line in (folder / CHECKSUMS).read_text(encoding="utf-8").splitlines():
        digest, _, name = line.partition("  ")
        file = folder / name
        if ".." in Path(name).parts or Path(name).is_absolute() or not file.is_file() or _digest(file) != digest:
            raise ValueError(f"{file} is not as it was written (where it was changed on purpose, remove {CHECKSUMS})")


def _stats(values: NDArray[Any]) -> dict[str, list[float]]:
    rows = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    return {name: array.tolist() for name, array in found.items()} | {"count": [len(rows)]}
