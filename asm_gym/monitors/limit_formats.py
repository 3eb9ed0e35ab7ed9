"""Limits of healthy motion as the settings of robots and of their drivers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from asm_gym.exceptions import LimitsLacking
from asm_gym.monitors.robot_limits import (
    CURRENT,
    EXTERNAL_TORQUE,
    FORCE,
    HAND_SPEED,
    JOINT_SPEED,
    POSITION,
    TARGET_DISTANCE,
    TORQUE_AT_HAND,
    TURNING_SPEED,
    Limit,
    RobotLimits,
)

DIGITS = 4  # significant


def _lacking(form: str, needed: str, limits: RobotLimits) -> LimitsLacking:
    kinds = tuple(dict.fromkeys(limit.kind for limit in limits.limits))
    return LimitsLacking(form, needed, kinds, limits.senses)


def franka(limits: RobotLimits) -> str:
    """Return the request of franka_ros2's ``SetFullCollisionBehavior``; libfranka's ``setCollisionBehavior`` has the
    same numbers.

    A contact is reported above the lower thresholds, which healthy motion just reaches; above the upper ones, with the
    margin, the robot stops.
    """
    torques = limits.of(EXTERNAL_TORQUE)
    if not torques:
        raise _lacking("franka", "external torques of the joints", limits)
    lines = [_comment(limits)]
    for phase in ("acceleration", "nominal"):
        lines += _thresholds(f"torque_thresholds_{phase}", torques)
    forces = (*limits.of(FORCE)[:3], *limits.of(TORQUE_AT_HAND)[:3])
    if len(forces) < 6:
        lines.append(
            "# force_thresholds: keep yours, force and torque at the hand are not all known"
        )
        return "\n".join(lines)
    for phase in ("acceleration", "nominal"):
        lines += _thresholds(f"force_thresholds_{phase}", forces)
    return "\n".join(lines)


def _thresholds(name: str, limits: Sequence[Limit]) -> list[str]:
    reached = [max(-limit.least, limit.most) for limit in limits]
    allowed = [limit.high for limit in limits]
    return [f"lower_{name}: {_list(reached)}", f"upper_{name}: {_list(allowed)}"]


def ur(limits: RobotLimits) -> str:
    """Return the joint and robot limits of PolyScope's safety configuration, in its units."""
    positions = limits.of(POSITION)
    speeds = limits.of(JOINT_SPEED)
    if not positions or not speeds:
        raise _lacking("ur", "positions and speeds of the joints", limits)
    settings: dict[str, Any] = {
        "joint_position_range_deg": {
            limit.label: [_degrees(limit.low, limit.unit), _degrees(limit.high, limit.unit)]
            for limit in positions
        },
        "joint_maximum_speed_deg_s": {
            limit.label: _degrees(limit.high, limit.unit) for limit in speeds
        },
    }
    hand = limits.of(HAND_SPEED)
    if hand:
        settings["tool_speed_mm_s"] = 1000.0 * math.hypot(*(limit.high for limit in hand[:3]))
    force = limits.of(FORCE)
    if force:
        settings["tool_force_n"] = math.hypot(*(limit.high for limit in force[:3]))
    return f"{_comment(limits)}\n{to_yaml(settings)}"


def lerobot(limits: RobotLimits) -> str:
    """Return ``max_relative_target`` of a LeRobot arm's config, and the current of each motor that is a stall."""
    targets = limits.of(TARGET_DISTANCE)
    if not targets:
        raise _lacking("lerobot", "commands that are target positions", limits)
    settings: dict[str, Any] = {"max_relative_target": {_motor(t): t.high for t in targets}}
    currents = limits.of(CURRENT)
    if currents:
        settings["stall_current"] = {_motor(current): current.high for current in currents}
    return f"{_comment(limits)}\n{to_yaml(settings)}"


def moveit(limits: RobotLimits) -> str:
    """Return ``joint_limits.yaml`` of MoveIt, and the scales of MoveIt Servo's unitless commands."""
    joints = limits.of(JOINT_SPEED)
    hand = limits.of(HAND_SPEED)
    if not joints and not hand:
        raise _lacking("moveit", "speeds of the joints or of the hand", limits)
    settings: dict[str, Any] = {}
    scale: dict[str, float] = {}
    if joints:
        settings["joint_limits"] = {
            limit.label: {"has_velocity_limits": True, "max_velocity": limit.high}
            for limit in joints
        }
        scale["joint"] = min(limit.high for limit in joints)
    if hand:
        scale["linear"] = max(limit.high for limit in hand)
    turning = limits.of(TURNING_SPEED)
    if turning:
        scale["rotational"] = max(limit.high for limit in turning)
    settings["moveit_servo"] = {"scale": scale}
    return f"{_comment(limits)}\n{to_yaml(settings)}"


def _as_json(limits: RobotLimits) -> str:
    return json.dumps(limits.as_dict(), indent=2)


def _as_yaml(limits: RobotLimits) -> str:
    return to_yaml(limits.as_dict())


FORMATS: dict[str, Callable[[RobotLimits], str]] = {
    "franka": franka,
    "ur": ur,
    "lerobot": lerobot,
    "moveit": moveit,
    "yaml": _as_yaml,
    "json": _as_json,
}


def to_yaml(value: Any, indent: int = 0) -> str:
    """Return mappings, lists and plain values as YAML."""
    pad = "  " * indent
    lines = []
    for name, item in value.items():
        if isinstance(item, dict):
            lines.append(f"{pad}{_key(name)}:\n{to_yaml(item, indent + 1)}")
        elif isinstance(item, list) and item and isinstance(item[0], dict):
            parts = [to_yaml(each, indent + 2) for each in item]
            dashed = [f"{pad}  - {part.lstrip()}" for part in parts]
            lines.append("\n".join([f"{pad}{_key(name)}:", *dashed]))
        else:
            lines.append(f"{pad}{_key(name)}: {_scalar(item)}")
    return "\n".join(lines)


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() else json.dumps(name)


def _scalar(value: Any) -> str:
    if isinstance(value, list):
        return _list(value)
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}"
    return json.dumps(value)


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:.{DIGITS}g}' for value in values)}]"


def _comment(limits: RobotLimits) -> str:
    robot = limits.robot or "this robot"
    return f"# healthy motion of {robot} with a margin of {limits.margin:g}"


def _motor(limit: Limit) -> str:
    """Return LeRobot's name of a motor, such as ``gripper`` for ``action[gripper.pos]``."""
    name = limit.label
    if name.endswith("]"):
        name = name[name.index("[") + 1 : -1]
    return name.split(".")[0]


def _degrees(value: float, unit: str) -> float:
    if unit.startswith(("deg", "°")):
        return value
    return math.degrees(value)
