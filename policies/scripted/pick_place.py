"""Sorts milk, bread, cereal and can into their bins."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import Style
from asm_gym.policies.scripted.carry import CarryExpert, CarryTask
from asm_gym.policies.scripted.geometry import Vector, about_vertical, matrix

_WALL = 0.09  # how high above the bins' floor the fingertips stay clear of the walls' tops with the palm [m]
_REACH = 0.8  # further from its base than this a Panda's hand comes down with its elbow at its stop [m]
_PALM = 0.103, 0.035  # half of a Panda's palm, along which its fingers close and across [m]
_ABOVE = 0.03  # of the fingertips its palm is [m]
_WALLS = 0.1  # how high the walls of the bins are above the bins' origin [m]
_SPARE = 0.01  # so much room beside a wall is enough [m]
_ASKEW = 0.0, 0.2, -0.2, 0.4, -0.4  # how far from square to an object its fingers may close [rad]
_SLOWLY = 0.3  # with which share of its speed a palm comes down that will meet a wall
_CLEAR = 0.04  # how much room a box needs beside it, for half a wall and for how far from its place it is lowered [m]


class PickPlaceExpert(CarryExpert):
    """A scripted expert for PickPlace, with one object or with all four.

    Args:
        env, seed, style: as for ``CarryExpert``.
        things: names of the objects to sort; None for all.
    """

    pace = 0.65

    def __init__(
        self,
        env: gym.Env[Any, Any],
        seed: int | None = None,
        style: Style | None = None,
        things: Collection[str] | None = None,
    ) -> None:
        super().__init__(env, seed, style)
        self.things = things

    def next_task(self, observation: Any) -> CarryTask | None:
        """The nearest object that is not in its bin; None where all are."""
        env = self.robosuite
        hand = self.read(observation, "hand_position")
        left = []
        for i, thing in enumerate(env.objects):
            if env.single_object_mode and i != env.object_id:
                continue
            if self.things is not None and thing.name not in self.things:
                continue
            at, _ = self.pose(observation, thing.name)
            if env.not_in_bin(at, i):
                left.append((float(np.linalg.norm(at - hand)), i))
        if not left:
            return None
        _, nearest = min(left)
        name = env.objects[nearest].name
        at, turned = self.pose(observation, name)
        half = self._half_extents(name)
        grip = max(0.0, half[2] - 0.02)
        place = self._place(env, nearest, half, grip, self._careful)
        if self._careful:  # let go over the walls: stretched out, the arm may stand nearer to one than it should
            place[2] += 0.04
        if not self._careful and at[2] + grip + _ABOVE < env.bin1_pos[2] + _WALLS:
            closing, room = self._beside_walls(half, at, turned, env.bin1_pos, env.bin_size)
        else:
            closing = self._closing(half, at, turned, env.bin1_pos, env.bin_size, self._careful and name == "Can")
            room = _SPARE
        task = CarryTask(
            name=name,
            grip=np.array([0.0, 0.0, grip]),
            closing=closing,
            turns=np.pi,
            clearance=0.1,
            place=place,
            over=0.12,
            headings=self._headings(closing, place - env.robots[0].base_pos) if self._careful else (),
            heading_fit=0.3,
            fit=0.03,
            haste=1.0 if room >= _SPARE else _SLOWLY,
        )
        return self.at_ease(task, observation)

    @staticmethod
    def _headings(closing: Vector, reach: Vector) -> tuple[float, ...]:
        """Where an object may point over its bin so that wide fingers open across the arm's ``reach``."""
        across = float(np.arctan2(reach[0], -reach[1]) - np.arctan2(closing[1], closing[0]))
        return across, across + np.pi

    @staticmethod
    def _closing(half: Vector, at: Vector, turned: Vector, bin_at: Vector, bin_size: Vector, round_: bool) -> Vector:
        """(3,) along which of the object's axes to close: of those it is narrow enough along, away from the walls."""
        axes = _narrow(half)
        if round_:
            axes += [np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)]

        def room(axis: Vector) -> float:
            along = np.abs((turned @ axis)[:2])
            return float(np.min((bin_size[:2] / 2 - np.abs(at[:2] - bin_at[:2])) / np.maximum(along, 1e-6)))

        return max(axes, key=room)

    @staticmethod
    def _beside_walls(
        half: Vector, at: Vector, turned: Vector, bin_at: Vector, bin_size: Vector
    ) -> tuple[Vector, float]:
        """Along which direction (3,) to close, in the object's frame, and what room the palm then has by the walls [m].

        Square to the object where there is room, else as far askew as it takes; square in corners, where nothing helps.
        """
        left = bin_size[:2] / 2 - np.abs(at[:2] - bin_at[:2])
        narrow = _narrow(half)

        def room(closing: Vector) -> float:
            along = np.abs((turned @ closing)[:2])
            return float(np.min(left - _PALM[0] * along - _PALM[1] * along[::-1]))

        ways = [about_vertical(askew) @ axis for askew in _ASKEW for axis in narrow]
        fitting = [closing for closing in ways if room(closing) >= _SPARE]
        best = fitting[0] if fitting else max(narrow, key=room)
        return best, room(best)

    @staticmethod
    def _place(env: Any, compartment: int, half: Vector, grip: float, careful: bool) -> Vector:
        """(3,) where to let go: nearer to the arm, because it is stretched out at the far side of the bins."""
        place = np.array(env.target_bin_placements[compartment], np.float64)
        away = place[:2] - env.robots[0].base_pos[:2]
        if np.linalg.norm(away) > _REACH and not careful:
            # Also away from the nearest wall, and higher: the arm reaches furthest at the height of its shoulder.
            inwards = env.bin2_pos[:2] - place[:2]
            place[:2] += 0.08 * inwards / np.linalg.norm(inwards)
            place[2] += 0.02
        else:
            nearer = (0.07 if careful else 0.04) * away / np.linalg.norm(away)
            if careful and np.linalg.norm(away) <= _REACH:  # a tall box would stand on a wall
                room = np.maximum(np.asarray(env.bin_size[:2]) / 4 - _CLEAR - np.linalg.norm(half[:2]), 0.0)
                nearer = np.clip(nearer, -room, room)
            place[:2] -= nearer
        # Lower, and the palm would stand on a wall.
        place[2] += max(half[2] + 0.015, _WALL - grip)
        return place

    def _half_extents(self, name: str) -> Vector:
        """(3,) half the object's size along its own axes [m]."""
        model = self.env.unwrapped.simulation.model  # type: ignore[attr-defined]
        body = model.body(f"{name}_main").id
        (geom,) = (g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 0)
        turn = matrix(model.geom_quat[geom][[1, 2, 3, 0]])
        half: Vector = np.abs(turn) @ model.geom_aabb[geom, 3:]
        return half


def _narrow(half: Vector) -> list[Vector]:
    """Which of its own horizontal axes (3,) an object of half this size (3,) can be gripped along [m]."""
    return [np.eye(3)[i] for i in (0, 1) if half[i] < 0.035]
