"""Faults by name."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from asm_gym.choices import check_choice
from asm_gym.faults import action, actuator, body, harmless, object, sensor
from asm_gym.faults.base import Fault

_EVERY: tuple[type[Fault], ...] = (
    body.Push,
    body.Payload,
    body.Collision,
    body.CablePull,
    body.HeldByPerson,
    actuator.WeakJoint,
    actuator.StuckJoint,
    actuator.JointFriction,
    actuator.Backlash,
    actuator.GripperOpens,
    actuator.WeakGripper,
    sensor.Bias,
    sensor.Drift,
    sensor.Scale,
    sensor.Noise,
    sensor.Spikes,
    sensor.Dropout,
    sensor.Freeze,
    sensor.Delay,
    sensor.FrozenEncoder,
    action.ActionDelay,
    action.ActionDrop,
    action.ActionBias,
    action.ActionRepeat,
    action.SignFlip,
    action.ActionNoise,
    action.Adversary,
    object.Slip,
    object.Snatch,
    object.Teleport,
    object.Missing,
    object.Heavy,
    harmless.Touch,
    harmless.ObjectMass,
    harmless.ObjectFriction,
    harmless.NoisySensors,
    harmless.Lighting,
    harmless.CameraShift,
)

FAULTS: dict[str, type[Fault]] = {re.sub(r"(?<!^)(?=[A-Z])", "_", f.__name__).lower(): f for f in _EVERY}
"""Every fault and harmless variation by its name in lower case: ``weak_joint`` is ``WeakJoint``."""


def make_fault(name: str, **parameters: Any) -> Fault:
    """The fault called ``name``.

    Raises:
        ValueError: an unknown name or parameter; the message lists what exists.
    """
    check_choice("fault", name, FAULTS)
    known = [f.name for f in dataclasses.fields(FAULTS[name])]
    for parameter in parameters:
        if parameter not in known:
            raise ValueError(f"fault {name!r} has no parameter {parameter!r}; it has: {', '.join(known)}")
    return FAULTS[name](**parameters)
