"""An arm of two links that writes letters: encoders, where the hand is, and joint velocities as commands.

    p = l₁ (cos q₁, sin q₁) + l₂ (cos(q₁ + q₂), sin(q₁ + q₂))      q̇ = u

It has no mass: what is asked is what is felt of a movement, and not how hard it is to move. A letter takes 3 s, in rows
of 20 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.scripts.reproduce.handwriting import DT as PEN_DT
from asm_gym.scripts.reproduce.handwriting import NOISE, Letter, written
from asm_gym.spec import MOTOR, Channel, StreamSpec

Floats = NDArray[np.float64]

LINKS = np.array([20.0, 20.0])
"""[cm]"""

START = np.array([16.0, 16.0])
"""Where the hand begins [cm]."""

DT = 0.05
ENCODER_NOISE = 1e-3
"""[rad]"""

SPEC = StreamSpec(
    (
        Channel("encoder", 2, "rad", ENCODER_NOISE, "joints"),
        Channel("hand_position", 2, "cm", NOISE, "hand", ("x", "y")),
        Channel("joint_command", 2, "rad/s", group=MOTOR),
    ),
    DT,
    "two links",
)
ENCODERS, HAND, COMMAND = slice(0, 2), slice(2, 4), slice(4, 6)


def hand(q: Floats) -> Floats:
    """(..., 2) [cm] of angles (..., 2) [rad]."""
    first, both = q[..., 0], q[..., 0] + q[..., 1]
    along = LINKS[0] * np.cos(first) + LINKS[1] * np.cos(both)
    return np.stack([along, LINKS[0] * np.sin(first) + LINKS[1] * np.sin(both)], axis=-1)


def joints(p: Floats) -> Floats:
    """(..., 2) [rad], the elbow below, of hands (..., 2) [cm] within reach."""
    cosine = (np.sum(p**2, axis=-1) - np.sum(LINKS**2)) / (2 * np.prod(LINKS))
    elbow = np.arccos(np.clip(cosine, -1.0, 1.0))
    turned = np.arctan2(LINKS[1] * np.sin(elbow), LINKS[0] + LINKS[1] * np.cos(elbow))
    return np.stack([np.arctan2(p[..., 1], p[..., 0]) - turned, elbow], axis=-1)


def felt(q: Floats, u: Floats, rng: np.random.Generator) -> Floats:
    """Rows (..., 6) of an arm at q (..., 2) that was told u (..., 2)."""
    encoders = q + ENCODER_NOISE * rng.standard_normal(q.shape)
    return np.concatenate([encoders, hand(q) + NOISE * rng.standard_normal(q.shape), u], axis=-1)


def demonstrated(letter: Letter, rng: np.random.Generator) -> Episode:
    """The letter once, written a little differently each time."""
    path = START + np.cumsum(PEN_DT * written(letter, 2, rng).stream[:, 2:].astype(np.float64), axis=0)
    q = joints(np.concatenate([START[None], path]))
    return Episode.from_stream(felt(q[1:], np.diff(q, axis=0) / DT, rng), SPEC, info={"skill": letter.name})


def demonstrations(letters: Sequence[Letter], each: int, rng: np.random.Generator) -> list[Episode]:
    """``each`` of every letter."""
    return [demonstrated(letter, rng) for letter in letters for _ in range(each)]
