"""Write episodes as Minari datasets, and read those of others, and of LeRobot without LeRobot.

Minari     T + 1 observations and T actions, rewards, terminations and truncations of each episode; ours hold the
           sensorimotor stream, (T, D), in ``infos`` as well, and name its channels in the metadata
LeRobot    meta/info.json: version, rate (fps), and the features: dtype, shape, names; data/**/*.parquet: a row a frame.
           Version 2 has a file for each episode, version 3 many episodes in one

Sources: Younis et al. 2024, https://minari.farama.org; https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces.utils import flatten_space
from numpy.typing import NDArray

from asm_gym.data.arrays import check_hdf5, read_parquet
from asm_gym.data.episode import Episode, check_recorded
from asm_gym.data.tables import Columns, as_array
from asm_gym.extras import require
from asm_gym.spec import StreamSpec, control_period, flat_rows
from asm_gym.tasks import TASKS
from asm_gym.validation import check_text, typed

METADATA, ARRAYS = "metadata.json", "main_data.hdf5"  # files of a dataset's folder ``data``
# files that this package has written there, the last one until 1.0
OWN_FILES = (
    ARRAYS,
    METADATA,
    "SHA256SUMS",
)
SPARE_BYTES = 10_000_000  # beside the arrays of a data set, that a disk must have
INFO = Path("meta") / "info.json"

# features that are read begin so; pictures are left out
SENSED, COMMANDED = (
    "observation.",
    "action",
)


def require_minari() -> None:
    """Raise ImportError that says how to get what datasets need, where it is missing."""
    for package in ("h5py", "minari"):
        require(package, what="a dataset")


@typed
def write_dataset(
    root: Path,
    dataset_id: str,
    episodes: Sequence[Episode],
    env: gym.Env[Any, Any],
    details: dict[str, Any],
) -> Path:
    """Write episodes of one spec as a Minari dataset to ``root/<dataset_id>``, in place of the one that is there.

    They hold an action, a reward and a flat observation of every step in ``env``. ``details`` are kept as JSON in the
    metadata. Raises ValueError where episodes are missing, incomplete or of several specs, or the name leads elsewhere
    or to foreign files; OSError where the disk has no room.
    """
    require_minari()
    import minari
    from minari.dataset.minari_storage import MinariStorage

    if not episodes:
        raise ValueError("a dataset needs at least one episode, got none")
    spec = episodes[0].spec
    for n, episode in enumerate(episodes):
        spec.require(episode.spec, f"episode {n}")
        steps = len(episode.actions)
        if not steps or len(episode.observations) != steps + 1 or len(episode.rewards) != steps:
            raise ValueError(
                f"episode {n} needs an action, a reward and a flat observation of every step"
            )
        check_recorded(episode)
    folder = _folder(root, dataset_id)
    unfinished, replaced = (
        folder.with_name(f".{folder.name}.{what}") for what in ("unfinished", "replaced")
    )
    for before in (folder, unfinished, replaced):
        _refuse_foreign(before)
    for before in (unfinished, replaced):
        shutil.rmtree(before, ignore_errors=True)
    data = unfinished / "data"
    data.mkdir(parents=True)
    size = sum(
        array.nbytes
        for e in episodes
        for array in (e.observations, e.actions, e.rewards, e.stream, e.faults)
    )
    if (
        shutil.disk_usage(data).free < size + SPARE_BYTES
    ):  # HDF5 may end the process where a disk is full
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(data / ARRAYS))
    spaces = {
        "observation_space": flatten_space(env.observation_space),
        "action_space": env.action_space,
    }
    storage = MinariStorage.new(data, **spaces, env_spec=env.spec)
    storage.update_episodes([_buffer(n, episode) for n, episode in enumerate(episodes)])
    storage.update_episode_metadata(
        {"success": bool(e.success), "info": json.dumps(e.info)} for e in episodes
    )
    about = {
        "stream_spec": spec.to_json(),
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
    }
    storage.update_metadata(details | about)
    if folder.exists():
        folder.rename(replaced)
    unfinished.rename(folder)
    shutil.rmtree(replaced, ignore_errors=True)
    return folder


def _folder(root: Path, dataset_id: str) -> Path:
    """The folder of a dataset, which lies below ``root``."""
    if not all(
        re.fullmatch(r"\w[\w.-]*", part) for part in check_text("dataset_id", dataset_id).split("/")
    ):
        raise ValueError(f"dataset_id must be a name such as asm_gym/lift-v0, got {dataset_id!r}")
    folder = root.resolve() / dataset_id  # Minari doubles a relative path
    if folder.resolve() != folder:
        raise ValueError(f"{folder} is a link to {folder.resolve()}, and is not replaced")
    return folder


def _refuse_foreign(folder: Path) -> None:
    """Raise ValueError where a folder that is to be replaced holds what ``write_dataset`` does not write."""
    found = (
        {f for f in folder.rglob("*") if f.is_symlink() or not f.is_dir()}
        if folder.is_dir()
        else {folder}
    )
    foreign = found - {folder / "data" / name for name in OWN_FILES}
    if folder.exists() and foreign:
        raise ValueError(f"asm-gym did not write {min(foreign)}, so {folder} is not replaced")


def _buffer(n: int, episode: Episode) -> Any:
    """Return an episode as Minari collects it."""
    from minari.data_collector import EpisodeBuffer

    last = np.arange(len(episode.rewards)) == len(episode.rewards) - 1
    terminated = bool(episode.info.get("terminated", False))
    return EpisodeBuffer(
        id=n,
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=last & terminated,
        truncations=last & (not terminated),
        infos={"stream": episode.stream, "fault": episode.faults},
    )


@typed
def read_dataset(path: str | Path, env_id: str | None = None) -> list[Episode]:
    """Return the episodes of the only Minari dataset at or below ``path``, perhaps one that must be of ``env_id``.

    Without streams, observation and action are the stream. Raises FileNotFoundError where there is no dataset,
    ValueError where it is damaged, of another environment, or of one of ours without streams.
    """
    folder = _find_dataset(Path(path))
    require_minari()
    import minari

    try:
        if (folder / ARRAYS).exists():
            check_hdf5(folder / ARRAYS)
        metadata = json.loads((folder / METADATA).read_text(encoding="utf-8"))
        dataset = minari.MinariDataset(folder)
        recorded = list(dataset.iterate_episodes())
        notes = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        spaces = dataset.observation_space, dataset.action_space
    except (OSError, KeyError, ValueError, AssertionError, RuntimeError, AttributeError) as error:
        raise ValueError(f"{folder} is damaged or not a Minari dataset: {error}") from error
    found = dataset.env_spec.id if dataset.env_spec is not None else None
    if env_id is not None and found != env_id:
        raise ValueError(f"{folder} was recorded in {found}, not in {env_id!r}")
    spec = _spec(folder, metadata, dataset, found)
    if not recorded:
        raise ValueError(f"{folder} holds no episode")
    return [
        _episode(folder, data, note, spec, spaces)
        for data, note in zip(recorded, notes, strict=True)
    ]


def _find_dataset(path: Path) -> Path:
    """Return the folder of the only dataset at or below a path. Raises FileNotFoundError or ValueError."""
    if (path / METADATA).is_file():
        return path
    found = [f for f in sorted(path.rglob(METADATA)) if f.parent.name == "data"]
    # left by a kill
    below = [
        f.parent for f in found if not any(p.startswith(".") for p in f.relative_to(path).parts)
    ]
    if not below:
        raise FileNotFoundError(f"no Minari dataset at or below {path}")
    if len(below) > 1:
        raise ValueError(f"{path} holds several datasets, name one: {', '.join(map(str, below))}")
    return below[0]


def _spec(folder: Path, metadata: dict[str, Any], dataset: Any, env_id: str | None) -> StreamSpec:
    if "stream_spec" in metadata:
        try:
            return StreamSpec.from_json(metadata["stream_spec"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{folder} names its channels in a way that cannot be read: {error}"
            ) from error
    if env_id in {task.id for task in TASKS.values()}:
        raise ValueError(
            f"{folder} was recorded in {env_id} and holds no streams: record it with `asm-gym collect`"
        )
    dt = 1.0
    if env_id in gym.registry:  # how the file itself says to make it is not followed
        with suppress(gym.error.Error, ImportError), closing(gym.make(env_id)) as env:
            dt = control_period(env)
    return StreamSpec.from_spaces(dataset.observation_space, dataset.action_space, dt)


def _episode(
    folder: Path, data: Any, note: dict[str, Any], spec: StreamSpec, spaces: tuple[Any, Any]
) -> Episode:
    T = len(data.rewards)
    infos = data.infos or {}
    seed = note.get("seed")
    try:
        for name, length in {
            "actions": T,
            "observations": T + 1,
            "terminations": T,
            "truncations": T,
        }.items():
            if found := {len(part) for part in _leaves(getattr(data, name))} - {length}:
                raise ValueError(f"{T} rewards need {length} {name}, got {found.pop()}")
        observations = flat_rows(spaces[0], data.observations, T + 1)
        if spec.source == "spaces" and "stream" not in infos:
            stream = np.concatenate(
                [observations[1:], flat_rows(spaces[1], data.actions, T)], axis=1
            )
        else:
            stream = _without_reset(np.asarray(infos["stream"], np.float32), T)
        episode = Episode(
            stream=stream,
            spec=spec,
            success=bool(
                note["success"] if "success" in note else np.any(infos.get("success", False))
            ),
            seed=None if seed is None else int(seed),
            actions=np.asarray(data.actions, np.float32).reshape(T, -1),
            observations=observations,
            rewards=np.asarray(data.rewards, np.float32),
            faults=_without_reset(
                np.asarray(infos.get("fault", np.zeros(len(stream))), np.bool_), T
            ),
            info=json.loads(note.get("info", "{}"))
            | {"terminated": bool(np.any(data.terminations))},
        )
        check_recorded(episode)
        return episode
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder}, episode {data.id}: {error}") from error


def _leaves(values: Any) -> list[Any]:
    """The arrays of a dict, at any depth."""
    return (
        [leaf for value in values.values() for leaf in _leaves(value)]
        if isinstance(values, dict)
        else [values]
    )


def _without_reset(rows: NDArray[Any], T: int) -> NDArray[Any]:
    """Rows of T steps, perhaps several of each; others may keep the row of reset as well."""
    rows = rows[1:] if len(rows) == T + 1 else rows
    if not T or len(rows) % T:
        raise ValueError(f"{T} steps cannot have {len(rows)} rows of a stream")
    return rows


def read_lerobot(folder: Path) -> Iterator[tuple[Columns, float, bool]]:
    """Yield the columns of each episode, its rate [Hz], and whether it succeeded (by default it did)."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        version, rate, features = (
            info["codebase_version"],
            float(info["fps"]),
            dict(info["features"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / INFO} is no LeRobot dataset's: {error!r}") from error
    if not str(version).startswith(("v2", "v3")):
        raise ValueError(f"{folder} is of LeRobot's {version}, and v2 and v3 can be read")
    read = {
        name: _names(feature)
        for name, feature in features.items()
        if name.startswith((SENSED, COMMANDED))
        and str(feature.get("dtype", "")).startswith(("float", "int"))
    }
    if not any(name.startswith(SENSED) for name in read):
        raise ValueError(
            f"{folder} has no feature that is sensed, observation.… of numbers: {', '.join(features)}"
        )
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
            success = (
                bool(columns["next.success"][rows].any()) if "next.success" in columns else True
            )
            found = {name: as_array(columns[name][rows]) for name in read}
            made = {k: v for name in read for k, v in _split(name, found[name], read[name])}
            stamps = {"timestamp": columns["timestamp"][rows]} if "timestamp" in columns else {}
            # frames that were lost are known by the stamps alone
            yield (
                stamps | made,
                rate,
                success,
            )


def _names(feature: dict[str, Any]) -> list[str]:
    """Names of the numbers of a feature, in a list or in lists by what they name; empty where they have none."""
    names = feature.get("names") or []
    parts = names.values() if isinstance(names, dict) else names if isinstance(names, list) else []
    found = [str(name) for part in parts for name in np.ravel(part)]
    return found if len(set(found)) == len(found) else []


def _split(
    name: str, values: NDArray[Any], names: Sequence[str]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """A feature's columns, each by its name where there are names."""
    if values.ndim == 2 and len(names) == values.shape[1]:
        yield from ((f"{name}[{element}]", values[:, k]) for k, element in enumerate(names))
    else:
        yield name, values
