"""A tracker of object poses in the simulation, with noise, rate and dropouts of a real one, at each hand.

    pose      5 mm and 1°, 20 times a second
    dropout   2 % of all poses; near the hand it hides the object now and then, for 3 poses in the mean, at most 8
    object    the nearest to the fingers of those within 1.5 m; another one once it has been nearer by 2 cm for 0.15 s
    missing   a pose that is missing for longer than that explains makes all numbers NaN: for 0.75 s where the object
              was near the hand when it was last seen, else for 0.3 s

Draws come from a generator of its own, so that no other sensor reads anything else by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.arms import prefix_of
from asm_gym.envs.mujoco_views import Floats
from asm_gym.envs.object_tracker import (
    CARRIED,
    SENSED,
    UNDECIDED,
    UNSEEN,
    Pose,
    clear,
    follow,
    new_hand,
    new_track,
    rotation,
    views_of,
)
from asm_gym.envs.simulation import Simulation
from asm_gym.spec import CARRIED_CHANNEL, HANDLED, Channel


@dataclass(frozen=True)
class TrackerQuality:
    """How well poses are measured."""

    position_noise: float = 0.005  # standard deviation of each coordinate [m]
    turn_noise: float = float(np.deg2rad(1.0))  # about each axis [rad]
    period: float = 0.05  # between two poses [s]
    dropout: float = 0.02  # share of poses that are missing
    hiding: float = 0.05  # chance that the hand begins to hide an object, at each pose near it
    shown_again: float = 1 / 3  # chance that it shows it again, at each pose
    longest_hidden: int = 8  # poses


QUALITY = TrackerQuality()
# Of the hand's position, velocity and angular velocity, as its own sensors have it.
HAND_NOISE = np.array([3e-4] * 3 + [3e-3] * 3 + [1e-2] * 3 + [0.0])
NEAR_HAND = 0.12  # the hand may hide an object so near to it [m]
NEAR_ESTIMATE = NEAR_HAND + 0.03  # where the filter believes an object that may be so near [m]
LONGEST_HIDDEN_S = 0.75  # longest that a pose is missing of what was near the hand [s]
LONGEST_UNSEEN_S = 0.3  # and of another [s]
GIVEN_UP_S = 2.0  # after so long another object is tracked [s]
VIEW = 1.5  # farthest that an object may be from the hand to be seen [m]
NEARER_BY = 0.02  # another object is nearer from this difference on [m]
NEARER_FOR_S = 0.15  # and for so long [s]
FINGERS_MOVE = 0.02  # from this speed of a finger on [m/s], [rad/s]


class HandledObjects:
    """Tracks the object at each hand of a loaded model.

    Args:
        simulation: of the model.
        noise: scales the noise of poses.
        quality: of the tracker.

    Attributes:
        channels: ten numbers for each hand.
    """

    def __init__(
        self, simulation: Simulation, noise: float, quality: TrackerQuality = QUALITY
    ) -> None:
        model = simulation.model
        is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        self._bodies = model.jnt_bodyid[is_free]
        self._time: float = 0.0
        self._data = simulation.data
        parts = simulation.parts
        self._hands = [
            TrackedHand(simulation, arm, self._bodies, noise, quality) for arm in range(len(parts))
        ]
        channels: list[Channel] = []
        for arm in range(len(parts)):
            channels += _channels(prefix_of(arm, len(parts)), quality)
        self.channels = tuple(channels)

    def begin_episode(self, rng: np.random.Generator) -> None:
        """Forget all objects; later draws come from ``rng``."""
        self._time = float(self._data.time)
        for hand in self._hands:
            hand.begin_episode(rng)

    def read(self) -> Floats:
        """Return the numbers (SENSED × hands,) at the present time."""
        elapsed = float(self._data.time) - self._time
        self._time = float(self._data.time)
        return np.concatenate([hand.read(elapsed) for hand in self._hands])


class TrackedHand:
    """Tracks the object at one hand.

    Attributes:
        target: body of the tracked object; -1 for none. To set it is a fault of the tracker.
    """

    def __init__(
        self,
        simulation: Simulation,
        arm: int,
        bodies: Sequence[int],
        noise: float,
        quality: TrackerQuality,
    ) -> None:
        self._data = simulation.data
        robot, name = simulation.parts[arm]
        self._site = robot.eef_site_id[name]
        self._body = simulation.model.body(robot.robot_model.eef_name[name]).id
        self._motion = simulation.proprioception.last[arm]
        fingers: Any = ()
        if robot.gripper[name].joints:
            fingers = robot._ref_gripper_joint_vel_indexes[name]
        self._fingers = np.array(fingers, np.intp)
        self._bodies = np.array(bodies, np.intp)
        self._noise = noise
        self._quality = quality
        self.track = new_track()
        self._hand = new_hand()
        # Views of their fields, each an array (1, ...): a record's attribute takes microseconds.
        self._tracks = views_of(self.track)
        self._hands = views_of(self._hand)
        self._numbers = np.zeros(SENSED)
        self.begin_episode(np.random.default_rng(0))

    def begin_episode(self, rng: np.random.Generator) -> None:
        """Forget the object."""
        self._rng = rng
        self.target = -1
        self._nearer = -1  # another object that is nearer
        self._nearer_s = 0.0
        self._hidden = 0  # poses for which the hand hides the object
        self._shown = 0  # poses measured since it did
        self._was_near = False  # the object was near the hand since its last pose
        self._pose_due_s = 0.0
        clear(self.track)
        self._look_at_hand()
        self.track.hand_position[:] = self._hand.position
        self.track.hand_orientation[:] = self._hand.orientation

    def read(self, elapsed: float) -> Floats:
        """Return the numbers (SENSED,) after ``elapsed`` [s]; NaN where a pose has been missing for too long."""
        self._look_at_hand()
        distances = self._distances()
        self._choose(distances, elapsed)
        self._pose_due_s -= elapsed
        pose = UNSEEN
        if self._pose_due_s <= 1e-9:
            self._pose_due_s += self._quality.period
            pose = self._measured()
        period = self._quality.period
        distance = follow(self.track, self._hand, elapsed, pose, period, self._numbers)
        if self._is_lost(distance):
            return np.full(SENSED, np.nan)
        return self._numbers + self._noise * HAND_NOISE * self._rng.standard_normal(SENSED)

    def _look_at_hand(self) -> None:
        """Read pose and motion of the hand, which the arm's own sensors measure well."""
        hands = self._hands
        hands["position"][0] = self._data.site_xpos[self._site]
        hands["orientation"][0] = self._data.xmat[self._body].reshape(3, 3)
        twist = self._motion[kernels.VELOCITY]
        hands["velocity"][0] = twist[:3]
        hands["turn_rate"][0] = twist[3:]
        speeds = np.abs(self._data.qvel[self._fingers])
        hands["fingers_move"][0] = (speeds > FINGERS_MOVE).any()

    def _distances(self) -> Floats:
        """Return the distances (N,) of the objects from the fingers [m]."""
        offsets = self._data.xpos[self._bodies] - self._hands["position"]
        return np.sqrt(np.einsum("ni,ni->n", offsets, offsets))

    def _choose(self, distances: Floats, elapsed: float) -> None:
        """Take up the nearest object, if none is tracked or another has been nearer for long enough."""
        if not len(distances):
            return
        nearest = int(distances.argmin())
        body = int(self._bodies[nearest])
        gave_up = self._tracks["unseen_s"][0] > GIVEN_UP_S
        if self.target < 0 or (gave_up and body != self.target):
            if distances[nearest] < VIEW:
                self._take_up(body)
            return
        is_handled = self._tracks["carrier"][0] in (CARRIED, UNDECIDED)
        own = distances[self._bodies == self.target]
        nearer = bool(own.size) and distances[nearest] < own[0] - NEARER_BY
        if is_handled or not nearer or own[0] > VIEW:
            self._nearer_s = 0.0
            return
        if body != self._nearer:
            self._nearer = body
            self._nearer_s = 0.0
        self._nearer_s += elapsed
        if self._nearer_s > NEARER_FOR_S:
            self._take_up(body)

    def _take_up(self, body: int) -> None:
        """Track another object from now on."""
        self.target = body
        self._nearer_s = 0.0
        self._hidden = 0
        self._was_near = False
        clear(self.track)

    def _measured(self) -> Pose:
        """Return a measured pose of the object; ``UNSEEN`` where it is not seen."""
        if self.target < 0:
            return UNSEEN
        quality = self._quality
        position_error = quality.position_noise * self._noise * self._rng.standard_normal(3)
        turn_error = quality.turn_noise * self._noise * self._rng.standard_normal(3)
        is_dropped, begins_to_hide, shows_again = self._rng.random(3)
        position = self._data.xpos[self.target]
        distance = float(np.linalg.norm(position - self._hands["position"][0]))
        self._hide(distance, begins_to_hide, shows_again)
        is_seen = distance < VIEW and not self._hidden and is_dropped >= quality.dropout
        if not is_seen:
            return UNSEEN
        self._shown += 1
        self._was_near = False
        orientation = self._data.xmat[self.target].reshape(3, 3)
        turned = rotation(turn_error) @ orientation
        return Pose(is_seen=True, position=position + position_error, orientation=turned)

    def _hide(self, distance: float, begins_to_hide: float, shows_again: float) -> None:
        """Begin to hide the object by the hand, go on with it or end it, by draws from [0, 1)."""
        quality = self._quality
        if self._hidden:
            self._hidden += 1
            is_over = shows_again < quality.shown_again or self._hidden > quality.longest_hidden
            if is_over or distance > NEAR_HAND:
                self._hidden = 0
                self._shown = 0
        elif distance < NEAR_HAND and self._shown >= 3 and begins_to_hide < quality.hiding:
            self._hidden = 1

    def _is_lost(self, distance: float) -> bool:
        """Return whether the pose of an object has been missing for longer than the hand may hide it.

        ``distance`` [m] is how far from the fingers the filter believes it to be.
        """
        if self.target < 0:
            return False
        if self._tracks["poses"][0] and distance < NEAR_ESTIMATE:
            self._was_near = True
        longest = LONGEST_UNSEEN_S
        if self._was_near or not self._tracks["poses"][0]:
            longest = LONGEST_HIDDEN_S
        return bool(self._tracks["unseen_s"][0] > longest + 1e-9)


def _channels(prefix: str, quality: TrackerQuality) -> list[Channel]:
    """Return the channels of one hand, with the noise that the filter leaves."""
    left = 0.34  # of the noise of poses, by the filter's gains
    rate_left = 0.46  # [1/s]
    axes = ("x", "y", "z")
    return [
        Channel(
            f"{prefix}object_position",
            3,
            "m",
            noise=left * quality.position_noise,
            group=HANDLED,
            elements=axes,
        ),
        Channel(
            f"{prefix}object_velocity",
            3,
            "m/s",
            noise=rate_left * quality.position_noise,
            group=HANDLED,
            elements=axes,
        ),
        Channel(
            f"{prefix}object_turn_rate",
            3,
            "rad/s",
            noise=rate_left * quality.turn_noise,
            group=HANDLED,
            elements=axes,
        ),
        Channel(f"{prefix}{CARRIED_CHANNEL}", 1, group=HANDLED),
    ]
