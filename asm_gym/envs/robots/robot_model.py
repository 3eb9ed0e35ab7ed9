"""What the package must know of an arm beyond robosuite's own model of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class RobotModel:
    """One arm of robosuite."""

    name: str
    """Robosuite's."""
    has_inverse_kinematics: bool = False
    """Whether robosuite's controller IK_POSE knows the arm."""
    mend: Callable[[Any, str], None] | None = None
    """Mends a loaded model (robosuite's ``MjModel``), in which the names of the robot's parts begin with a prefix."""
