"""Timed perturbations with a ground-truth label: what goes wrong, when, for how long, and how badly."""

from asm_gym.faults.base import Fault
from asm_gym.faults.catalogue import FAULTS, make_fault
from asm_gym.faults.physical import Push, WeakJoint
from asm_gym.faults.sensing import FrozenEncoder

__all__ = ["FAULTS", "Fault", "FrozenEncoder", "Push", "WeakJoint", "make_fault"]
