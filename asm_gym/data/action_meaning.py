"""What the numbers of an action mean: changes of a state, its targets, velocities, or torques.

For a target, a robot stays at the action ``slope x[sense] + offset``; for a change or a velocity it
stays at 0. No action makes it stay where it commands torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.validation import check_choice, short_repr

DELTA = "delta"
TARGET = "target"
VELOCITY = "velocity"
TORQUE = "torque"
MEANINGS = DELTA, TARGET, VELOCITY, TORQUE
KEPT = "kept"  # the number never changed: its last value is kept
UNKNOWN = ""
ActionMeans = str | Sequence[str]  # one meaning for all numbers of an action, or one for each
ACTIONS = "actions"  # key under which a monitor's ``about`` holds the recorded meaning


@dataclass(frozen=True)
class ActionMeaning:
    """What the A numbers of an action mean, and the action for which a robot stays.

    Attributes:
        means: of each number one of ``MEANINGS``, ``KEPT`` or ``UNKNOWN``.
        senses: of each target the column of the stream that senses it; -1 where none is known.
        slopes: of each target the slope over its sense.
        offsets: of each target the value where its sense is 0.
    """

    means: tuple[str, ...]
    senses: tuple[int, ...]
    slopes: tuple[float, ...]
    offsets: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, saved: Any) -> Self:
        return cls(**{name: tuple(values) for name, values in saved.items()})

    @classmethod
    def declared(
        cls,
        means: ActionMeans,
        size: int,
        recorded: ActionMeaning | None = None,
    ) -> ActionMeaning:
        """Return the meaning that a user or an environment declares.

        Args:
            means: one name for all numbers of an action, or one for each.
            size: A, how many numbers an action has.
            recorded: what recorded episodes show, which gives the senses of targets.

        Raises:
            ValueError: an unknown meaning, or another number of them.
        """
        if isinstance(means, str):
            means = (means,) * size
        if len(means) != size:
            raise ValueError(
                f"action_means must be one name, or {size} of them, got {short_repr(means)}"
            )
        for name in means:
            check_choice("action_means", name, MEANINGS)
        known = recorded or cls.unknown((size,))
        return replace(known, means=tuple(means))

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> Self:
        """Return that nothing is known of actions of this shape."""
        size = int(np.prod(shape))
        return cls(
            means=(UNKNOWN,) * size,
            senses=(-1,) * size,
            slopes=(0.0,) * size,
            offsets=(0.0,) * size,
        )

    def check_stays(self, robot: object, names: Sequence[str] = ()) -> None:
        """Check that some action is known to make a robot stay.

        Args:
            robot: what the message calls the robot.
            names: (A,) of the numbers of the action, if they have names.

        Raises:
            UnsupportedEnvironment: a number of the action is a torque, or its meaning is unknown.
        """
        refused = []
        for number, means in enumerate(self.means):
            if means in (UNKNOWN, TORQUE):
                refused.append(names[number] if names else f"number {number}")
        if refused:
            raise UnsupportedEnvironment(
                f"no hold is known for actions of {robot}: {', '.join(refused)} are torques, "
                "or their meaning is unknown. Set action_means to delta, target, velocity for all "
                "or for each; or use Hold(env, safe_action=...), another policy, "
                'on_alarm="terminate" or "monitor"'
            )

    def staying(
        self,
        row: NDArray[np.floating[Any]],
        before: NDArray[np.floating[Any]],
        executed: NDArray[np.floating[Any]],
    ) -> NDArray[np.float32]:
        """Return the action for which a robot stays where it is sensed to be.

        An arm that pursues the ``executed`` action is between that and where it was a row before.
        A sense that says otherwise has failed, and counts up to there. A target whose sense is
        unknown or not finite stays at the executed action, as does what is kept. All else stays
        at 0.

        Args:
            row: (D,) the newest of the stream.
            before: (D,) the row before it.
            executed: (A,) the last action before the robot is to stay.

        Returns:
            (A,) the action.
        """
        target = self.sensed_target(row)
        previous = self.sensed_target(before)
        low = np.minimum(previous, executed)
        high = np.maximum(previous, executed)
        between = np.clip(target, low, high)

        target = np.where(np.isfinite(between), between, target)
        target = np.where(np.isfinite(target), target, executed)
        stays = np.isin(self.means, (TARGET, KEPT))
        return np.where(stays, target, 0.0).astype(np.float32)

    def sensed_target(self, row: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return the targets (A,) that are reached at a row (D,); NaN where no sense is known."""
        senses = np.array(self.senses, np.intp)
        target = np.array(self.offsets) + np.array(self.slopes) * row[senses]
        return np.where(senses >= 0, target, np.nan)
