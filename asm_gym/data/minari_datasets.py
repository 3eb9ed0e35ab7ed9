"""Write episodes as Minari datasets, and read those of others.

They hold T + 1 observations and T actions, rewards, terminations and truncations of each episode; ours hold the
sensorimotor stream, (T, D), in ``infos`` as well, and name its channels in the metadata.

Source: Younis et al. 2024, https://minari.farama.org.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces.utils import flatten_space
from numpy.typing import NDArray

from asm_gym.control_period import control_period
from asm_gym.data.array_files import check_hdf5
from asm_gym.data.episode import Episode, check_lengths
from asm_gym.exceptions import DamagedFile
from asm_gym.extras import require
from asm_gym.spec import StreamSpec, flat_rows
from asm_gym.tasks import TASKS
from asm_gym.validation import check_text, typed

# Files of a dataset's folder ``data``.
METADATA_FILE = "metadata.json"
ARRAYS_FILE = "main_data.hdf5"
# Those that this package writes, or wrote in an earlier version.
OWN_FILES = (METADATA_FILE, ARRAYS_FILE, "SHA256SUMS")
SPARE_BYTES = 10_000_000  # beside the arrays of a dataset, that a disk must have


def require_minari() -> None:
    """Raise ImportError that says how to get what datasets need, where it is missing."""
    require("h5py", what="a dataset")
    require("minari", what="a dataset")


@typed
def write_dataset(
    root: Path,
    dataset_id: str,
    episodes: Sequence[Episode],
    env: gym.Env[Any, Any],
    details: dict[str, Any],
) -> Path:
    """Write episodes of one spec as a Minari dataset, in place of the one that is there.

    Args:
        root: the folder of datasets.
        dataset_id: the name of the dataset, such as ``asm_gym/lift-v0``, and its folder below ``root``.
        episodes: with an action, a reward and a flat observation of every step in ``env``.
        env: whose spaces and spec the dataset names.
        details: kept as JSON in the metadata.

    Returns:
        The folder of the dataset.

    Raises:
        ValueError: episodes are missing, incomplete or of several specs, or the name leads elsewhere or to foreign
            files.
        OSError: the disk has no room.
    """
    require_minari()
    _check_complete(episodes)
    folder = _folder(root, dataset_id)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    replaced = folder.with_name(f".{folder.name}.replaced")
    for path in (folder, unfinished, replaced):
        _refuse_foreign(path)
    shutil.rmtree(unfinished, ignore_errors=True)
    shutil.rmtree(replaced, ignore_errors=True)

    data = unfinished / "data"
    data.mkdir(parents=True)
    _check_room(data, episodes)
    _write(data, episodes, env, details | {"dataset_id": dataset_id})

    if folder.exists():
        folder.rename(replaced)
    unfinished.rename(folder)
    shutil.rmtree(replaced, ignore_errors=True)
    return folder


def _check_complete(episodes: Sequence[Episode]) -> None:
    """Raise ValueError unless there are episodes, of one spec, with all that a dataset holds of each step."""
    if not episodes:
        raise ValueError("a dataset needs at least one episode, got none")
    for n, episode in enumerate(episodes):
        episodes[0].spec.require(episode.spec, f"episode {n}")
        if 0 in (len(episode.actions), len(episode.observations), len(episode.rewards)):
            raise ValueError(
                f"episode {n} needs an action, a reward and a flat observation of every step"
            )
        check_lengths(episode)


def _folder(root: Path, dataset_id: str) -> Path:
    """The folder of a dataset, which lies below ``root``."""
    name = check_text("dataset_id", dataset_id)
    if not re.fullmatch(r"\w[\w.-]*(/\w[\w.-]*)*", name):
        raise ValueError(f"dataset_id must be a name such as asm_gym/lift-v0, got {name!r}")
    folder = root.resolve() / name  # Minari doubles a relative path
    if folder.resolve() != folder:
        raise ValueError(f"{folder} is a link to {folder.resolve()}, and is not replaced")
    return folder


def _refuse_foreign(folder: Path) -> None:
    """Raise ValueError where a folder that is to be replaced holds what ``write_dataset`` does not write."""
    if not folder.exists():
        return
    own = [folder / "data" / name for name in OWN_FILES]
    for path in [folder, *folder.rglob("*")]:
        if path not in own and (path.is_symlink() or not path.is_dir()):
            raise ValueError(f"asm-gym did not write {path}, so {folder} is not replaced")


def _check_room(data: Path, episodes: Sequence[Episode]) -> None:
    """Raise OSError where the disk is too small: HDF5 may end the process where it becomes full."""
    size = SPARE_BYTES
    for episode in episodes:
        for value in vars(episode).values():
            size += getattr(value, "nbytes", 0)
    if shutil.disk_usage(data).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(data / ARRAYS_FILE))


def _write(
    data: Path, episodes: Sequence[Episode], env: gym.Env[Any, Any], details: dict[str, Any]
) -> None:
    import minari
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(
        data,
        observation_space=flatten_space(env.observation_space),
        action_space=env.action_space,
        env_spec=env.spec,
    )
    storage.update_episodes(_buffer(n, episode) for n, episode in enumerate(episodes))
    storage.update_episode_metadata(
        {"success": bool(e.success), "info": json.dumps(e.info)} for e in episodes
    )
    storage.update_metadata(
        {
            **details,
            "stream_spec": episodes[0].spec.to_json(),
            "minari_version": minari.__version__,
        }
    )


def _buffer(n: int, episode: Episode) -> Any:
    """Return an episode as Minari collects it."""
    from minari.data_collector import EpisodeBuffer

    steps = len(episode.rewards)
    is_last = np.arange(steps) == steps - 1
    terminated = bool(episode.info.get("terminated", False))
    return EpisodeBuffer(
        id=n,
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=is_last & terminated,
        truncations=is_last & (not terminated),
        infos={"stream": episode.stream, "fault": episode.faults},
    )


@typed
def read_dataset(path: str | Path, env_id: str | None = None) -> list[Episode]:
    """Return the episodes of the only Minari dataset at or below ``path``.

    Without streams, observation and action are the stream.

    Args:
        path: the dataset, or a folder with it at any depth.
        env_id: the environment that it must be of; by default any.

    Raises:
        FileNotFoundError: there is no dataset.
        ValueError: it is damaged, of another environment, or one of ours without streams.
    """
    folder = _find_dataset(Path(path))
    require_minari()
    import minari

    spec = None
    try:
        if (folder / ARRAYS_FILE).exists():
            check_hdf5(folder / ARRAYS_FILE)
        metadata = json.loads((folder / METADATA_FILE).read_text(encoding="utf-8"))
        if "stream_spec" in metadata:
            spec = StreamSpec.from_json(metadata["stream_spec"])
        dataset = minari.MinariDataset(folder)
        recorded = list(dataset.iterate_episodes())
        notes = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    except (OSError, KeyError, ValueError, AssertionError, RuntimeError, AttributeError) as error:
        raise DamagedFile(folder, error, "is damaged or not a Minari dataset") from error
    recorded_in = getattr(dataset.env_spec, "id", None)
    if env_id is not None and recorded_in != env_id:
        raise ValueError(f"{folder} was recorded in {recorded_in}, not in {env_id!r}")
    if not recorded:
        raise ValueError(f"{folder} holds no episode")
    if spec is None:
        spec = _spec_of_spaces(folder, dataset, recorded_in)
    episodes = []
    for data, note in zip(recorded, notes, strict=True):
        try:
            episodes.append(_episode(data, note, spec, dataset))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{folder}, episode {data.id}: {error}") from error
    return episodes


def _find_dataset(path: Path) -> Path:
    """Return the folder of the only dataset at or below a path. Raises FileNotFoundError or ValueError."""
    if (path / METADATA_FILE).is_file():
        return path
    folders = []
    for file in sorted(path.rglob(f"data/{METADATA_FILE}")):
        names = file.relative_to(path).parts
        # A kill leaves hidden folders.
        if not any(name.startswith(".") for name in names):
            folders.append(file.parent)
    if not folders:
        raise FileNotFoundError(f"no Minari dataset at or below {path}")
    if len(folders) > 1:
        several = ", ".join(map(str, folders))
        raise ValueError(f"{path} holds several datasets, name one: {several}")
    return folders[0]


def _spec_of_spaces(folder: Path, dataset: Any, env_id: str | None) -> StreamSpec:
    """The channels of an observation and an action of an environment that is not ours."""
    if any(task.id == env_id for task in TASKS.values()):
        raise ValueError(
            f"{folder} was recorded in {env_id} and holds no streams: "
            "record it with `asm-gym collect`"
        )
    dt = 1.0
    # It is made as it is registered here, and not as the file says to make it.
    if env_id in gym.registry:
        with suppress(gym.error.Error, ImportError), closing(gym.make(env_id)) as env:
            dt = control_period(env)
    return StreamSpec.from_spaces(dataset.observation_space, dataset.action_space, dt)


def _episode(data: Any, note: dict[str, Any], spec: StreamSpec, dataset: Any) -> Episode:
    """An episode as Minari reads it, and its metadata. Raises KeyError, TypeError or ValueError."""
    steps = len(data.rewards)
    lengths = {
        "actions": steps,
        "observations": steps + 1,
        "terminations": steps,
        "truncations": steps,
    }
    for name, length in lengths.items():
        values = getattr(data, name)
        # The arrays of a dict are checked where they become rows.
        if not isinstance(values, dict) and len(values) != length:
            raise ValueError(f"{steps} rewards need {length} {name}, got {len(values)}")
    infos = data.infos or {}
    observations = flat_rows(dataset.observation_space, data.observations, steps + 1)
    if spec.source == "spaces" and "stream" not in infos:
        actions = flat_rows(dataset.action_space, data.actions, steps)
        stream = np.hstack([observations[1:], actions])
    else:
        stream = _without_reset(np.asarray(infos["stream"], np.float32), steps)
    faults = np.asarray(infos.get("fault", np.zeros(len(stream))), np.bool_)
    info = json.loads(note.get("info", "{}"))
    info["terminated"] = bool(np.any(data.terminations))
    episode = Episode(
        stream=stream,
        spec=spec,
        success=bool(note.get("success", np.any(infos.get("success", False)))),
        seed=note.get("seed"),
        actions=np.asarray(data.actions, np.float32).reshape(steps, -1),
        observations=observations,
        rewards=np.asarray(data.rewards, np.float32),
        faults=_without_reset(faults, steps),
        info=info,
    )
    check_lengths(episode)
    return episode


def _without_reset(rows: NDArray[Any], steps: int) -> NDArray[Any]:
    """Rows of a stream, perhaps several of each step; others may keep the row of reset as well."""
    if len(rows) == steps + 1:
        rows = rows[1:]
    if not steps or len(rows) % steps:
        raise ValueError(f"{steps} steps cannot have {len(rows)} rows of a stream")
    return rows
