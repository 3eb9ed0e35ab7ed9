"""Timed perturbations with a ground-truth label: what goes wrong, when, for how long, and how badly."""

from asm_gym.faults.action import (
    ActionBias,
    ActionDelay,
    ActionDrop,
    ActionNoise,
    ActionRepeat,
    ActionScale,
    Adversary,
    SignFlip,
)
from asm_gym.faults.actuator import Backlash, GripperOpens, JointFriction, StuckJoint, WeakGripper, WeakJoint
from asm_gym.faults.base import Fault
from asm_gym.faults.body import CablePull, Collision, HeldByPerson, Payload, Push, Touch
from asm_gym.faults.object import Heavy, Missing, ObjectFriction, ObjectMass, Slip, Snatch, Teleport
from asm_gym.faults.sensor import (
    Bias,
    Delay,
    Drift,
    Dropout,
    Freeze,
    FrozenEncoder,
    Noise,
    NoisySensors,
    Scale,
    Spikes,
)

__all__ = [
    "ActionBias",
    "ActionDelay",
    "ActionDrop",
    "ActionNoise",
    "ActionRepeat",
    "ActionScale",
    "Adversary",
    "Backlash",
    "Bias",
    "CablePull",
    "Collision",
    "Delay",
    "Drift",
    "Dropout",
    "Fault",
    "Freeze",
    "FrozenEncoder",
    "GripperOpens",
    "Heavy",
    "HeldByPerson",
    "JointFriction",
    "Missing",
    "Noise",
    "NoisySensors",
    "ObjectFriction",
    "ObjectMass",
    "Payload",
    "Push",
    "Scale",
    "SignFlip",
    "Slip",
    "Snatch",
    "Spikes",
    "StuckJoint",
    "Teleport",
    "Touch",
    "WeakGripper",
    "WeakJoint",
]
