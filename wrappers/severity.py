"""How bad it is: what presses on the arm, for how long, how fast the hand goes, and how hard it would hit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import Channel, StreamSpec

if TYPE_CHECKING:
    from asm_gym.wrappers.substeps import Beneath

FREE_FORCE = 40.0
"""Force that healthy motion of many tasks comes to; impulse is counted beyond it [N]."""

LEANS_S = 0.4
"""More than ``FREE_FORCE`` for longer than this is no blow: the arm leans on something [s]. Healthy motion of six tasks
did so for 0.35 s, once 0.45; ISO/TS 15066 calls contact quasi-static from half a second on."""

AGAIN = 4.0
"""Each time that the policy has pressed too hard before shortens that by as many times."""

LEVER = 0.5
"""How far from a joint's axis an arm is touched, about [m]."""

BLOW = 2900.0
"""First blow on a table for each m/s of the hand [N s/m]; docs/results/harm.md has 2,500 to 3,100, on a bin 4,100."""

FAST = 0.35
"""No healthy hand is faster [m/s]."""


class Severity(NamedTuple):
    """How bad it is.

    Attributes:
        load: the largest share of a contact limit that was felt in a physics substep of this step; not a number where
            nobody feels within steps.
        presses: a limit was passed, or the arm leans on something.
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
        return math.isfinite(self.load) or math.isfinite(self.force)

    @property
    def fast(self) -> bool:
        """Whether a hand is faster than any healthy one."""
        return bool(self.speed > FAST)


class ContactForce:
    """Contact force on arms, estimated from what wrists and joints feel.

    Args:
        wrists: (n, 3) where the force at each wrist stands.
        joints: (J,) where the external torques stand.
    """

    def __init__(self, wrists: NDArray[np.intp], joints: NDArray[np.intp]) -> None:
        self.columns = wrists, joints
        self._wrists, self._joints = wrists.tolist(), joints.tolist()

    @classmethod
    def felt_by(cls, channels: Sequence[Channel]) -> Self:
        """From numbers in the order of ``channels``, by their names."""
        ends = np.cumsum([0, *(c.size for c in channels)])
        at = {c.name: np.arange(ends[i], ends[i + 1]) for i, c in enumerate(channels)}
        wrists = [columns for name, columns in at.items() if name.endswith("wrist_force") and len(columns) == 3]
        joints = [columns for name, columns in at.items() if name.endswith("external_torque")]
        return cls(np.array(wrists, np.intp).reshape(-1, 3), np.concatenate([np.zeros(0, np.intp), *joints]))

    def __call__(self, felt: NDArray[np.floating[Any]]) -> float:
        """[N] of (N,); not a number where neither is felt."""
        numbers = felt.tolist()
        wrist = _largest_norm(numbers, self._wrists)  # with the weight of the hand, 5 to 10 N
        joints = _largest(abs(numbers[j]) for j in self._joints) / LEVER
        return wrist if joints != joints or wrist >= joints else joints


class SeverityEstimator:
    """Estimates severity from the rows of one stream, by the names of its channels.

    Args:
        spec: of the stream.
    """

    def __init__(self, spec: StreamSpec) -> None:
        self._dt = spec.dt
        self._force, hands = ContactForce.felt_by(spec.channels), _triples(spec, "hand_velocity")
        self.columns = *self._force.columns, hands
        """Of a row: (n, 3) forces at wrists, (J,) external torques, (n, 3) velocities of hands."""
        self._speeds = hands.tolist()
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.pressed = 0.0, 0.0
        """How much, beyond ``FREE_FORCE`` [N s], and for how long without a pause [s]."""

    def of(
        self, row: NDArray[np.floating[Any]], beneath: Beneath | None, held: bool, leans_s: float = LEANS_S
    ) -> Severity:
        """Of the next row (D,), which may have numbers that are not finite.

        Args:
            beneath: what came of the control step that the row ends; None where it ends none.
            held: the arm is kept where it is.
            leans_s: how long it may press with more than ``FREE_FORCE`` [s].
        """
        load, left_s, force = (np.nan, np.nan, np.nan) if beneath is None else beneath
        # What the arm feels itself is not what a faulty sensor says of it; where nobody else says, the row does.
        force = self._force(row) if math.isnan(force) else force
        more = max(force - FREE_FORCE, 0.0) if math.isfinite(force) else 0.0
        impulse, leant = self.pressed
        impulse, leant = self.pressed = impulse + more * self._dt, leant + self._dt if more else 0.0
        speed = _largest_norm(row, self._speeds)
        presses = load > 1.0 or math.isfinite(left_s) or leant > leans_s
        return Severity(load, presses, force, impulse, speed, BLOW * speed, held, left_s)


def _triples(spec: StreamSpec, name: str) -> NDArray[np.intp]:
    """(n, 3) columns of the channels of ``name``, of all arms."""
    found = [np.arange(spec.size)[spec.slices[c.name]] for c in spec.channels if c.name.endswith(name) and c.size == 3]
    return np.array([f for f in found if f.size == 3], np.intp).reshape(-1, 3)


def _largest_norm(numbers: Sequence[float] | NDArray[np.floating[Any]], triples: list[list[int]]) -> float:
    """Not a number where there are none."""
    vectors = [(float(numbers[i]), float(numbers[j]), float(numbers[k])) for i, j, k in triples]
    return _largest(math.sqrt(x * x + y * y + z * z) for x, y, z in vectors)


def _largest(numbers: Iterable[float]) -> float:
    """Not a number where one is none, or there are none."""
    found = -math.inf
    for number in numbers:
        if not number <= found and found == found:
            found = number
    return found if found != -math.inf else math.nan
