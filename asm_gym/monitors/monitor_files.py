"""Files of monitors: what a checkpoint of one holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import Checkpoint, write_checkpoint
from asm_gym.detection import Blocks
from asm_gym.detection.base import Arrays
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.exceptions import DamagedFile
from asm_gym.monitors.weight_packing import packed, unpacked
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_number

BLOCKS = "nominal_blocks"
MAXIMA = "nominal_maxima"
PACE_PREFIX = "pace "  # begins the name of the array of a task

OPTIONAL = {
    "learned_from_": "learned_from",
    "ceilings_from_": "ceilings_from",
    "motion_": "motion",
    "commands_": "commands",
    "ranges_": "ranges",
    "readings_": "readings",
    "wear_": "wear",
}
"""The array of a checkpoint that keeps each attribute that may be None."""


class SavedMonitor(NamedTuple):
    """What a checkpoint holds of a monitor."""

    learned: Arrays  # by name
    attributes: dict[str, Any]  # by name


def read_monitor(saved: Checkpoint) -> SavedMonitor:
    """Return what a checkpoint holds.

    Raises:
        KeyError, ValueError: something is missing, not declared, or out of range.
    """
    header = saved.header
    shapes = header["shapes"]
    saved = saved._replace(arrays=dict(unpacked(saved.arrays)))
    undeclared = sorted(saved.arrays.keys() - shapes.keys())
    if undeclared:
        raise ValueError(
            f"its header declares no {', '.join(undeclared)}: it is damaged or was written by an "
            "older version: make it anew with asm-gym fit or asm-gym babble"
        )
    arrays = {name: saved.array(name, *shape) for name, shape in shapes.items()}

    check_choice("promise", header["promised"], (EPISODE, HOUR))
    healthy = [check_number("healthy", value, low=0.0) for value in header["healthy"]]
    attributes: dict[str, Any] = {
        "promised_": header["promised"],
        "maxima_": arrays.pop(MAXIMA, None),
        "blocks_": None,
        "about": dict(header["about"]),
        "healthy_": tuple(healthy),
    }
    if BLOCKS in arrays:
        attributes["blocks_"] = Blocks.restored(arrays.pop(BLOCKS))
    tasks = [name for name in arrays if name.startswith(PACE_PREFIX)]
    attributes["pace_"] = {name.removeprefix(PACE_PREFIX): arrays.pop(name) for name in tasks}
    for attribute, name in OPTIONAL.items():
        attributes[attribute] = arrays.pop(name, None)
    return SavedMonitor(arrays, attributes)


def threshold_below(threshold: object, reach: float) -> float | None:
    """Return a saved threshold. Raises ValueError where surprise, which never comes to ``reach``, cannot exceed it."""
    if threshold is None:
        return None
    number = check_number("threshold", threshold, low=0.0)
    if number >= reach:
        raise ValueError(
            f"threshold must be below {reach:g}, the largest possible surprise, got {number:g}"
        )
    return number


def write_monitor(path: str | Path, monitor: Any) -> None:
    """Write a checkpoint of a fitted ``CalibratedMonitor``."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, array in monitor.learned_.items():
        arrays[name] = array
        if array.dtype.kind != "f":
            arrays[name] = np.asarray(array, np.float64)
    if monitor.maxima_ is not None:
        arrays[MAXIMA] = monitor.maxima_
    if monitor.blocks_ is not None:
        arrays[BLOCKS] = monitor.blocks_.array
    for attribute, name in OPTIONAL.items():
        if getattr(monitor, attribute) is not None:
            arrays[name] = getattr(monitor, attribute)
    for task, cells in monitor.pace_.items():
        arrays[PACE_PREFIX + task] = cells

    header = {
        "spec": monitor.spec.to_json(),
        "hyperparameters": monitor.get_params(),
        "detection": monitor.detection.name,
        "threshold": monitor.threshold_,
        "promised": monitor.promised_,
        "skills": list(monitor.skills_),
        "about": monitor.about,
        "healthy": list(monitor.healthy_),
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }
    write_checkpoint(path, monitor.model.kind, header, packed(arrays))


def restored(path: str | Path, saved: Checkpoint, make: Callable[..., Any]) -> Any:
    """Return a checkpoint's monitor, which ``make(spec, **hyperparameters)`` makes. Raises DamagedFile."""
    try:
        spec = StreamSpec.from_json(saved.header["spec"])
        monitor = make(spec, **saved.header["hyperparameters"])
    except (KeyError, TypeError, ValueError) as error:
        raise _foreign(path, error) from error
    try:
        return monitor.restore(saved)
    except (KeyError, TypeError) as error:
        raise _foreign(path, error) from error


def _foreign(path: str | Path, error: Exception) -> DamagedFile:
    problem = f"{error}, or it was written by an older version: make it anew with asm-gym fit"
    return DamagedFile(path, problem)
