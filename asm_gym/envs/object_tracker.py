"""The sense of a handled object: a filter over the poses that a tracker measures, and whether it moves with the hand.

    p ← p + (v_c + u) dt        the object goes with its carrier: the hand if it is carried, else the world
    p ← p + α (z - p),  u ← u + β/T (z - p)       z: a measured pose, every T; in the same way for the orientation

u is the velocity beyond that of the carrier. β = 2 (2 - α) - 4 √(1 - α) damps the filter critically; α = 0.15 at 20 Hz
lets motion of up to 0.7 Hz through (-3 dB), velocities of up to 0.4 Hz, and of 5 mm leaves 1.7 mm and 2.3 mm/s. A pose
that is missing is predicted.

Only where fingers move at the object does its carrier become undecided. It is decided once the hand has gone 5 cm since
they stopped: the object is carried if its pose has gone more than 0.35 of that way. From then on it rests in the hand.

Source: Kalata 1984 (IEEE Trans. Aerospace and Electronic Systems 20(2)) for the gains of an α-β filter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asm_gym.compilation import compiled, inner
from asm_gym.envs.mujoco_views import Floats, records

ALPHA = 0.15  # share of a measured deviation that the filter takes over
BETA = 2 * (2 - ALPHA) - 4 * np.sqrt(1 - ALPHA)

# What the last number of the sense says of the object.
NO_POSE = -1.0  # no object is tracked, or not for long enough
RESTS = 0.0  # it does not move with the hand
UNDECIDED = 0.5  # fingers have moved at it
CARRIED = 1.0  # it moves with the hand

SETTLING_POSES = 3  # of an object before it is believed
AT_FINGERS = 0.08  # fingers that move act on an object so near to them [m]
LOST_GRIP = 0.15  # an object so far from the fingers is not carried [m]
SLIPS_AWAY = 0.12  # nor is one with such a velocity relative to the hand [m/s]
DECIDED_AFTER = 0.05  # way of the hand that decides [m]
GOES_ALONG = 0.35  # least share of this way that a carried object has gone
LONGEST_UNDECIDED_S = 3.0  # then nothing has changed [s]

TRACK = np.dtype(
    [
        ("position", np.float64, 3),  # p, in the world [m]
        ("velocity", np.float64, 3),  # u [m/s]
        ("orientation", np.float64, (3, 3)),
        ("turn_rate", np.float64, 3),  # beyond that of the carrier [rad/s]
        ("carrier", np.float64),  # NO_POSE, RESTS, UNDECIDED or CARRIED
        ("carrier_before", np.float64),  # before it was undecided
        ("undecided_s", np.float64),
        ("poses", np.int64),  # measured since the object was taken up
        ("measured", np.float64, 3),  # position of the last pose [m]
        ("unseen_s", np.float64),  # since the last pose
        # of object and hand when the fingers moved last [m]
        ("object_start", np.float64, 3),
        ("hand_start", np.float64, 3),
        ("hand_position", np.float64, 3),  # in the row before [m]
        ("hand_orientation", np.float64, (3, 3)),
    ]
)
"""The track of the object at one hand."""

HAND = np.dtype(
    [
        ("position", np.float64, 3),  # of the point between the fingers, in the world [m]
        ("orientation", np.float64, (3, 3)),
        ("velocity", np.float64, 3),  # [m/s]
        ("turn_rate", np.float64, 3),  # [rad/s]
        ("fingers_move", np.bool_),
    ]
)
"""A hand at a row."""


class Pose(NamedTuple):
    """A measured pose."""

    is_seen: bool
    position: Floats  # (3,) in the world [m]
    orientation: Floats  # (3, 3)


UNSEEN = Pose(is_seen=False, position=np.zeros(3), orientation=np.eye(3))

SENSED = 10  # numbers of the sense: position, velocity, turn rate, and how the object moves


def new_track() -> Any:
    """Return a record of ``TRACK`` of no object."""
    track = records(1, TRACK)[0]
    clear(track)
    return track


def new_hand() -> Any:
    """Return a record of ``HAND``."""
    hand = records(1, HAND)[0]
    hand.orientation[:] = np.eye(3)
    return hand


def views_of(record: Any) -> dict[str, Any]:
    """Return the fields of a record of ``TRACK`` or ``HAND`` by name, each an array (1, ...) that shares its memory."""
    return {name: record.base[name] for name in record.dtype.names}


@compiled
def clear(track: Any) -> None:
    """Forget the object."""
    track.poses = 0
    track.unseen_s = 0.0
    track.carrier = NO_POSE
    track.carrier_before = RESTS
    track.undecided_s = 0.0
    for i in range(3):
        track.velocity[i] = 0.0
        track.turn_rate[i] = 0.0


@compiled
def follow(
    track: Any, hand: Any, elapsed: float, pose: Pose, period: float, numbers: Floats
) -> float:
    """Take the track on by ``elapsed`` [s] and a pose, write its sense (SENSED,), and return its distance [m]."""
    predict(track, hand, elapsed)
    if pose.is_seen:
        correct(track, pose.position, pose.orientation, period)
    decide(track, hand, elapsed)
    write_sense(track, hand, numbers)
    return float(np.sqrt(np.sum((track.position - hand.position) ** 2)))


@compiled
def predict(track: Any, hand: Any, dt: float) -> None:
    """Let the object go on for ``dt`` [s], with the hand where it is carried; note where the hand is now."""
    is_carried = track.carrier == CARRIED
    if is_carried:
        turn = hand.orientation @ track.hand_orientation.T.copy()
        arm = track.position - track.hand_position
        track.position[:] = hand.position + turn @ arm
        track.orientation[:, :] = turn @ track.orientation.copy()
    track.position[:] = track.position + dt * track.velocity
    turned = rotation(dt * track.turn_rate) @ track.orientation.copy()
    track.orientation[:, :] = turned
    track.unseen_s += dt
    track.hand_position[:] = hand.position
    track.hand_orientation[:, :] = hand.orientation


@compiled
def correct(track: Any, position: Floats, orientation: Floats, period: float) -> None:
    """Correct the filter by a measured pose (3,) [m], (3, 3); poses are measured every ``period`` [s]."""
    track.unseen_s = 0.0
    track.poses += 1
    track.measured[:] = position
    if track.poses == 1:
        track.position[:] = position
        track.orientation[:, :] = orientation
        return
    alpha = max(ALPHA, 1.0 / track.poses)
    beta = BETA
    if track.poses <= SETTLING_POSES:
        beta = 0.0
    deviation = position - track.position
    track.position[:] = track.position + alpha * deviation
    track.velocity[:] = track.velocity + beta / period * deviation
    turn = rotation_vector(orientation @ track.orientation.T.copy())
    corrected = rotation(alpha * turn) @ track.orientation.copy()
    track.orientation[:, :] = corrected
    track.turn_rate[:] = track.turn_rate + beta / period * turn


@compiled
def decide(track: Any, hand: Any, dt: float) -> None:
    """Decide whether the object moves with the hand."""
    if track.poses <= SETTLING_POSES:
        return
    if track.carrier == NO_POSE:
        track.carrier = RESTS
    offset = track.position - hand.position
    distance = np.sqrt(np.sum(offset**2))
    if hand.fingers_move and distance < AT_FINGERS:
        if track.carrier != UNDECIDED:
            track.carrier_before = track.carrier
            change_carrier(track, hand, UNDECIDED)
        track.undecided_s = 0.0
        track.object_start[:] = track.position
        track.hand_start[:] = hand.position
    elif track.carrier == UNDECIDED:
        end_doubt(track, hand, dt)
    elif track.carrier == CARRIED:
        slips = np.sqrt(np.sum(track.velocity**2)) > SLIPS_AWAY
        if slips or distance > LOST_GRIP:
            change_carrier(track, hand, RESTS)


@inner
def end_doubt(track: Any, hand: Any, dt: float) -> None:
    """Decide by the ways that hand and object have gone, once that of the hand is long enough."""
    track.undecided_s += dt
    way = hand.position - track.hand_start
    length = np.sqrt(np.sum(way**2))
    if length > DECIDED_AFTER and track.unseen_s == 0.0:
        along = np.sum((track.measured - track.object_start) * way) / length**2
        carrier = RESTS
        if along > GOES_ALONG:
            carrier = CARRIED
        change_carrier(track, hand, carrier)
        if carrier == CARRIED:
            hold(track)
    elif track.undecided_s > LONGEST_UNDECIDED_S:
        change_carrier(track, hand, track.carrier_before)


@inner
def hold(track: Any) -> None:
    """Take an object to be where it was measured, and to rest in the hand: the filter is late by the hand's motion."""
    for i in range(3):
        track.position[i] = track.measured[i]
        track.velocity[i] = 0.0
        track.turn_rate[i] = 0.0


@inner
def change_carrier(track: Any, hand: Any, carrier: float) -> None:
    """Change the carrier; the object's velocity in the world stays what it was."""
    sign = 0.0
    if carrier == CARRIED:
        sign += 1.0
    if track.carrier == CARRIED:
        sign -= 1.0
    if sign != 0.0:
        offset = track.position - hand.position
        swing = cross(hand.turn_rate, offset)
        for i in range(3):
            track.velocity[i] -= sign * (hand.velocity[i] + swing[i])
            track.turn_rate[i] -= sign * hand.turn_rate[i]
    track.carrier = carrier


@compiled
def write_sense(track: Any, hand: Any, numbers: Floats) -> None:
    """Write the sense (SENSED,) of a track; zeros where nothing is tracked."""
    for i in range(SENSED):
        numbers[i] = 0.0
    numbers[SENSED - 1] = track.carrier
    if track.poses == 0:
        return
    offset = track.position - hand.position
    velocity = track.velocity.copy()
    turn_rate = track.turn_rate.copy()
    if track.carrier != CARRIED:
        velocity -= hand.velocity + cross(hand.turn_rate, offset)
        turn_rate -= hand.turn_rate
    to_hand = hand.orientation.T.copy()
    numbers[0:3] = to_hand @ offset
    numbers[3:6] = to_hand @ velocity
    numbers[6:9] = to_hand @ turn_rate


@inner
def cross(a: Any, b: Any) -> Any:
    """Return the cross product (3,)."""
    product = np.empty(3)
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]
    return product


@compiled
def rotation(vector: Floats) -> Floats:
    """Return the rotation (3, 3) of a rotation vector (3,) [rad]."""
    angle = np.sqrt(np.sum(vector**2))
    matrix = np.eye(3)
    if angle < 1e-12:
        return matrix
    axis = vector / angle
    skew = np.zeros((3, 3))
    skew[0, 1] = -axis[2]
    skew[0, 2] = axis[1]
    skew[1, 2] = -axis[0]
    skew -= skew.T.copy()
    return matrix + np.sin(angle) * skew + (1.0 - np.cos(angle)) * (skew @ skew)


@compiled
def rotation_vector(matrix: Floats) -> Floats:
    """Return the rotation vector (3,) [rad] of a rotation (3, 3) of less than half a turn."""
    vector = np.empty(3)
    vector[0] = matrix[2, 1] - matrix[1, 2]
    vector[1] = matrix[0, 2] - matrix[2, 0]
    vector[2] = matrix[1, 0] - matrix[0, 1]
    sine = 0.5 * np.sqrt(np.sum(vector**2))
    cosine = 0.5 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1.0)
    if sine < 1e-12:
        return 0.5 * vector
    return vector * (0.5 * np.arctan2(sine, cosine) / sine)
