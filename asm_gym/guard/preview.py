"""Check a chunk of actions, before the first is executed, against the places and speeds of healthy hands.

    v_j = [v_{j-1}, u_j] M,    p_j = p_{j-1} + Δt v_j        of all hands, after action u_j (``detection.commands``)

p_j and v_j are looked up in the places of healthy hands. If no hand is sensed, each action is compared with the range
of healthy commands. The preview predicts neither the force of a contact nor surprise: rows that the memory predicts for
a chunk surprise it more in healthy chunks than in hostile ones.
"""

from __future__ import annotations

from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.commands import PACE, PLACE, hands_of, out_of_range
from asm_gym.detection.contact_limits import ContactLimits, Pace
from asm_gym.validation import as_float32

NO_ACTION = "no action"  # a number of it is not finite
SLACK = 0.05  # a hand may be faster than healthy ones by so much [m/s]

Floats32 = NDArray[np.float32]


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
        raise ValueError(f"a chunk must have the shape {shape} and at least one action, got the shape {chunk.shape}")
    return chunk


def preview_chunk(
    chunk: Floats32,
    row: NDArray[np.floating[Any]],
    last: NDArray[np.floating[Any]],
    monitor: Any,
    dt: float,
    limits: ContactLimits | None = None,
) -> Preview:
    """Return what becomes of a chunk.

    Args:
        chunk: (k, A).
        row: (D,) sensed before it.
        last: (A,) what was done before it.
        monitor: holds the chunk against what it was calibrated on.
        dt: control period [s].
        limits: slow hands down; None for no limits.
    """
    motion, commands = getattr(monitor, "motion_", None), getattr(monitor, "commands_", None)
    own = limits.pace if limits is not None else None
    pace = None if motion is None else own or Pace.of(getattr(monitor, "pace_", {}))
    place, velocity = row.astype(np.float64)[hands_of(monitor.spec)].swapaxes(0, 1)  # (H, 3)
    known, rows = pace is not None or commands is not None, max(1, round(dt / monitor.spec.dt))
    for j, action in enumerate(chunk):
        reason = "" if np.isfinite(action).all() else NO_ACTION
        if pace is not None and not reason:
            for _ in range(rows):
                velocity = (np.concatenate([velocity.ravel(), action]) @ motion).reshape(place.shape)
                if limits is not None:
                    velocity *= [[_share(limits, *hand)] for hand in zip(count(), place, velocity, strict=False)]
                place = place + dt / rows * velocity
            reason = next(filter(None, (_beyond(pace, *hand) for hand in zip(count(), place, velocity))), "")
        elif commands is not None and not reason:
            reason = out_of_range(commands, last, action)
        if reason:
            return Preview(j, reason, j * dt, known)
        last = action
    return Preview(None, known=known)


def _share(limits: ContactLimits, hand: int, place: NDArray[np.float64], velocity: NDArray[np.float64]) -> float:
    """Return the share of a velocity (3,) that limits leave to a hand at a place (3,)."""
    twist, speed = np.append(velocity, np.zeros(3)), np.linalg.norm(velocity)
    return min(1.0, float(limits.shares(hand, place, twist[None], np.array([speed]), np.zeros(1))[0]))


def _beyond(pace: Pace, hand: int, place: NDArray[np.float64], velocity: NDArray[np.float64]) -> str:
    """Return what no healthy hand did near a place (3,): be there, or have the velocity (3,); else empty."""
    seen = pace.seen(hand, place)[:, :3]
    if not seen.any():
        return PLACE
    return PACE if (np.abs(velocity) > np.where(velocity > 0.0, *seen) + SLACK).any() else ""
