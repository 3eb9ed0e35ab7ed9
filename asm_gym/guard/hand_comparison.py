"""Compare the hands of robots with their joints, row by row, in compiled code.

z = (x - x(q)) / σ                       x: the hand as it is sensed; x(q): by the joints' angles, see ``Chain``
m ← m + g (z - m)                        |m| > LIMIT is a contradiction, at whatever rate it came about
q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²      what the angles S at fault must be; q̄, ε: completion, and its error
"""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.compilation import compiled, inner
from asm_gym.detection.hand_speed import Floats
from asm_gym.detection.kinematics import HAND_SIZE, Chain, hand_at
from asm_gym.guard.robot_table import Mask
from asm_gym.spec import StreamSpec

NEEDS = "joint_position", "joint_velocity", "hand_position", "hand_orientation"
"""Channels that a check takes, of each arm."""

MOST_JOINTS = 12  # an arm with more joints is not checked
LIMIT = 6.0  # of |m|, in standard deviations of what the hand's channels say
AVERAGED_S = 0.2  # time over which the running mean is taken [s]
ONE_ROW = 2.0  # no single row takes the mean further than so many times the limit, lest it last
WINDOW = 10  # rows by which the sensor at fault is distinguished from others
DIFFERENCE = 1e-6  # of an angle, by which slopes are taken [rad]
LONGEST_STEP = 0.5  # that an angle makes in an iteration [rad]
ITERATIONS = 8

HAND_GEOMETRY = np.dtype(
    [
        ("joints", np.int64),  # J
        # of the stream: J angles, J speeds, the hand
        ("columns", np.int64, 2 * MOST_JOINTS + HAND_SIZE),
        ("axes", np.float64, (MOST_JOINTS, 3)),  # as in ``Chain``
        ("anchors", np.float64, (MOST_JOINTS, 3)),
        ("pose", np.float64, (3, 3)),
        ("late_s", np.float64),  # the angles are sensed by so much later than the hand [s]
        ("weights", np.float64, HAND_SIZE),  # 1/σ
        ("gain", np.float64),  # g
    ],
    align=True,
)
"""What is known of an arm."""

HAND_STATE = np.dtype(
    [
        ("mean", np.float64, HAND_SIZE),  # m
        ("distance", np.float64),  # |m|; -1 where a number is missing
        ("whole_rows", np.int64),  # since a number was missing
        # the last that were whole, the newest last; 0 before the first
        ("rows", np.float64, (WINDOW, 2 * MOST_JOINTS + HAND_SIZE)),
        ("angles", np.float64, MOST_JOINTS),  # that were believed last [rad]
    ],
    align=True,
)
"""What was seen of an arm in this episode."""


def describe_arm(geometry: Any, chain: Chain, spec: StreamSpec) -> None:
    """Write what is known of an arm into a record of ``HAND_GEOMETRY``."""
    joints = len(chain.axes)
    numbers = np.arange(spec.size)
    channels = [spec.slices[chain.prefix + name] for name in NEEDS]
    columns = np.concatenate([numbers[channel] for channel in channels])
    geometry["joints"] = joints
    geometry["columns"][: len(columns)] = columns
    geometry["axes"][:joints] = chain.axes
    geometry["anchors"][:joints] = chain.anchors
    geometry["pose"] = chain.hand
    geometry["late_s"] = chain.late_s
    noise = spec.noise[columns[-HAND_SIZE:]]
    geometry["weights"] = 1.0 / (chain.noise * noise)
    geometry["gain"] = min(1.0, spec.dt / AVERAGED_S)


@inner
def compare_hands_of(row: Any, geometry: Any, state: Any) -> bool:
    """Take the row (D,) of one robot into the states (arms,) of its hands.

    Returns:
        Whether any of them contradicts its joints.
    """
    contradicts = False
    for arm in range(len(geometry)):
        hand = geometry[arm]
        seen = state[arm]
        if not shift_in(row, hand, seen):
            seen.distance = -1.0
            seen.whole_rows = 0
            continue
        update_mean(hand, seen)
        if seen.distance > LIMIT:
            contradicts = True
        else:
            seen.angles[:] = seen.rows[-1, :MOST_JOINTS]
    return contradicts


@inner
def shift_in(row: Any, hand: Any, seen: Any) -> bool:
    """Keep the numbers of an arm as the newest of its last rows, if all are finite; return whether they are."""
    size = 2 * hand.joints + HAND_SIZE
    for i in range(size):
        if not np.isfinite(row[hand.columns[i]]):
            return False
    for k in range(WINDOW - 1):
        seen.rows[k] = seen.rows[k + 1]
    for i in range(size):
        seen.rows[-1, i] = row[hand.columns[i]]
    seen.whole_rows += 1
    return True


@inner
def update_mean(hand: Any, seen: Any) -> None:
    """Take the newest row into m."""
    joints = hand.joints
    newest = seen.rows[-1]
    speeds = newest[joints : 2 * joints]
    angles = newest[:joints] - hand.late_s * speeds
    z = residual(angles, newest, hand.weights, hand)
    distance = np.sqrt(squared(z))
    longest = ONE_ROW * LIMIT / hand.gain
    share = longest / max(distance, longest)
    for k in range(HAND_SIZE):
        seen.mean[k] += hand.gain * (share * z[k] - seen.mean[k])
    seen.distance = np.sqrt(squared(seen.mean))


@compiled
def residual(angles: Any, row: Any, weights: Any, hand: Any) -> Any:
    """Return z (9,): what angles (J,) leave of the hand that a row says, under weights (9,)."""
    joints = hand.joints
    z = np.empty(HAND_SIZE)
    hand_at(angles, hand.axes[:joints], hand.anchors[:joints], hand.pose, z)
    for k in range(HAND_SIZE):
        z[k] = (row[2 * joints + k] - z[k]) * weights[k]
    return z


@inner
def squared(z: Any) -> float:
    """Return |z|²."""
    total = 0.0
    for number in z:
        total += number * number
    return total


def fit_angles(
    hand: Any, angles: Floats, row: Floats, weights: Floats, free: Mask, error: Floats
) -> tuple[Floats, float]:
    """Return angles (J,), those that are ``free`` (J,) by Gauss and Newton's method, and |z|² of what is left.

    Args:
        hand: a record of ``HAND_GEOMETRY``.
        angles: (J,) to begin with; written to.
        row: its angles, speeds and hand.
        weights: (9,) 1/σ of the hand's numbers, 0 for those that do not count.
        free: (J,) the angles to fit.
        error: (J,) standard deviations of the row's angles [rad]; infinite where nothing is known.
    """
    which = np.flatnonzero(free)
    trust = 1.0 / error[which] ** 2
    slopes = np.empty((len(which), HAND_SIZE))
    z = residual(angles, row, weights, hand)
    for _ in range(ITERATIONS):
        for i, joint in enumerate(which):
            turned = angles.copy()
            turned[joint] += DIFFERENCE
            slopes[i] = (z - residual(turned, row, weights, hand)) / DIFFERENCE
        curvature = slopes @ slopes.T + np.diag(1.0 + trust)
        slope = slopes @ z + trust * (row[which] - angles[which])
        step = np.clip(np.linalg.solve(curvature, slope), -LONGEST_STEP, LONGEST_STEP)
        angles[which] += step
        z = residual(angles, row, weights, hand)
        if np.abs(step).max(initial=0.0) < DIFFERENCE:
            break
    return angles, float(z @ z)
