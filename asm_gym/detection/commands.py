"""How hands move by commands, and what healthy policies commanded.

v_t = [v_{t-1}, u_t] M        by least squares, of the velocities v_t of all hands and the action u_t
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

PLACE, PACE = "place", "pace"  # a hand where none was, or a command out of range; a hand or a command faster than any
MARGIN = 0.05  # a command may be out of range by this share of the range

Floats = NDArray[np.floating[Any]]


def hands_of(spec: StreamSpec) -> NDArray[np.intp]:
    """Return (H, 2, 3) the columns of place and velocity of each hand of a stream."""
    pairs = [(n, f"{n.removesuffix('position')}velocity") for n in spec.slices if n.endswith("hand_position")]
    columns = np.arange(spec.size)
    found = [[columns[spec.slices[name]] for name in pair] for pair in pairs if pair[1] in spec.slices]
    return np.array(found, np.intp).reshape(-1, 2, 3)


def learned_motion(streams: Sequence[Floats], spec: StreamSpec) -> NDArray[np.float64]:
    """Return M (3 H + A, 3 H) of streams (T, D)."""
    velocities = hands_of(spec)[:, 1].ravel()
    inputs = np.concatenate([np.hstack([stream[:-1, velocities], stream[1:, spec.motor]]) for stream in streams])
    followed = np.concatenate([stream[1:, velocities] for stream in streams])
    return np.asarray(np.linalg.lstsq(inputs, followed, rcond=None)[0], np.float64)


def healthy_commands(streams: Sequence[Floats], spec: StreamSpec) -> NDArray[np.float32]:
    """Return (3, A) the least, the most, and the greatest change in a row of what healthy streams (T, D) commanded."""
    told = [stream[:, spec.motor] for stream in streams]
    steps = np.concatenate([np.abs(np.diff(own, axis=0)) for own in told])
    return np.stack([f(np.concatenate(told), axis=0) for f in (np.min, np.max)] + [steps.max(axis=0, initial=0.0)])


def out_of_range(commands: Floats, before: Floats, action: Floats) -> str:
    """Return what of an action (A,), after another, no healthy one was: in range, or so small a change; else empty."""
    least, most, step = commands.astype(np.float64)
    action, before, margin = action[: step.size], before[: step.size], MARGIN * (most - least)
    if ((action < least - margin) | (action > most + margin)).any():
        return PLACE
    return PACE if (np.abs(action - before) > step + margin).any() else ""
