"""How bad it is: what presses on the arm, for how long, how fast the hand goes, and how hard it would hit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

FREE_FORCE = 40.0
"""Force that healthy motion of many tasks comes to; impulse is counted beyond it [N]."""

HAND_WEIGHT = 10.0
"""What a hand weighs on its own wrist's sensor, about [N]."""

LEVER = 0.5
"""How far from a joint's axis an arm is touched, about [m]."""

BLOW = 2000.0
"""First blow on a table for each m/s of the hand [N s/m]: 830 N at 0.27 m/s, 300 at 0.15, 190 at 0.10 were measured."""

FAST = 0.35
"""No healthy hand is faster [m/s]."""


class Severity(NamedTuple):
    """How bad it is.

    Attributes:
        load: the largest share of a contact limit that was felt in a physics substep of this step; not a number where
            nobody feels within steps.
        presses: a limit was passed.
        force: contact force on the arm, estimated from wrist and joints, the mean of the step [N]; not a number where
            neither is sensed.
        impulse: what that force has added up to beyond ``FREE_FORCE`` in this episode [N s].
        speed: of the fastest hand [m/s]; not a number where none is sensed.
        predicted_force: of the blow if the hand met something stiff now [N].
        held: the arm is kept where it is.
        left_s: when in the step a limit was passed [s]; not a number where none was.
    """

    load: float = np.nan
    presses: bool = False
    force: float = np.nan
    impulse: float = 0.0
    speed: float = np.nan
    predicted_force: float = np.nan
    held: bool = False
    left_s: float = np.nan

    @property
    def felt(self) -> bool:
        """Whether anybody would know if the arm pressed."""
        return bool(np.isfinite(self.load) or np.isfinite(self.force))

    @property
    def fast(self) -> bool:
        """Whether a hand is faster than any healthy one."""
        return bool(self.speed > FAST)


class SeverityEstimator:
    """Estimates severity from the rows of one stream, by the names of its channels.

    Args:
        spec: of the stream.
    """

    def __init__(self, spec: StreamSpec) -> None:
        self._dt = spec.dt
        self._forces, self._speeds = _triples(spec, "wrist_force"), _triples(spec, "hand_velocity")
        torques = [
            np.arange(spec.size)[spec.slices[c.name]] for c in spec.channels if c.name.endswith("external_torque")
        ]
        self._torques = np.concatenate(torques) if torques else np.zeros(0, np.intp)
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self._impulse = 0.0

    def of(self, row: NDArray[np.floating[Any]], load: float, left_s: float, held: bool) -> Severity:
        """Of the next row (D,), which may have numbers that are not finite.

        Args:
            load: the largest share of a contact limit felt since the last row; not a number where nobody says.
            left_s: when a limit was passed [s]; not a number where none was.
            held: the arm is kept where it is.
        """
        force = self._force(row)
        if force > FREE_FORCE:
            self._impulse += (force - FREE_FORCE) * self._dt
        speed = _largest_norm(row, self._speeds)
        presses = bool(load > 1.0 or np.isfinite(left_s))
        return Severity(load, presses, force, self._impulse, speed, BLOW * speed, held, left_s)

    def _force(self, row: NDArray[np.floating[Any]]) -> float:
        wrist = max(_largest_norm(row, self._forces) - HAND_WEIGHT, 0.0) if len(self._forces) else np.nan
        torques = np.abs(row[self._torques].astype(np.float64))
        joints = float(np.max(torques, initial=0.0)) / LEVER if self._torques.size else np.nan
        return float(np.fmax(wrist, joints))


def _triples(spec: StreamSpec, name: str) -> NDArray[np.intp]:
    """(n, 3) columns of the channels of ``name``, of all arms."""
    found = [np.arange(spec.size)[spec.slices[c.name]] for c in spec.channels if c.name.endswith(name) and c.size == 3]
    return np.array([f for f in found if f.size == 3], np.intp).reshape(-1, 3)


def _largest_norm(row: NDArray[np.floating[Any]], triples: NDArray[np.intp]) -> float:
    """Not a number where there are none."""
    if not len(triples):
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(np.linalg.norm(row[triples].astype(np.float64), axis=1)))
