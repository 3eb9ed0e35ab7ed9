"""Faults by name."""

from __future__ import annotations

import dataclasses
from typing import Any

from asm_gym.faults.base import Fault
from asm_gym.faults.physical import Push, WeakJoint
from asm_gym.faults.sensing import FrozenEncoder

FAULTS: dict[str, type[Fault]] = {"push": Push, "weak_joint": WeakJoint, "frozen_encoder": FrozenEncoder}


def make_fault(name: str, **parameters: Any) -> Fault:
    """The fault called ``name``.

    Raises:
        ValueError: an unknown name or parameter; the message lists what exists.
    """
    if name not in FAULTS:
        raise ValueError(f"unknown fault {name!r}; known: {', '.join(FAULTS)}")
    known = [f.name for f in dataclasses.fields(FAULTS[name])]
    for parameter in parameters:
        if parameter not in known:
            raise ValueError(f"fault {name!r} has no parameter {parameter!r}; it has: {', '.join(known)}")
    return FAULTS[name](**parameters)
