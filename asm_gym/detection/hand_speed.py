"""How much of a motion a hand may make, by its place and direction, and by how near it is to something.

Near a place where healthy hands went at most as fast as g along each axis, a hand may make the share s of a motion v:

    s = max(min(L' / |v|, P / p), min(k, P' / p)),      k = min_i (1.25 g_i + slack_i) / |v_i|

v (6,) is a twist, linear then angular [m/s], [rad/s]; |v| the speed of the hand's fastest point [m/s]. L' is the usual
limit L, up to twice as much the farther away everything is. p is the momentum of the arm on its way to
something [N s], P its limit where no healthy hand was and P' where one was. Downwards,
where what a hand meets is hard, k allows at most L, and at most 1.05 times the speed of healthy hands. In tasks whose
healthy hands point down all the time, k counts only for hands that do so: one that is tilted meets things with other
parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled

Floats = NDArray[np.float64]

CELL_SIZE = np.array([0.04, 0.04, 0.02])  # edges of a cell of the map along x, y and z [m]
AXES = 6  # of a twist
DOWNWARDS = 8  # of the 12 directions, along each axis and then against each: against z

# A hand may be commanded so many times as fast as healthy ones: about 0.8 of it is reached.
ABOVE_HEALTHY = 1.25
ABOVE_HEALTHY_DOWN = 1.05  # the same downwards
SPEED_SLACK = np.array([0.03, 0.03, 0.03, 0.15, 0.15, 0.15])  # and by so much faster [m/s], [rad/s]
DOWN_SLACK = 0.03  # downwards as fast as this, whatever healthy hands did [m/s]
FASTER_WHERE_FREE = 2.0  # where nothing is near a hand may go so many times as fast
LEAST_SPEED = 1e-9  # no speed is divided by less [m/s]


class SpeedLimit(NamedTuple):
    """The limits of the hands' speed, as compiled code reads them."""

    # (arms, x, y, z, 12) see ``HandSpeedMap``; (0, 1, 1, 1, 12) without a map
    grid: NDArray[np.float32]
    low: NDArray[np.int64]  # (4,) arm and place of the grid's first cell
    hand_speed: float  # the usual limit [m/s]
    free_speed: float  # the same where nothing is near [m/s]
    momentum: float  # the limit where no healthy hand was [N s]
    pace_momentum: float  # and where one was [N s]
    least_upright: float  # cosine of the greatest tilt of a hand that goes as fast as healthy ones


NO_SPEED_LIMIT = SpeedLimit(
    grid=np.zeros((0, 1, 1, 1, 2 * AXES), np.float32),
    low=np.zeros(4, np.int64),
    hand_speed=np.inf,
    free_speed=np.inf,
    momentum=np.inf,
    pace_momentum=np.inf,
    least_upright=-1.0,
)


@compiled
def cell_near(grid: NDArray[np.float32], low: NDArray[np.int64], arm: int, place: Floats) -> int:
    """Return the index of the cell of a place (3,) among ``grid.reshape(-1, 12)``; -1 outside, and for NaN."""
    index = 0
    for axis, cells in enumerate(grid.shape[:4]):
        position = float(arm)
        if axis > 0:
            position = np.floor(place[axis - 1] / CELL_SIZE[axis - 1])
        offset = position - low[axis]
        if not 0.0 <= offset < cells:
            return -1
        index = index * cells + int(offset)
    return index


@compiled
def healthy_share(limit: SpeedLimit, arm: int, place: Floats, twist: Floats) -> float:
    """Return k, the share of a twist (6,) that healthy hands near a place (3,) went, slack included."""
    cell = cell_near(limit.grid, limit.low, arm, place)
    fastest = np.zeros(2 * AXES, np.float32)
    if cell >= 0:
        fastest = limit.grid.reshape(-1, 2 * AXES)[cell]

    share = np.inf
    for axis in range(AXES):
        direction = axis
        if twist[axis] <= 0.0:
            direction += AXES
        speed = ABOVE_HEALTHY * fastest[direction] + SPEED_SLACK[axis]
        share = min(share, speed / max(abs(twist[axis]), LEAST_SPEED))

    down = max(ABOVE_HEALTHY_DOWN * fastest[DOWNWARDS], DOWN_SLACK)
    return min(share, min(down, limit.hand_speed) / max(-twist[2], LEAST_SPEED))


@compiled
def usual_share(limit: SpeedLimit, speed: float, soon: float, momentum: float) -> float:
    """Return the share that a hand may have of a motion where no healthy hand was; see ``allowed_share``."""
    allowed = min(limit.free_speed, limit.hand_speed / max(soon, LEAST_SPEED))
    share = allowed / max(speed, LEAST_SPEED)
    return min(share, limit.momentum / max(momentum, LEAST_SPEED))


@compiled
def paced_share(
    limit: SpeedLimit, arm: int, place: Floats, twist: Floats, share: float, momentum: float
) -> float:
    """Return the greater of the usual share of a motion and that of healthy hands; see ``allowed_share``."""
    paced = healthy_share(limit, arm, place, twist)
    return max(share, min(paced, limit.pace_momentum / max(momentum, LEAST_SPEED)))


@compiled
def allowed_share(
    limit: SpeedLimit,
    arm: int,
    place: Floats,
    twist: Floats,
    speed: float,
    soon: float,
    momentum: float,
) -> float:
    """Return s, the share that a hand may have of a motion; above 1 where it may go faster.

    Args:
        limit: what the hand may do.
        arm: index of its arm.
        place: (3,) of the hand [m].
        twist: (6,) of the hand, linear and angular [m/s], [rad/s].
        speed: of the hand's fastest point [m/s].
        soon: how soon it touches something, 1 for at once and 0 for nothing that is near.
        momentum: of the arm on its way to something [N s]; 0 where it is not known.
    """
    share = usual_share(limit, speed, soon, momentum)
    if limit.grid.size == 0:
        return share
    return paced_share(limit, arm, place, twist, share, momentum)
