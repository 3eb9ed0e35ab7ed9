"""Read LeRobot's datasets, without LeRobot.

    meta/info.json       version, rate (fps), and the features: dtype, shape, names
    data/**/*.parquet    a row a frame; version 2 has a file for each episode, version 3 many episodes in one

Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.array_files import read_parquet
from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import Columns, as_array

INFO_FILE = Path("meta") / "info.json"

# Features that are read begin so; pictures are left out.
SENSED_PREFIX = "observation."
COMMANDED_PREFIX = "action"


def read_lerobot(folder: Path) -> Iterator[tuple[Columns, float, bool]]:
    """Yield the columns of each episode, its rate [Hz], and whether it succeeded (by default it did)."""
    import pandas as pd

    rate, features = _features(folder)
    data = folder / "data"
    files = sorted(data.rglob("*.parquet"))
    if not files:
        raise ValueError(f"{folder} holds no data/**/*.parquet")
    for file in files:
        frames = pd.DataFrame(read_parquet(file))
        missing = {*features, "episode_index"}.difference(frames)
        if missing:
            names = ", ".join(sorted(missing))
            raise ValueError(
                f"{file} lacks {names}, which {INFO_FILE} declares",
            )
        for _, episode in frames.groupby("episode_index", sort=False):
            columns: Columns = {}
            # Frames that were lost are known by the stamps alone.
            if "timestamp" in frames:
                columns["timestamp"] = episode["timestamp"].to_numpy()
            for name, elements in features.items():
                values = as_array(episode[name])
                columns |= _columns(name, values, elements)
            success = True
            if "next.success" in frames:
                success = bool(episode["next.success"].any())
            yield columns, rate, success


def _features(folder: Path) -> tuple[float, dict[str, list[str]]]:
    """The rate [Hz], and the names of the numbers of each feature that is read, from the description of a dataset."""
    path = folder / INFO_FILE
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
        rate = float(info["fps"])
        features = dict(info["features"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no LeRobot dataset's: {error!r}") from error
    if not version.startswith(("v2", "v3")):
        raise ValueError(
            f"{folder} is of LeRobot's {version}, and v2 and v3 can be read",
        )
    read = {}
    for name, feature in features.items():
        dtype = str(feature.get("dtype"))
        is_number = dtype.startswith(("float", "int"))
        if is_number and name.startswith((SENSED_PREFIX, COMMANDED_PREFIX)):
            read[name] = _element_names(feature.get("names"))
    if not any(name.startswith(SENSED_PREFIX) for name in read):
        known = ", ".join(features)
        raise ValueError(
            f"{folder} has no feature that is sensed, observation.… of numbers: {known}",
        )
    return rate, read


def _element_names(names: Any) -> list[str]:
    """Names of the numbers of a feature, in a list or in lists by what they name; empty where they have none."""
    if isinstance(names, dict):
        names = list(names.values())
    if not isinstance(names, list) or not names:
        return []
    return np.hstack(names).astype(str).tolist()


def _columns(name: str, values: Any, elements: list[str]) -> Columns:
    """Return the columns of a feature (T,) or (T, k), each by its name; without names, the feature as it is.

    Names that are too few or too many are not read, as nothing tells which number has none; one that comes again is
    numbered. A note says so.
    """
    if values.ndim < 2 or not elements:
        return {name: values}
    count = values.shape[1]
    if len(elements) != count:
        note(
            f"{name} has {len(elements)} names for {count} numbers in {INFO_FILE}: its numbers are "
            f"called {name}[0] to {name}[{count - 1}]"
        )
        return {name: values}
    names = _different(name, elements)
    return {f"{name}[{element}]": values[:, k] for k, element in enumerate(names)}


def _different(feature: str, names: list[str]) -> list[str]:
    """Return names of the numbers of a feature, those that come again with a number behind them."""
    different: list[str] = []
    for name in names:
        own = name
        number = 1
        while own in different or (number > 1 and own in names):
            number += 1
            own = f"{name}_{number}"
        if own != name:
            note(f"{feature} calls several of its numbers {name!r}: one of them is read as {own!r}")
        different.append(own)
    return different
