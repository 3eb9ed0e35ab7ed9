"""Check a chunk of actions, before the first is executed, against the places and speeds of healthy hands.

    v_j = [v_{j-1}, u_j] M,    p_j = p_{j-1} + Δt v_j        of all hands, after action u_j (``detection.commands``)

p_j and v_j are looked up in the places of healthy hands. If no hand is sensed, each action is compared with the range
of healthy commands. The preview predicts neither the force of a contact nor surprise: rows that the memory predicts for
a chunk surprise it more in healthy chunks than in hostile ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.commands import PACE, PLACE, hands_of, out_of_range
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed import Floats
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.robot_table import Floats32
from asm_gym.validation import as_float32

NO_ACTION = "no action"  # a number of it is not finite
SLACK = 0.05  # a hand may be faster than healthy ones by so much [m/s]


class Preview(NamedTuple):
    """The prediction for a chunk of actions."""

    at: int | None  # index of the first action that should not be executed; None if all may be
    reason: str = ""  # ``"place"``, ``"pace"``, ``"no action"``; empty if all may be executed
    seconds: float = np.inf  # time until that action [s]
    known: bool = True  # False: the monitor was calibrated on streams without hands and commands
    kept: Floats32 = np.zeros((0, 0), np.float32)  # (k', A) the actions to execute


def checked_chunk(actions: Any, shape: tuple[int, ...]) -> Floats32:
    """Return a chunk (k, *shape). Raises ValueError for another shape, or no action."""
    chunk = np.array(as_float32(actions, "a chunk of actions"))
    if chunk.shape[1:] != shape or not len(chunk):
        raise ValueError(
            f"a chunk must have the shape {shape} and at least one action, "
            f"got the shape {chunk.shape}"
        )
    return chunk


def one_row_each(actions: NDArray[Any]) -> NDArray[Any]:
    """Return actions (k, ...) as rows (k, A)."""
    return actions.reshape(len(actions), -1)


def preview_chunk(
    chunk: Floats32,
    row: NDArray[np.floating[Any]],
    last: NDArray[np.floating[Any]],
    monitor: Any,
    dt: float,
    limits: ContactLimits | None = None,
) -> Preview:
    """Return the prediction for a chunk.

    Args:
        chunk: (k, A).
        row: (D,) sensed before it.
        last: (A,) what was done before it.
        monitor: holds the chunk against what it was calibrated on.
        dt: control period [s].
        limits: slow hands down; None for no limits.

    Raises:
        UnsupportedEnvironment: the memory reads actions of another size.
    """
    speed_map = None
    commands = None
    commanded = monitor.spec.motor.size
    if commanded:
        speed_map = _speed_map(monitor, limits)
        commands = getattr(monitor, "commands_", None)
    known = speed_map is not None or commands is not None
    if known and chunk.shape[1] != commanded:
        raise UnsupportedEnvironment(
            f"actions hold {chunk.shape[1]} numbers, and the memory reads {commanded} commands",
            advice="preview() needs a memory of these actions, by asm-gym fit",
        )
    sensed = row.astype(np.float64)[hands_of(monitor.spec)]  # (H, 2, 3)
    hands = Hands(
        places=sensed[:, 0],
        velocities=sensed[:, 1],
        monitor=monitor,
        dt=dt,
        limits=limits,
    )
    for index, action in enumerate(chunk):
        reason = ""
        if not np.isfinite(action).all():
            reason = NO_ACTION
        elif speed_map is not None:
            hands.move(action)
            reason = hands.beyond(speed_map)
        elif commands is not None:
            reason = out_of_range(commands, last, action)
        if reason:
            return Preview(at=index, reason=reason, seconds=index * dt, known=known)
        last = action
    return Preview(at=None, known=known)


def _speed_map(monitor: Any, limits: ContactLimits | None) -> HandSpeedMap | None:
    """Return how fast healthy hands went; None where the monitor cannot predict how hands move."""
    if getattr(monitor, "motion_", None) is None:
        return None
    if limits is not None and limits.pace is not None:
        return limits.pace
    return HandSpeedMap.of(getattr(monitor, "pace_", {}))


@dataclass
class Hands:
    """The hands of a robot, as the monitor predicts their motion."""

    places: Floats  # (H, 3) [m]
    velocities: Floats  # (H, 3) [m/s]
    monitor: Any  # knows how hands move by commands, ``motion_`` (3 H + A, 3 H)
    dt: float  # control period [s]
    limits: ContactLimits | None  # slow the hands down; None for no limits

    def move(self, action: Floats32) -> None:
        """Predict where the hands are after an action (A,), and how fast."""
        rows = max(1, round(self.dt / self.monitor.spec.dt))  # of the stream, in a control period
        for _ in range(rows):
            inputs = np.append(self.velocities, action)
            velocities = inputs @ self.monitor.motion_
            self.velocities = velocities.reshape(self.places.shape)
            if self.limits is not None:
                self._slow_down(self.limits)
            self.places = self.places + self.dt / rows * self.velocities

    def _slow_down(self, limits: ContactLimits) -> None:
        for hand, velocity in enumerate(self.velocities):
            twist = np.append(velocity, np.zeros(3))
            speed = float(np.linalg.norm(velocity))
            share = limits.share(hand, self.places[hand], twist, speed)
            velocity *= min(1.0, share)

    def beyond(self, speed_map: HandSpeedMap) -> str:
        """Return what no healthy hand did near the place of any: be there, or be so fast; else empty."""
        for hand, velocity in enumerate(self.velocities):
            fastest = speed_map.fastest_near(hand, self.places[hand])[:, :3]
            if not fastest.any():
                return PLACE
            along, against = fastest
            healthy = np.where(velocity > 0.0, along, against)
            if np.any(np.abs(velocity) > healthy + SLACK):
                return PACE
        return ""
