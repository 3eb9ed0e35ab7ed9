"""How contacts compare with what ISO/TS 15066 lets a robot do to a person.

Source: ISO/TS 15066:2016, Table A.2, now in ISO 10218-2:2025: the largest permissible forces of a quasi-static
contact, by the region of the body, and twice that for a transient one, that is within 0.5 s; for the head no transient
one is given. A comparison of forces in a simulation, and no claim of conformity, which asks for pressure and for
measurements on the real robot as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.evaluation.statistics import Floats, Share
from asm_gym.validation import check_choice

QUASI_STATIC = {
    "skull": 130.0,
    "face": 65.0,
    "neck": 150.0,
    "back": 210.0,
    "chest": 140.0,
    "abdomen": 110.0,
    "pelvis": 180.0,
    "upper arm": 150.0,
    "lower arm": 160.0,
    "hand": 140.0,
    "thigh": 220.0,
    "lower leg": 130.0,
}
"""The largest permissible force on each region [N]."""

TRANSIENT = 2.0
"""Times as much is permissible within the first ``TRANSIENT_S``, except on the head."""

HEAD = ("skull", "face")

TRANSIENT_S = 0.5
"""How long a contact counts as transient [s]."""

TOUCHING = 1.0
"""A contact begins where the force exceeds this [N]."""


class ContactForce(NamedTuple):
    """The greatest force of a contact [N]; 0 where there was none."""

    transient: float
    lasting: float


def contact_force(forces: Floats, dt: float) -> ContactForce:
    """Of an episode, from the forces in each step since the onset (T,) [N]."""
    felt = np.nan_to_num(np.asarray(forces, np.float64))
    touching = np.flatnonzero(felt > TOUCHING)
    if not touching.size:
        return ContactForce(0.0, 0.0)
    first, steps = int(touching[0]), round(TRANSIENT_S / dt)
    since = felt[first:]
    return ContactForce(float(since[:steps].max()), float(since[steps:].max(initial=0.0)))


def within_limits(contacts: Sequence[ContactForce], region: str = "hand") -> Share:
    """The share of contacts under both limits of a region of the body.

    Raises:
        ValueError: an unknown region; the message lists those that exist.
    """
    check_choice("region of the body", region, QUASI_STATIC)
    limit, more = QUASI_STATIC[region], 1.0 if region in HEAD else TRANSIENT
    return Share.of([c.transient <= more * limit and c.lasting <= limit for c in contacts])
