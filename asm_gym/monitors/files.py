"""Files of monitors: what a checkpoint of one holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import Checkpoint, write_checkpoint
from asm_gym.detection import Blocks, EvidenceDetection
from asm_gym.detection.base import Arrays
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.detection.contact_limits import FamiliarSpeed
from asm_gym.monitors.packing import is_older, packed, unpacked
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_number

if TYPE_CHECKING:
    from asm_gym.monitors.calibrated_monitor import CalibratedMonitor

MAXIMA, BLOCKS, LEARNED_FROM, CEILINGS_FROM = "nominal_maxima", "nominal_blocks", "learned_from", "ceilings_from"
"""Names of the arrays that ``calibrate``, ``fit`` and ``learn_ceilings`` keep in a checkpoint."""


class SavedMonitor(NamedTuple):
    """A checkpoint of a monitor.

    Attributes:
        arrays: what its model and its detections have learned, by name.
        maxima: (n,) largest surprise in each episode of the calibration; None before it.
        blocks: the same by the hour; None before it.
        learned_from: marks of the episodes that were learned from; None where none are kept.
        ceilings_from: marks of the hours that set ceilings; None where none did.
        promised: unit that the threshold's promise counts by.
        threshold: as it was written.
        detection: the one that the threshold is of.
        skills: names of those that the model knows.
        about: anything else.
        healthy: (N,) largest forces in the calibration episodes.
        familiar: speed of the hand in them; None where the stream has no hand.
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
    healthy: tuple[float, ...]
    familiar: FamiliarSpeed | None

    @classmethod
    def of(cls, saved: Checkpoint) -> Self:
        """Read a checkpoint. Raises KeyError or ValueError where something is missing or not declared."""
        header, saved = saved.header, saved._replace(arrays=unpacked(saved.arrays))
        undeclared = sorted(set(saved.arrays) - set(header["shapes"]))
        if undeclared:
            raise ValueError(f"the checkpoint is damaged: its header declares no {', '.join(undeclared)}")
        arrays = {name: saved.array(name, *shape) for name, shape in header["shapes"].items()}
        maxima, blocks, learned, ceilings = (
            arrays.pop(name, None) for name in (MAXIMA, BLOCKS, LEARNED_FROM, CEILINGS_FROM)
        )
        promised = header.get("promised", EPISODE)
        check_choice("promise", promised, (EPISODE, HOUR))
        return cls(
            arrays,
            maxima,
            None if blocks is None else Blocks.restored(blocks),
            learned,
            ceilings,
            promised,
            header["threshold"],
            header["detection"],
            tuple(header["skills"]),
            dict(header["about"]),
            tuple(check_number("healthy", value, low=0.0) for value in header.get("healthy", ())),
            FamiliarSpeed.restored(header.get("familiar", [])),
        )

    def threshold_below(self, reach: float) -> float | None:
        """Return the threshold. Raises ValueError where surprise, which never comes to ``reach``, cannot exceed it."""
        if self.threshold is None:
            return None
        number = check_number("threshold", self.threshold, low=0.0)
        if number >= reach:
            raise ValueError(f"threshold must be below {reach:g}, all that errors can add up to, got {number:g}")
        return number


def write_monitor(path: str | Path, monitor: CalibratedMonitor) -> None:
    """Write a checkpoint of a fitted monitor."""
    learned = {n: a if a.dtype.kind == "f" else np.asarray(a, np.float64) for n, a in monitor.learned_.items()}
    kept = {
        MAXIMA: monitor.maxima_,
        BLOCKS: None if monitor.blocks_ is None else monitor.blocks_.array,
        LEARNED_FROM: monitor.learned_from_,
        CEILINGS_FROM: monitor.ceilings_from_,
    }
    arrays = learned | {name: array for name, array in kept.items() if array is not None}
    header = {
        "spec": monitor.spec.to_json(),
        "hyperparameters": monitor.get_params(),
        "detection": monitor.detection.name,
        "threshold": monitor.threshold_,
        "promised": monitor.promised_,
        "skills": list(monitor.skills_),
        "about": monitor.about,
        "healthy": list(monitor.healthy_),
        "familiar": [] if monitor.familiar_ is None else monitor.familiar_.rows,
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }
    write_checkpoint(path, monitor.model.kind, header, packed(arrays))


RETIRED = "feedback"
"""A hyperparameter of older files that made no difference once a memory was fitted."""


class Restorable(Protocol):
    """Anything that takes over a checkpoint of its own kind."""

    def restore(self, saved: Checkpoint) -> Self: ...


R = TypeVar("R", bound=Restorable)


def restored(path: str | Path, saved: Checkpoint, make: Callable[..., R]) -> R:
    """Return the monitor of a checkpoint, as ``make(spec, **hyperparameters)`` makes it before it is fitted.

    Raises:
        ValueError: the file is damaged, or of an older format.
    """
    if is_older(saved.arrays):
        raise ValueError(f"{path} was written by an older asm-gym: make it anew, by asm-gym fit or asm-gym babble")
    try:
        how = {n: value for n, value in saved.header["hyperparameters"].items() if n != RETIRED}
        return make(StreamSpec.from_json(saved.header["spec"]), **how).restore(saved)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def split_off(saved: Checkpoint, prefix: str) -> tuple[Checkpoint, Arrays]:
    """Return a checkpoint without the arrays whose names have a prefix, and those arrays by the rest of their names."""
    beside = {n.removeprefix(prefix): a for n, a in saved.arrays.items() if n.startswith(prefix)}
    shapes = {n: s for n, s in saved.header["shapes"].items() if not n.startswith(prefix)}
    arrays = {n: a for n, a in saved.arrays.items() if not n.startswith(prefix)}
    return Checkpoint({**saved.header, "shapes": shapes}, arrays), beside


def taken_up(monitor: R, learned: Arrays) -> R:
    """Return a monitor that a memory keeps beside it, with what it had learned; it has no threshold of its own."""
    shapes = {name: array.shape for name, array in learned.items()}
    header = {"shapes": shapes, "skills": (), "threshold": None, "detection": EvidenceDetection.name, "about": {}}
    return monitor.restore(Checkpoint(header, dict(learned)))
