"""How hands move by commands, and what healthy policies commanded.

v_t = [v_{t-1}, u_t] M        by least squares, of the velocities v_t of all hands and the action u_t
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

PLACE = "place"  # a hand where none was, or a command out of range
PACE = "pace"  # a hand or a command faster than any
MARGIN = 0.05  # a command may be out of range by this share of the range

Floats = NDArray[np.floating[Any]]


def hands_of(spec: StreamSpec) -> NDArray[np.intp]:
    """Return (H, 2, 3) the columns of place and velocity of each hand of a stream."""
    hands = []
    columns = np.arange(spec.size)
    for name in spec.slices:
        velocity = f"{name.removesuffix('position')}velocity"
        if name.endswith("hand_position") and velocity in spec.slices:
            hands.append([columns[spec.slices[name]], columns[spec.slices[velocity]]])
    return np.array(hands, np.intp).reshape(-1, 2, 3)


def learned_motion(streams: Sequence[Floats], spec: StreamSpec) -> NDArray[np.float64]:
    """Return M (3 H + A, 3 H) of streams (T, D)."""
    velocities = hands_of(spec)[:, 1].ravel()
    inputs = np.concatenate(
        [np.hstack([stream[:-1, velocities], stream[1:, spec.motor]]) for stream in streams]
    )
    following = np.concatenate([stream[1:, velocities] for stream in streams])
    solution = np.linalg.lstsq(inputs, following, rcond=None)[0]
    return np.asarray(solution, np.float64)


def healthy_commands(streams: Sequence[Floats], spec: StreamSpec) -> NDArray[np.float32]:
    """Return (3, A) the least, the most, and the greatest change in a row of what healthy streams (T, D) commanded."""
    commands = [stream[:, spec.motor] for stream in streams]
    changes = np.concatenate([np.abs(np.diff(episode, axis=0)) for episode in commands])
    every = np.concatenate(commands)
    return np.stack([every.min(axis=0), every.max(axis=0), changes.max(axis=0, initial=0.0)])


def out_of_range(
    commands: Floats,
    before: Floats,
    action: Floats,
) -> str:
    """Return what of an action (A,), after another, no healthy one was: in range, or so small a change; else empty."""
    least, most, change = commands.astype(np.float64)
    size = change.size
    now = action[:size]
    margin = MARGIN * (most - least)
    if ((now < least - margin) | (now > most + margin)).any():
        return PLACE
    if (np.abs(now - before[:size]) > change + margin).any():
        return PACE
    return ""
