"""Public recordings of real robots with faults, as episodes with their official splits: voraus-AD and AURSAD.

    voraus-AD  Parquet; 130 signals of a six-axis arm at 100 or 500 Hz; twelve kinds of anomaly. Learned from: setting
               72; tested on: all others. Brockmann et al. 2023, arXiv 2311.04765, and github.com/vorausrobotik
    AURSAD     HDF5 of pandas; 125 signals of a UR3e and its screwdriver at 100 Hz; three kinds. Learned from: what is
               normal among 70 %, drawn by class; tested on: the rest. Leporowski et al. 2021, arXiv 2102.01409, and the
               package aursad 0.2.4

Neither is shipped: voraus-AD is CC BY-NC-SA, AURSAD CC BY. These readers follow what the authors' own code reads. They
have been run on synthetic files of that schema only, never on the files themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.hdf5 import opened_hdf5
from asm_gym.data.tabular import check_declared
from asm_gym.data.timing import period
from asm_gym.episode import Episode
from asm_gym.extras import require
from asm_gym.files import regular_file
from asm_gym.spec import StreamSpec

Columns = dict[str, NDArray[Any]]

AT_ONCE = 50_000
"""Rows held at a time."""

COMMANDED = ("target_*",)
"""What controllers of both robots were told."""


class Recorded(NamedTuple):
    """An episode of a public dataset.

    Attributes:
        learned: it belongs to what is learned from, by the official split.
        kind: of anomaly; empty where it is normal.
        episode: its stream.
    """

    learned: bool
    kind: str
    episode: Episode


VORAUS_KINDS = (
    *("axis friction", "axis weight", "collision foam", "collision cable", "collision carton", "miss can"),
    *("lose can", "can weight", "entangled", "invalid position", "motor commutation", "wobbling station", ""),
)
"""By the number in the column ``category``; the last is normal operation."""

VORAUS_META = ("time", "sample", "anomaly", "category", "setting", "action", "active")
"""Columns that are no signals: what a row is part of, and what is wrong with it."""

VORAUS_LEARNED = 72
"""The setting of normal episodes that were recorded before all others."""

VORAUS_RATES = (100.0, 500.0)
"""[Hz] of the two files."""


def read_voraus(path: Path, rate: float | None = None, every: int = 1) -> Iterator[Recorded]:
    """The episodes of a voraus-AD file, in its order.

    Args:
        rate: rows a second [Hz]; by default what the column ``time`` says, where it is that of one of the two files.
        every: keeps one row of so many.

    Raises:
        ValueError: it is damaged or something else, or its rate is unknown.
        ImportError: pyarrow is not installed.
    """
    arrow, parquet = (require(name, what="a Parquet file") for name in ("pyarrow", "pyarrow.parquet"))
    size = regular_file(path)
    try:
        with parquet.ParquetFile(path) as file:
            about = file.metadata
            check_declared(path, sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups)), size)
            _require(VORAUS_META, file.schema_arrow.names, path)
            batches = ({n: np.asarray(b[n]) for n in b.schema.names} for b in file.iter_batches(AT_ONCE))
            spec = None
            for rows in _one_by_one(batches, "sample", path):
                category, setting = _constant(rows, "category", path), _constant(rows, "setting", path)
                if not 0 <= category < len(VORAUS_KINDS):
                    raise ValueError(f"{path}: category must be 0 to {len(VORAUS_KINDS) - 1}, got {category}")
                rate = rate or _rate_of(rows["time"], path)
                signals = {name: values[::every] for name, values in rows.items() if name not in VORAUS_META}
                episode = _episode(signals, spec, rate / every)
                spec = episode.spec
                yield Recorded(setting == VORAUS_LEARNED, VORAUS_KINDS[category], episode)
    except (OSError, arrow.ArrowException) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _rate_of(times: NDArray[Any], path: Path) -> float:
    """One of the two rates, by a column of seconds. Raises ValueError where it says something else."""
    step = period(times) if times.dtype.kind == "f" else None
    for rate in VORAUS_RATES:
        if step is not None and abs(step * rate - 1) < 0.05:
            return rate
    raise ValueError(f"{path}: how many rows come a second? Its time does not say 100 or 500: give --rate")


AURSAD_KINDS = ("", "damaged screw", "extra assembly component", "missing screw")
"""By the number in the column ``label``. Left out: 4, damaged threads, of which there are three, and 5, loosening."""

AURSAD_THREAD = 4

AURSAD_META = (
    *("sample_nr", "label", "timestamp", "output_int_register_25", "output_int_register_26"),
    *(f"output_bit_register_{n}" for n in (64, 65, 66, 67)),
)
"""Columns that are no signals. The registers say which hole and which run it is, and so what the label is."""

AURSAD_RATE = 100.0


def read_aursad(path: Path, rate: float | None = None, every: int = 1) -> Iterator[Recorded]:
    """The episodes of AURSAD, in the order of the file; those of kinds that are left out are not among them.

    Args:
        rate: rows a second [Hz]; by default 100.
        every: keeps one row of so many.

    Raises:
        ValueError: it is damaged or something else.
        ImportError: h5py or scikit-learn are not installed.
    """
    try:
        with opened_hdf5(path) as file:
            frames = [node for node in file.values() if "axis0" in node]
            if len(frames) != 1:
                raise ValueError(f"{path} must hold one frame of pandas, got {len(frames)}")
            places = _places(frames[0], path)
            _require(AURSAD_META, list(places), path)
            rows = len(frames[0][places["label"][0]])
            names = sorted(set(places) - set(AURSAD_META))
            learned = _learned(frames[0], places, rows, path)
            spec, wanted = None, (*names, "label", "sample_nr")
            batches = (_slice(frames[0], places, wanted, k, k + AT_ONCE) for k in range(0, rows, AT_ONCE))
            for sample in _one_by_one(batches, "sample_nr", path):
                label = _constant(sample, "label", path)
                if label < len(AURSAD_KINDS):
                    signals = {name: sample[name][::every] for name in names}
                    episode = _episode(signals, spec, (rate or AURSAD_RATE) / every)
                    spec = episode.spec
                    # Of what was to be learned, only what is normal is; the rest of it goes unused, as in the split.
                    mine = int(sample["sample_nr"][0]) in learned
                    if not (mine and label):
                        yield Recorded(mine, AURSAD_KINDS[label], episode)
    except (OSError, KeyError, RuntimeError) as error:  # whichever h5py meets the damage with
        raise ValueError(f"{path} is damaged: {error}") from error


def _places(frame: Any, path: Path) -> dict[str, tuple[str, int]]:
    """Block and column of every number, as pandas lays out a frame of the format "fixed"; objects are left out."""
    places: dict[str, tuple[str, int]] = {}
    for items in (name for name in frame if name.startswith("block") and name.endswith("_items")):
        values = items.replace("_items", "_values")
        if values not in frame or frame[values].ndim != 2 or frame[values].dtype.kind not in "biuf":
            continue
        named = [n.decode() if isinstance(n, bytes) else str(n) for n in frame[items][:]]
        if len(named) != frame[values].shape[1]:
            raise ValueError(f"{path}: {items} names {len(named)} of {frame[values].shape[1]} columns")
        places |= {name: (values, k) for k, name in enumerate(named)}
    return places


def _slice(frame: Any, places: dict[str, tuple[str, int]], names: Iterable[str], start: int, stop: int) -> Columns:
    names = list(names)
    blocks = {block: frame[block][start:stop] for block in {places[name][0] for name in names}}
    return {name: blocks[places[name][0]][:, places[name][1]] for name in names}


def _learned(frame: Any, places: dict[str, tuple[str, int]], rows: int, path: Path) -> set[int]:
    """Numbers of the samples that are to be learned from, drawn as the dataset's own package does."""
    selection = require("sklearn.model_selection", what="the split of AURSAD")
    parts = [_slice(frame, places, ("sample_nr", "label"), k, k + AT_ONCE) for k in range(0, rows, AT_ONCE)]
    numbers, first = np.unique(np.concatenate([p["sample_nr"] for p in parts]), return_index=True)
    labels = np.concatenate([p["label"] for p in parts])[first]
    kept = labels != AURSAD_THREAD
    try:
        drawn, _ = selection.train_test_split(numbers[kept], train_size=0.7, random_state=42, stratify=labels[kept])
    except ValueError as error:
        raise ValueError(f"{path} has too few samples to split: {error}") from error
    return set(drawn.astype(int).tolist())


READERS: dict[str, Callable[[Path, float | None, int], Iterator[Recorded]]] = {
    ".parquet": read_voraus,
    ".h5": read_aursad,
}
"""By the suffix of a file."""


def read_public(path: str | Path, rate: float | None = None, every: int = 1) -> Iterator[Recorded]:
    """The episodes of voraus-AD (``.parquet``) or of AURSAD (``.h5``), one after another.

    Raises:
        ValueError: it is neither, or damaged.
    """
    path = Path(path)
    if path.suffix not in READERS:
        raise ValueError(f"{path}: known are voraus-AD, which ends in .parquet, and AURSAD, which ends in .h5")
    return READERS[path.suffix](path, rate, every)


def _require(wanted: Iterable[str], there: Iterable[str], path: Path) -> None:
    missing = sorted(set(wanted) - set(there))
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}")


def _one_by_one(batches: Iterable[Columns], by: str, path: Path) -> Iterator[Columns]:
    """The rows of each sample, which stand together. Raises ValueError where they do not."""
    held: list[Columns] = []
    done: set[int] = set()
    for batch in batches:
        ids = batch[by]
        for start, stop in pairwise([0, *(np.flatnonzero(np.diff(ids)) + 1), len(ids)]):
            number = int(ids[start])
            if held and number != int(held[0][by][0]):
                done.add(int(held[0][by][0]))
                yield _joined(held)
                held = []
            if number in done:
                raise ValueError(f"{path}: the rows of sample {number} stand in two places")
            held.append({name: values[start:stop] for name, values in batch.items()})
    if not held:
        raise ValueError(f"{path} holds no rows")
    yield _joined(held)


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _constant(rows: Columns, name: str, path: Path) -> int:
    """What a column says of a whole sample. Raises ValueError where it says several things."""
    said = np.unique(rows[name])
    if len(said) != 1:
        raise ValueError(f"{path}: a sample is of one {name}, got {', '.join(map(str, said[:4]))}")
    return int(said[0])


def _episode(signals: Columns, spec: StreamSpec | None, rate: float) -> Episode:
    """As the first one was read."""
    return Episode.from_table(signals, spec, rate, () if spec else COMMANDED, success=True)
