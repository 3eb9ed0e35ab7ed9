"""How hands move by commands, and what healthy policies commanded.

v_t = [v_{t-1}, u_t] M        by least squares, of the velocities v_t of all hands and the action u_t

A command u_t is healthy    least - m <= u_t <= most + m    and |u_t - u_{t-1}| <= s
                            m = RANGE_MARGIN (most - least),  s = STEP_FACTOR (greatest step) + m
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

PLACE = "place"  # a hand where none was, or a command out of range
PACE = "pace"  # a hand or a command faster than any
RANGE_MARGIN = 0.25  # a command may be out of the healthy range by this share of it
STEP_FACTOR = 2.0  # a command may change so many times as much in a row as healthy ones did

Floats = NDArray[np.floating[Any]]


def hands_of(spec: StreamSpec) -> NDArray[np.intp]:
    """Return (H, 2, 3) the columns of place and velocity of each hand of a stream."""
    hands = []
    columns = np.arange(spec.size)
    for position, place in spec.slices.items():
        velocity = f"{position.removesuffix('position')}velocity"
        if position.endswith("hand_position") and velocity in spec.slices:
            hands.append([columns[place], columns[spec.slices[velocity]]])
    return np.array(hands, np.intp).reshape(-1, 2, 3)


def learned_motion(streams: Sequence[Floats], spec: StreamSpec) -> NDArray[np.float64]:
    """Return M (3 H + A, 3 H) of streams (T, D)."""
    columns = hands_of(spec)[:, 1].ravel()
    inputs = []
    velocities = []
    for stream in streams:
        before = stream[:-1, columns]
        commands = stream[1:, spec.motor]
        inputs.append(np.hstack([before, commands]))
        velocities.append(stream[1:, columns])
    solution = np.linalg.lstsq(np.concatenate(inputs), np.concatenate(velocities), rcond=None)
    return np.asarray(solution[0], np.float64)


def healthy_commands(streams: Sequence[Floats], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return (3, A) the least, the most, and the greatest change in a row of columns (A,) of healthy streams (T, D)."""
    commands = [stream[:, columns] for stream in streams]
    every = np.concatenate(commands)
    steps = np.concatenate([np.diff(episode, axis=0) for episode in commands])
    greatest_step = np.abs(steps).max(axis=0, initial=0.0)
    return np.stack([every.min(axis=0), every.max(axis=0), greatest_step])


def command_limits(commands: Floats) -> NDArray[np.float64]:
    """Return (3, A) the least and the most that may be commanded, and the greatest step of a row.

    Args:
        commands: (3, A) of healthy policies, as ``healthy_commands`` returns them.
    """
    least, most, step = commands.astype(np.float64)
    margin = RANGE_MARGIN * (most - least)
    return np.stack([least - margin, most + margin, STEP_FACTOR * step + margin])


def out_of_range(commands: Floats, before: Floats, action: Floats) -> str:
    """Return how an action differs from all healthy ones: ``PLACE``, out of range, ``PACE``, too large a step, or "".

    Args:
        commands: (3, A) of healthy policies.
        before: (A,) the action before; a number that is not finite allows any step.
        action: (A,).
    """
    least, most, largest_step = command_limits(commands)
    size = len(least)
    command = action[:size]
    if (command < least).any() or (command > most).any():
        return PLACE
    step = np.abs(command - before[:size])
    if (step > largest_step).any():
        return PACE
    return ""
