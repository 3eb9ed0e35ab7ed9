"""Sorts milk, bread, cereal and can into their bins."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask
from asm_gym.policies.scripted.geometry import Vector, about_vertical, matrix

_WALL = 0.09  # how high above the bins' floor the fingertips stay clear of the walls' tops with the palm [m]
_REACH = (
    0.8  # further from its base than this a Panda's hand comes down with its elbow at its stop [m]
)
_PALM = 0.103, 0.035  # half of a Panda's palm, along which its fingers close and across [m]
_ABOVE = 0.03  # of the fingertips its palm is [m]
_WALLS = 0.1  # how high the walls of the bins are above the bins' origin [m]
_SPARE = 0.01  # so much room beside a wall is enough [m]
_ASKEW = 0.0, 0.2, -0.2, 0.4, -0.4  # how far from square to an object its fingers may close [rad]
_SLOWLY = 0.3  # with which share of its speed a palm comes down that will meet a wall
_CLEAR = 0.04  # how much room a box needs beside it, for half a wall and for how far from its place it is lowered [m]


class PickPlaceExpert(CarryExpert):
    """A scripted expert for PickPlace, with one object or with all four."""

    pace = 0.65

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the nearest object that is not in its bin; None where all are."""
        env, hand = self.robosuite, self.read(observation, "hand_position")
        left = []
        for i, thing in enumerate(env.objects):
            if env.single_object_mode and i != env.object_id:
                continue
            at, _ = self.read.pose(observation, thing.name)
            if env.not_in_bin(at, i):
                left.append((float(np.linalg.norm(at - hand)), i))
        if not left:
            return None
        _, nearest = min(left)
        name = env.objects[nearest].name
        at, turned = self.read.pose(observation, name)
        half = self._half_extents(name)
        grip = max(0.0, half[2] - 0.02)
        place = self._place(env, nearest, half, grip)
        to_walls = env.bin_size[:2] / 2 - np.abs(at[:2] - env.bin1_pos[:2])
        if not self._careful and at[2] + grip + _ABOVE < env.bin1_pos[2] + _WALLS:
            closing, room = beside_walls(half, turned, to_walls)
        else:
            closing, room = (
                _closing(half, turned, to_walls, self._careful and name == "Can"),
                _SPARE,
            )
        headings: tuple[float, ...] = ()
        if self._careful:  # over its bin, wide fingers open across the arm's reach
            reach = place - env.robots[0].base_pos
            across = float(np.arctan2(reach[0], -reach[1]) - np.arctan2(closing[1], closing[0]))
            headings = across, across + np.pi
        task = CarryTask(
            name=name,
            grip=np.array([0.0, 0.0, grip]),
            closing=closing,
            turns=np.pi,
            clearance=0.1,
            place=place,
            over=0.12,
            headings=headings,
            heading_fit=0.3,
            fit=0.03,
            haste=1.0 if room >= _SPARE else _SLOWLY,
        )
        return self.at_ease(task, observation)

    def _place(self, env: Any, compartment: int, half: Vector, grip: float) -> Vector:
        """Return where (3,) to let go: nearer to the arm, because it is stretched out at the far side of the bins."""
        place = np.array(env.target_bin_placements[compartment], np.float64)
        away = place[:2] - env.robots[0].base_pos[:2]
        far = np.linalg.norm(away) > _REACH
        if far and not self._careful:
            # Also away from the nearest wall, and higher: the arm reaches furthest at the height of its shoulder.
            inwards = env.bin2_pos[:2] - place[:2]
            place[:2] += 0.08 * inwards / np.linalg.norm(inwards)
            place[2] += 0.02
        else:
            nearer = (0.07 if self._careful else 0.04) * away / np.linalg.norm(away)
            if self._careful and not far:  # a tall box would stand on a wall
                room = np.maximum(
                    np.asarray(env.bin_size[:2]) / 4 - _CLEAR - np.linalg.norm(half[:2]), 0.0
                )
                nearer = np.clip(nearer, -room, room)
            place[:2] -= nearer
        # Lower, and the palm would stand on a wall; stretched out, another arm may stand nearer to one than it should.
        place[2] += max(half[2] + 0.015, _WALL - grip)
        if self._careful:
            place[2] += 0.04
        return place

    def _half_extents(self, name: str) -> Vector:
        """Return half (3,) the object's size along its own axes [m]."""
        model = self.inner.simulation.model
        body = model.body(f"{name}_main").id
        (geom,) = (
            g
            for g in range(model.ngeom)
            if model.geom_bodyid[g] == body and model.geom_group[g] == 0
        )
        turn = matrix(model.geom_quat[geom][[1, 2, 3, 0]])
        return np.abs(turn) @ model.geom_aabb[geom, 3:]


def _closing(half: Vector, turned: Vector, to_walls: Vector, round_: bool) -> Vector:
    """Return along which of the object's axes (3,) to close: of the narrow ones, away from the walls."""
    axes = _narrow(half)
    if round_:
        axes += [np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)]
    return max(
        axes,
        key=lambda axis: float(np.min(to_walls / np.maximum(np.abs((turned @ axis)[:2]), 1e-6))),
    )


def beside_walls(half: Vector, turned: Vector, to_walls: Vector) -> tuple[Vector, float]:
    """Return along which direction (3,) to close, in the object's frame, and the palm's room by the walls then [m].

    Square to the object where there is room, else as far askew as it takes; square in corners, where nothing helps.
    ``half`` (3,) is half its size [m], ``to_walls`` (2,) the way from its middle to the nearer walls of the bin [m].
    """
    narrow = _narrow(half)

    def room(closing: Vector) -> float:
        along = np.abs((turned @ closing)[:2])
        return float(np.min(to_walls - _PALM[0] * along - _PALM[1] * along[::-1]))

    ways = [about_vertical(askew) @ axis for askew in _ASKEW for axis in narrow]
    fitting = [closing for closing in ways if room(closing) >= _SPARE]
    best = fitting[0] if fitting else max(narrow, key=room)
    return best, room(best)


def _narrow(half: Vector) -> list[Vector]:
    """Return those horizontal axes (3,) along which an object of half this size (3,) [m] can be gripped."""
    return [np.eye(3)[i] for i in (0, 1) if half[i] < 0.035]
