"""What a monitor's file holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import Checkpoint
from asm_gym.detection import Blocks
from asm_gym.detection.base import Arrays
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_number

MAXIMA, BLOCKS, LEARNED_FROM, CEILINGS_FROM = "nominal_maxima", "nominal_blocks", "learned_from", "ceilings_from"
"""Under which names a checkpoint keeps what ``calibrate`` has found, by the episode and by the hour, and the marks of
what ``fit`` and ``learn_ceilings`` were given."""


class SavedMonitor(NamedTuple):
    """A checkpoint of a monitor.

    Attributes:
        arrays: what its model and its detections have learned, by name.
        maxima: (n,) largest surprise in each episode of the calibration; None before it.
        blocks: the same by the hour; None before it, and in files that were written before it was kept.
        learned_from: marks of the episodes that were learned from, as ``overlap.sketch`` keeps them; None in such
            files.
        ceilings_from: the same of the hours that told ceilings; None where none did.
        promised: what the threshold's promise counts by.
        threshold: as it was written.
        detection: which the threshold is of.
        skills: names of those that the model knows.
        about: whatever else was worth knowing.
    """

    arrays: Arrays
    maxima: NDArray[np.float64] | None
    blocks: Blocks | None
    learned_from: NDArray[np.float64] | None
    ceilings_from: NDArray[np.float64] | None
    promised: str
    threshold: object
    detection: str
    skills: tuple[str, ...]
    about: dict[str, Any]

    @classmethod
    def of(cls, saved: Checkpoint) -> Self:
        """What a checkpoint says. Raises KeyError or ValueError where something is missing or not declared."""
        header = saved.header
        undeclared = sorted(set(saved.arrays) - set(header["shapes"]))
        if undeclared:
            raise ValueError(f"the checkpoint is damaged: its header declares no {', '.join(undeclared)}")
        arrays = {name: saved.array(name, *shape) for name, shape in header["shapes"].items()}
        maxima, blocks = (arrays.pop(name, None) for name in (MAXIMA, BLOCKS))
        learned, ceilings = (arrays.pop(name, None) for name in (LEARNED_FROM, CEILINGS_FROM))
        promised = header.get("promised", EPISODE)
        check_choice("promise", promised, (EPISODE, HOUR))
        by_hour = None if blocks is None else Blocks.restored(blocks)
        kept = maxima, by_hour, learned, ceilings, promised, header["threshold"]
        return cls(arrays, *kept, header["detection"], tuple(header["skills"]), dict(header["about"]))

    def threshold_below(self, reach: float) -> float | None:
        """The threshold, once it is a number that surprise can exceed, which never comes to ``reach``."""
        if self.threshold is None:
            return None
        number = check_number("threshold", self.threshold, low=0.0)
        if number >= reach:
            raise ValueError(f"threshold must be below {reach:g}, all that errors can add up to, got {number:g}")
        return number


def calibration_arrays(
    maxima: NDArray[np.float64] | None, blocks: Blocks | None, *marks: NDArray[np.float64] | None
) -> Arrays:
    """What a checkpoint keeps of them, by name; of what there is."""
    by_hour = None if blocks is None else blocks.array
    found = dict(zip((MAXIMA, BLOCKS, LEARNED_FROM, CEILINGS_FROM), (maxima, by_hour, *marks), strict=True))
    return {name: array for name, array in found.items() if array is not None}


class Restorable(Protocol):
    """What takes up a checkpoint of its own kind."""

    def restore(self, saved: Checkpoint) -> Self: ...


R = TypeVar("R", bound=Restorable)


def restored(path: str | Path, saved: Checkpoint, make: Callable[..., R]) -> R:
    """The monitor that a checkpoint is of, as ``make(spec, **hyperparameters)`` makes it before it is fitted.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        return make(StreamSpec.from_json(saved.header["spec"]), **saved.header["hyperparameters"]).restore(saved)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
