"""Reaching for places in the air: the hand goes from place to place, turns, and opens or closes on the way.

Experts keep to the paths of their tasks, so a memory of theirs alone is unsure of every other place.

Source: Rolf et al. 2010 (IEEE TAMD 2(3)) for goals in place of random commands.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asm_gym.policies.scripted.base import CLOSE, OPEN, ObservationReader
from asm_gym.policies.scripted.geometry import Vector, move

AROUND = (-0.25, -0.4, -0.12), (0.25, 0.4, 0.25)
"""Range of places, relative to where the hand begins [m]."""
TURNED = 0.2, 0.2, 0.8
"""Greatest turn of the hand about the axes of the world [rad]."""
PACE = 0.45
"""Speed of the hand [action units]."""
ARRIVED, GIVEN_UP = 0.02, 60
"""The hand goes on to the next place this near to one [m], or after so many steps."""


class Aim(NamedTuple):
    """Where a hand began, and where it is going."""

    began: Vector  # (3,) [m]
    upright: Vector  # (3, 3) its orientation then
    place: Vector  # (3,) [m]
    turned: Vector  # (3, 3)
    grip: float  # as commanded
    left: int  # steps until it gives up


class Reaching:
    """A policy that reaches.

    Args:
        env: of one arm under OSC_POSE.
        seed: of the places.
        speed: relative to the usual one.
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int, speed: float = 1.0) -> None:
        self._read, self._rng, self._speed = ObservationReader(env), np.random.default_rng([seed, 2]), PACE * speed

    def predict(
        self,
        observation: Any,
        state: Aim | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Aim]:
        """Return the next action (7,)."""
        hand = self._read.hand(observation)
        if state is None:
            state = self._next(hand.at, hand.turned)
        elif not state.left or np.linalg.norm(state.place - hand.at) < ARRIVED:
            state = self._next(state.began, state.upright)
        action = move(hand, state.place, state.turned, self._speed)
        return np.append(action, state.grip).astype(np.float32), state._replace(left=state.left - 1)

    def _next(self, began: Vector, upright: Vector) -> Aim:
        place = began + self._rng.uniform(*AROUND)
        turn = Rotation.from_rotvec(self._rng.uniform(-1.0, 1.0, 3) * TURNED).as_matrix()
        return Aim(began, upright, place, turn @ upright, float(self._rng.choice([OPEN, CLOSE])), GIVEN_UP)
