"""Files of monitors: what a checkpoint of one holds, and weights of 8 bits with a scale a row.

    W_ij = s_i k_ij,   k_ij in -127 … 127,   s_i no less than max_j |W_ij| / 127, of 10 bits, so that products are exact

A synapse that exists keeps a k of at least 1. ``packed`` loses nothing of arrays that ``rounded`` made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import Checkpoint, write_checkpoint
from asm_gym.detection import Blocks
from asm_gym.detection.base import Arrays
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.exceptions import DamagedFile
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_number

MAXIMA, BLOCKS, LEARNED_FROM, CEILINGS_FROM = (
    "nominal_maxima",
    "nominal_blocks",
    "learned_from",
    "ceilings_from",
)
PACE, MOTION, COMMANDS = "pace", "motion", "commands"
"""Names of the arrays that ``calibrate`` and ``fit`` keep in a checkpoint."""
BITS, SCALE, ROOT = ".bits", ".scale", ".root"
"""Ends of the names of packed arrays; shipped memories also hold covariances C = s² K Kᵀ, by a root K of 16 bits."""
WEIGHTS = "V", "U", "W_S", "W_C", "W_D", "W_F"  # of association and of the traces' network
LARGEST = 127
SCALE_BITS = 10


def saved_parts(saved: Checkpoint) -> tuple[Arrays, dict[str, Any], dict[str, Any]]:
    """Return the learned arrays of a checkpoint, by name, and two sets of attributes of its monitor.

    The first holds under any detection, the second under the one that the monitor was calibrated with.

    Raises:
        KeyError, ValueError: something is missing, not declared, or out of range.
    """
    header, saved = saved.header, saved._replace(arrays=dict(unpacked(saved.arrays)))
    undeclared = sorted(set(saved.arrays) - set(header["shapes"]))
    if any(".planes" in name for name in undeclared):  # as arrays were packed before
        raise ValueError(
            "the file was written by an older version: make it anew with asm-gym fit or asm-gym babble"
        )
    if undeclared:
        raise DamagedFile("the checkpoint", f"its header declares no {', '.join(undeclared)}")
    arrays = {name: saved.array(name, *shape) for name, shape in header["shapes"].items()}
    blocks, promised = arrays.pop(BLOCKS, None), header.get("promised", EPISODE)
    check_choice("promise", promised, (EPISODE, HOUR))
    calibrated = {
        "maxima_": arrays.pop(MAXIMA, None),
        "blocks_": None if blocks is None else Blocks.restored(blocks),
        "promised_": promised,
    }
    kept = {
        "learned_from_": arrays.pop(LEARNED_FROM, None),
        "ceilings_from_": arrays.pop(CEILINGS_FROM, None),
        "pace_": {
            n.removeprefix(PACE).strip(): arrays.pop(n) for n in list(arrays) if n.startswith(PACE)
        },
        "motion_": arrays.pop(MOTION, None),
        "commands_": arrays.pop(COMMANDS, None),
        "about": dict(header["about"]),
        "healthy_": tuple(
            check_number("healthy", value, low=0.0) for value in header.get("healthy", ())
        ),
    }
    return arrays, kept, calibrated


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
    learned = {
        n: a if a.dtype.kind == "f" else np.asarray(a, np.float64)
        for n, a in monitor.learned_.items()
    }
    kept = {
        MAXIMA: monitor.maxima_,
        BLOCKS: None if monitor.blocks_ is None else monitor.blocks_.array,
        LEARNED_FROM: monitor.learned_from_,
        CEILINGS_FROM: monitor.ceilings_from_,
        MOTION: monitor.motion_,
        COMMANDS: monitor.commands_,
    }
    kept |= {f"{PACE} {task}": cells for task, cells in monitor.pace_.items()}
    arrays: dict[str, NDArray[Any]] = learned | {
        name: array for name, array in kept.items() if array is not None
    }
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


RETIRED = (
    "feedback"  # a hyperparameter of older files that made no difference once a memory was fitted
)


def restored(path: str | Path, saved: Checkpoint, make: Callable[..., Any]) -> Any:
    """Return a checkpoint's monitor, as ``make(spec, **hyperparameters)`` makes it; raise ValueError for a bad file."""
    try:
        how = {n: value for n, value in saved.header["hyperparameters"].items() if n != RETIRED}
        return make(StreamSpec.from_json(saved.header["spec"]), **how).restore(saved)
    except (KeyError, TypeError) as error:
        raise DamagedFile(path, error) from error


def rounded(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return arrays whose weights ``packed`` stores in 8 bits. Raises ValueError where a weight is not finite."""
    found: dict[str, NDArray[Any]] = dict(arrays)
    for name in found.keys() & set(WEIGHTS):
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{name} has weights that are not finite: fit the memory anew")
        found[name] = _weights(*_quantised(found[name]))
    return found


def packed(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the arrays as they are stored: weights in 8 bits where nothing is lost by it."""
    found: dict[str, NDArray[Any]] = dict(arrays)
    for name in WEIGHTS:
        if name in arrays and np.isfinite(arrays[name]).all():
            k, scale = _quantised(arrays[name])
            if _weights(k, scale).tobytes() == arrays[name].tobytes():
                del found[name]
                found |= {name + BITS: k, name + SCALE: scale}
    return found


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return what ``packed`` was given. Raises ValueError for parts that do not fit."""
    found: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        own = name.removesuffix(BITS).removesuffix(ROOT)
        scale = arrays.get(own + SCALE, np.zeros(0))
        if name.endswith(BITS):
            if array.dtype != np.int8 or array.ndim != 2 or scale.shape != (len(array), 1):
                raise ValueError(
                    f"{own} of 8 bits should have a scale for each of its rows, got {scale.shape}"
                )
            found[own] = _weights(array, scale)
        elif name.endswith(ROOT):
            size = round((np.sqrt(8 * array.size + 1) - 1) / 2)
            if (
                array.dtype != np.int16
                or scale.shape != ()
                or array.shape != (size * (size + 1) // 2,)
            ):
                raise ValueError(
                    f"the root of {own} should be half a matrix of 16 bits with one scale"
                )
            K = np.zeros((size, size))
            K[np.tril_indices(size)] = array
            found[own] = (K @ K.T) * scale**2
        elif not name.endswith(SCALE):
            found[name] = array
    return found


def _quantised(W: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Return k (P, Q) and s (P, 1)."""
    fraction, exponent = np.frexp(np.abs(W).max(axis=1, keepdims=True).astype(np.float64) / LARGEST)
    scale = np.ldexp(np.ceil(np.ldexp(fraction, SCALE_BITS) - 1e-9), exponent - SCALE_BITS).astype(
        np.float32
    )
    k = np.rint(W / np.where(scale > 0, scale, np.float32(1)))
    return np.where((k == 0) & (W != 0), np.sign(W), k).astype(np.int8), scale


def _weights(k: NDArray[np.int8], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    return scale * k.astype(np.float32)
