"""What the package must know of an arm beyond robosuite's own model of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from asm_gym.detection.contact_limits import ContactLimits

PERSON_AND_TABLE = ContactLimits(wrist_force=80.0, external_torque=40.0, hand_speed=0.15)
"""Limits of an arm beside people: below the 140 N and 280 N of ISO/TS 15066 for a hand, and above what healthy motion
of six tasks reaches, 71 N and 34 N m; at that speed a first blow on a table stays below 280 N."""


@dataclass(frozen=True)
class RobotModel:
    """One arm of robosuite."""

    name: str
    """Robosuite's."""
    contact_limits: ContactLimits = PERSON_AND_TABLE
    """How hard it may press and how fast its hand may go, until a memory has learned more of it [N], [N m], [m/s].

    Its joint stops are those of robosuite's model, which the channels of its stream name (``Channel.stops``)."""
    has_inverse_kinematics: bool = False
    """Whether robosuite's controller IK_POSE knows the arm."""
    mend: Callable[[Any, str], None] | None = None
    """Mends a loaded model (robosuite's ``MjModel``), in which the names of the robot's parts begin with a prefix."""
