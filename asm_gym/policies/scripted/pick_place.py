"""Sorts milk, bread, cereal and can into their bins."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask
from asm_gym.policies.scripted.geometry import (
    UP,
    Pose,
    Vector,
    length,
    rotation_about_vertical,
    rotation_from_quaternion,
)

# Above the bins' floor, so high the fingertips keep the palm off the walls' tops [m].
LOWEST_FINGERTIPS = 0.09
REACH_OF_PANDA = 0.8  # further from its base a hand comes down with its elbow at its stop [m]
PALM_ALONG = 0.103  # half of a Panda's palm, along which its fingers close [m]
PALM_ACROSS = 0.035  # and across [m]
PALM_HEIGHT = 0.03  # of a Panda's palm above the fingertips [m]
WALL_HEIGHT = 0.1  # of the walls above the bins' origin [m]
ENOUGH_ROOM = 0.01  # so much room beside a wall is enough [m]
ASKEW = (0.0, 0.2, -0.2, 0.4, -0.4)  # how far from square to an object fingers may close [rad]
SLOWLY = 0.3  # with which share of its speed a palm comes down that will meet a wall
NARROW = 0.035  # half of what fits between the fingers [m]
# Room that a box needs beside it, for half a wall and for how far from its place it is lowered [m].
CLEAR = 0.04
DIAGONALS = (
    np.array([1.0, 1.0, 0.0]) / np.sqrt(2),
    np.array([1.0, -1.0, 0.0]) / np.sqrt(2),
)


class Closing(NamedTuple):
    """How to close the fingers on an object in a bin."""

    along: Vector  # (3,) direction in the object's frame
    room: float  # of the palm beside the walls [m]


class PickPlaceExpert(CarryExpert):
    """A scripted expert for PickPlace, with one object or with all four."""

    pace = 0.65

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the nearest object that is not in its bin; None where all are."""
        number = self._nearest(observation)
        if number is None:
            return None
        name = self.robosuite.objects[number].name
        thing = self.read.pose(observation, name)
        half_size = self._half_extents(name)
        grip = max(0.0, half_size[2] - 0.02)
        closing = self._closing(name, thing, half_size, grip)
        place = self._place(number, half_size, grip)
        haste = 1.0
        if closing.room < ENOUGH_ROOM:
            haste = SLOWLY
        task = CarryTask(
            name=name,
            grip=grip * UP,
            closing=closing.along,
            turns=np.pi,
            clearance=0.1,
            place=place,
            over=0.12,
            headings=self._headings(place, closing.along),
            heading_fit=0.3,
            fit=0.03,
            haste=haste,
        )
        return self.at_ease(task, observation)

    def _nearest(self, observation: Any) -> int | None:
        """Return the number of the object nearest to the hand that is not in its bin."""
        env = self.robosuite
        hand = self.read(observation, "hand_position")
        distances = {}
        for number, thing in enumerate(env.objects):
            if env.single_object_mode and number != env.object_id:
                continue
            at = self.read(observation, f"{thing.name}_pos")
            if env.not_in_bin(at, number):
                distances[number] = length(at - hand)
        return min(distances, key=distances.__getitem__, default=None)

    def _closing(self, name: str, thing: Pose, half_size: Vector, grip: float) -> Closing:
        """Return how to close on an object, of half this size (3,), that is held ``grip`` above its middle [m]."""
        env = self.robosuite
        from_middle = thing.position[:2] - env.bin1_pos[:2]
        to_walls = env.bin_size[:2] / 2 - np.abs(from_middle)
        palm = thing.position[2] + grip + PALM_HEIGHT
        if not self.is_careful and palm < env.bin1_pos[2] + WALL_HEIGHT:
            return beside_walls(half_size, thing.orientation, to_walls)

        # Of the narrow axes that one which lies furthest from the walls.
        axes = _graspable_axes(half_size)
        if self.is_careful and name == "Can":
            axes += DIAGONALS
        along = max(axes, key=lambda axis: _way_to_wall(thing.orientation @ axis, to_walls))
        # The palm stays above the walls; only a Panda's is compared with them.
        return Closing(along, room=ENOUGH_ROOM)

    def _headings(self, place: Vector, closing: Vector) -> tuple[float, ...]:
        """Return headings for which, over its bin, wide fingers open across the arm's reach [rad]."""
        if not self.is_careful:
            return ()
        reach = place - self.robosuite.robots[0].base_pos
        sideways = np.arctan2(reach[0], -reach[1])  # at right angles to the reach
        heading = float(sideways - np.arctan2(closing[1], closing[0]))
        return (heading, heading + np.pi)

    def _place(self, number: int, half_size: Vector, grip: float) -> Vector:
        """Return where (3,) to let go.

        That is off the compartment's middle: towards the arm, or beyond a Panda's reach towards the
        middle of the bins.
        """
        env = self.robosuite
        place = np.array(env.target_bin_placements[number], np.float64)
        away = place[:2] - env.robots[0].base_pos[:2]
        is_far = length(away) > REACH_OF_PANDA
        if is_far and not self.is_careful:
            # Away from the outer walls, and higher: the arm reaches furthest at shoulder height.
            inwards = env.bin2_pos[:2] - place[:2]
            place[:2] += 0.08 * inwards / length(inwards)
            place[2] += 0.02
        else:
            place[:2] -= self._shift_towards_arm(away, half_size)

        # Lower, and the palm would stand on a wall.
        place[2] += max(half_size[2] + 0.015, LOWEST_FINGERTIPS - grip)
        if self.is_careful:  # stretched out, another arm may stand nearer to a wall than it should
            place[2] += 0.04
        return place

    def _shift_towards_arm(self, away: Vector, half_size: Vector) -> Vector:
        """Return how far (2,) to come back towards the arm from a place that is ``away`` (2,) from its base [m]."""
        distance = length(away)
        if not self.is_careful:
            return 0.04 * away / distance
        nearer = 0.07 * away / distance
        if distance > REACH_OF_PANDA:
            return nearer
        # Further, a tall box would stand on a wall.
        half_compartment = np.asarray(self.robosuite.bin_size[:2]) / 4
        room = np.maximum(half_compartment - CLEAR - length(half_size[:2]), 0.0)
        return np.clip(nearer, -room, room)

    def _half_extents(self, name: str) -> Vector:
        """Return half (3,) the object's size along its own axes [m]."""
        model = self.inner.simulation.model
        body = model.body(f"{name}_main").id
        is_shape = (model.geom_bodyid == body) & (model.geom_group == 0)
        (geom,) = np.flatnonzero(is_shape)
        turn = rotation_from_quaternion(model.geom_quat[geom][[1, 2, 3, 0]])
        return np.abs(turn) @ model.geom_aabb[geom, 3:]


def beside_walls(half_size: Vector, turned: Vector, to_walls: Vector) -> Closing:
    """Return how to close on an object in a bin, and the room that the palm has then.

    Square to the object where there is room, else as far askew as it takes; square in corners,
    where nothing helps.

    Args:
        half_size: (3,) half the object's size [m].
        turned: (3, 3) its orientation.
        to_walls: (2,) the way from its middle to the nearer walls of the bin [m].
    """
    axes = _graspable_axes(half_size)
    for angle, axis in product(ASKEW, axes):
        along = rotation_about_vertical(angle) @ axis
        room = _room(turned @ along, to_walls)
        if room >= ENOUGH_ROOM:
            return Closing(along, room)
    widest = max(axes, key=lambda axis: _room(turned @ axis, to_walls))
    return Closing(widest, _room(turned @ widest, to_walls))


def _room(along: Vector, to_walls: Vector) -> float:
    """Return the palm's room beside the walls when the fingers close ``along`` (3,) [m]."""
    share = np.abs(along[:2])
    share_across = share[::-1]  # of the direction at right angles to it
    room = to_walls - PALM_ALONG * share - PALM_ACROSS * share_across
    return float(np.min(room))


def _way_to_wall(along: Vector, to_walls: Vector) -> float:
    """Return how far it is ``along`` (3,) to the nearest wall [m]."""
    share = np.maximum(np.abs(along[:2]), 1e-6)
    return float(np.min(to_walls / share))


def _graspable_axes(half_size: Vector) -> list[Vector]:
    """Return those horizontal axes (3,) along which an object of half this size (3,) [m] can be gripped."""
    return [np.eye(3)[axis] for axis in (0, 1) if half_size[axis] < NARROW]
