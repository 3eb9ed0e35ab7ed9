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
from asm_gym.faults.base import FAULTS, Fault, make_fault
from asm_gym.faults.body import CablePull, Collision, HeldByPerson, Payload, Push
from asm_gym.faults.harmless import CameraShift, Lighting, NoisySensors, ObjectFriction, ObjectMass, Touch
from asm_gym.faults.object import Heavy, Missing, Slip, Snatch, Teleport
from asm_gym.faults.sensor import Bias, Delay, Drift, Dropout, Freeze, FrozenEncoder, Noise, Scale, Spikes

__all__ = [
    "FAULTS",
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
    "CameraShift",
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
    "Lighting",
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
    "make_fault",
]
