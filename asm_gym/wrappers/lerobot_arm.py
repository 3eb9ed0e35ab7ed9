"""Read the numbers of an arm by the names that LeRobot gives them, and say what they mean.

    row = [observation.state[MOTOR], ..., action[MOTOR], ...]    as a LeRobot dataset records them

A motor's name ends in what is read or commanded: ``elbow_flex.pos`` is a position and its target,
``elbow_flex.vel`` a velocity. What comes before is the servo.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import TARGET, UNKNOWN, VELOCITY, ActionMeaning, ActionMeans
from asm_gym.guard.robot_facts import RobotFacts

SENSED = "observation.state"
COMMANDED = "action"
LARGEST = float(np.finfo(np.float32).max)

_LABEL = re.compile(r"(observation\.state|action)\[(.*\D.*)\]")
_GRIPPER = re.compile("gripper|hand|jaw", re.IGNORECASE)


class LoopStep(NamedTuple):
    """One step of a robot's loop."""

    observation: Mapping[str, Any]  # numbers that were sensed, by name
    command: Mapping[str, Any]  # numbers of the action that belongs to them, by name


class MotorColumn(NamedTuple):
    """A column of the stream, as LeRobot names it."""

    group: str  # ``SENSED`` or ``COMMANDED``
    motor: str


def column_of(label: str) -> MotorColumn:
    """Return what a column of the stream holds, by its label.

    Raises:
        ValueError: the label names no motor.
    """
    match = _LABEL.fullmatch(label)
    if match is None:
        raise ValueError(
            "the memory must be fitted on a LeRobot dataset that names its motors, "
            f"observation.state[MOTOR] and action[MOTOR], got the channel {label!r}"
        )
    return MotorColumn(group=match[1], motor=match[2])


def servo_of(motor: str) -> str:
    """Return the servo of a motor's number: ``elbow_flex`` of ``elbow_flex.pos``."""
    return motor.rpartition(".")[0] or motor


def number_of(values: Mapping[str, Any], name: str) -> float:
    """Return a number by name, infinite beyond what a float32 holds; NaN where there is none."""
    try:
        number = float(values.get(name, np.nan))
    except (TypeError, ValueError, OverflowError):  # 10**400 is no number that a servo can take
        return np.nan
    if abs(number) > LARGEST:
        return math.copysign(math.inf, number)
    return number


def row_of(step: LoopStep, columns: Sequence[MotorColumn]) -> NDArray[np.float32]:
    """Return (1, D) the row of the stream; NaN where a number is missing."""
    sources = {SENSED: step.observation, COMMANDED: step.command}
    row = [number_of(sources[column.group], column.motor) for column in columns]
    return np.array([row], np.float32)


def meaning_of(
    names: Sequence[str],
    labels: Sequence[str],
    action_means: ActionMeans | None,
) -> ActionMeaning:
    """Return what an action means, and which column senses each target.

    Args:
        names: (A,) of the numbers of the action.
        labels: (D,) of the columns of the stream.
        action_means: what the user says; None for what the names say.
    """
    means = tuple(map(_usual_meaning, names))
    if action_means is not None:
        means = ActionMeaning.declared(action_means, len(names)).means
    column_by_label = {label: column for column, label in enumerate(labels)}
    return ActionMeaning(
        means=means,
        senses=tuple(column_by_label.get(f"{SENSED}[{name}]", -1) for name in names),
        slopes=(1.0,) * len(names),  # a target is in the unit of its sense
        offsets=(0.0,) * len(names),
    )


def robots_of(names: Sequence[str], meaning: ActionMeaning, dt: float) -> RobotFacts:
    """Return what is known of one arm.

    Args:
        names: (A,) of the numbers of its action.
        meaning: of its action.
        dt: control period [s].
    """
    unbounded = np.full(len(names), np.inf, np.float32)
    is_gripper = [_GRIPPER.search(name) is not None for name in names]
    return RobotFacts(
        count=1,
        low=-unbounded,
        high=unbounded,
        rest=np.full(len(names), np.nan, np.float32),
        grip=np.flatnonzero(is_gripper),
        dt=dt,
        meaning=meaning,
    )


def _usual_meaning(name: str) -> str:
    """Return what a number of an action means by its name."""
    if name.endswith(".pos"):
        return TARGET
    if name.endswith(".vel"):
        return VELOCITY
    return UNKNOWN
