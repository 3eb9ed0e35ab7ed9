"""How fast healthy hands went, by place and direction, and how much of a motion a hand may make there.

At a place where healthy hands went at most as fast as g along each axis, a hand may make the share s of a motion v:

    s = max(min(L / |v|, P / (m |v|)), k),      k = min_i (1.25 g_i + slack_i) / |v_i|

v (6,) is a twist, linear then angular [m/s], [rad/s]; |v| the speed of the hand's fastest point [m/s], and L its usual
limit; m the arm's reflected mass along the motion [kg], and P the limit of its momentum [N s]. Downwards, where what a
hand meets is hard, k allows at most L, and at most 1.05 times the speed of healthy hands.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from asm_gym.compilation import compiled
from asm_gym.data.episode import Episode
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating[Any]]

CELL_SIZE = np.array([0.04, 0.04, 0.02])  # edges of a cell along x, y and z [m]
FARTHEST_CELL = 100  # hands that are more cells away from the origin are not learned of

# Columns of a map's cells.
ARM_AND_PLACE = slice(0, 4)  # the arm, and the cell's place along x, y and z in cells
FASTEST = slice(4, 16)  # greatest speed along each axis of the twist, then against each [m/s], [rad/s]
COLUMNS = 16
DOWN = 8  # of ``FASTEST``: against the z axis

OWN_MAP_EPISODES = 40  # a task with so many healthy episodes has a map of its own: elsewhere others may go down fast
FASTEST_EPISODES = 0.05  # this share of the episodes that visit a cell, the fastest, does not count there
ODD_EPISODES = 0.002  # and this share of all episodes: of hundreds, an odd one sets no speed where few others go

ABOVE_HEALTHY = 1.25  # a hand may be commanded to go so many times as fast as healthy ones: it reaches about 0.8 of it
ABOVE_HEALTHY_DOWN = 1.05  # the same downwards
SLACK = np.array([0.03, 0.03, 0.03, 0.15, 0.15, 0.15])  # and by so much faster [m/s], [rad/s]
DOWN_SLACK = 0.03  # downwards a hand may always go as fast as this, if the usual limit allows it [m/s]
STILL = 1e-9  # no speed is divided by less [m/s]

MOMENTUM = 1.5  # limit along a hand's motion where no healthy hand was: 10 kg at the usual speed [N s]
MOMENTUM_OF_KNOWN_TASK = 1.35  # the same in a task with a map of its own [N s]


class SpeedLimit(NamedTuple):
    """The limits of the hands' speed, as compiled code reads them."""

    grid: NDArray[np.float32]  # (arms, x, y, z, 12) ``FASTEST`` of each cell; (0, 1, 1, 1, 12) without a map
    low: NDArray[np.int64]  # (4,) arm and place of the grid's first cell
    hand_speed: float  # the usual limit [m/s]
    momentum: float  # the limit where no healthy hand was [N s]


class HandSpeedMap:
    """How fast healthy hands went, by place and direction.

    Args:
        cells: (N, 16) see ``ARM_AND_PLACE`` and ``FASTEST``. The greatest counts where a place is given twice.
        momentum: limit of an arm's momentum along its hand's motion, where no healthy hand was [N s].

    Raises:
        ValueError: cells of another shape, places that are too far away, or negative speeds.

    Attributes:
        grid: (arms, x, y, z, 12) the greatest speeds of healthy hands in each cell and its neighbours.
        low: (4,) arm and place of the grid's first cell.
    """

    def __init__(self, cells: AnyFloats, momentum: float = MOMENTUM) -> None:
        if not _are_cells(cells):
            raise ValueError(
                f"pace must be rows of {COLUMNS} numbers, places within {FARTHEST_CELL} cells, got {cells.shape}"
            )
        self.cells = cells
        self.momentum = momentum

        places = cells[:, ARM_AND_PLACE].astype(np.int64)
        self.low = places.min(axis=0) - (0, 1, 1, 1)
        shape = places.max(axis=0) - self.low + (1, 2, 2, 2)
        grid = np.zeros((*shape, 12), np.float32)
        np.maximum.at(grid, tuple((places - self.low).T), cells[:, FASTEST])

        # A hand may go as fast as others did in a cell beside its own; downwards, only in one at the same height.
        self.grid = maximum_filter(grid, (1, 3, 3, 3, 1))
        self.grid[..., DOWN] = maximum_filter(grid[..., DOWN], (1, 3, 3, 1))

    @classmethod
    def of(cls, cells_by_task: Mapping[str, AnyFloats], task: str = "") -> Self | None:
        """Return the map of a task; that of all tasks where it has none of its own, None where there are no cells."""
        if task and task in cells_by_task:
            return cls(cells_by_task[task], MOMENTUM_OF_KNOWN_TASK)
        if not cells_by_task:
            return None
        return cls(np.concatenate(list(cells_by_task.values())))

    @classmethod
    def by_task(cls, episodes: Sequence[Episode], spec: StreamSpec) -> dict[str, NDArray[np.float32]]:
        """Return the cells of each task with ``OWN_MAP_EPISODES``, and of all others under an empty name."""
        counts = Counter(map(_task_of, episodes))
        streams: defaultdict[str, list[NDArray[np.float32]]] = defaultdict(list)
        for episode in episodes:
            task = _task_of(episode)
            if counts[task] < OWN_MAP_EPISODES:
                task = ""
            streams[task].append(episode.stream)

        learned = {task: cls.learned(own, spec) for task, own in streams.items()}
        return {task: cells for task, cells in learned.items() if cells is not None}

    @staticmethod
    def learned(streams: Sequence[AnyFloats], spec: StreamSpec) -> NDArray[np.float32] | None:
        """Return the cells (N, 16) of healthy streams (T, D); None where these do not tell how hands move."""
        arms = _hand_columns(spec)
        if not arms:
            return None
        cells = [_arm_cells(arm, _motions(streams, columns), len(streams)) for arm, columns in arms.items()]
        return np.concatenate(cells).astype(np.float32)

    def fastest_near(self, arm: int, place: Floats) -> AnyFloats:
        """Return (2, 6) the greatest twist near a place (3,), along the axes of the world and against them; else 0."""
        cell = cell_near(self.grid, self.low, arm, place)
        if cell < 0:
            return np.zeros((2, 6))
        return self.grid.reshape(-1, 2, 6)[cell]


def _are_cells(cells: AnyFloats) -> bool:
    if cells.ndim != 2 or cells.shape[1] != COLUMNS or not len(cells):
        return False
    near = np.abs(cells[:, ARM_AND_PLACE]) <= FARTHEST_CELL
    return bool(near.all() and (cells[:, 0] >= 0).all() and (cells[:, FASTEST] >= 0).all())


def _task_of(episode: Episode) -> str:
    if episode.label is None:
        return ""
    return episode.label.task


def _hand_columns(spec: StreamSpec) -> dict[int, NDArray[np.intp]]:
    """Return (9,) the columns of place, velocity and turn of each arm's hand, as far as they are sensed, by arm."""
    columns = np.arange(spec.size)
    hands = [c.name.removesuffix("position") for c in spec.channels if c.name.endswith("hand_position")]
    found = {}
    for arm, hand in enumerate(hands):
        names = (f"{hand}position", f"{hand}velocity", f"{hand}angular_velocity")
        if all(name in spec.slices for name in names):
            found[arm] = np.concatenate([columns[spec.slices[name]] for name in names])
    return found


def _motions(streams: Sequence[AnyFloats], columns: NDArray[np.intp]) -> Floats:
    """Return (T, 10) the rows of all streams: index of the episode, place in cells (3,), twist (6,)."""
    episodes = []
    for index, stream in enumerate(streams):
        episodes.append(np.column_stack((np.full(len(stream), index), stream[:, columns])))
    rows = np.concatenate(episodes).astype(np.float64)

    near = np.abs(rows[:, 1:4]) < FARTHEST_CELL * CELL_SIZE
    rows = rows[np.isfinite(rows).all(axis=1) & near.all(axis=1)]
    rows[:, 1:4] = np.floor(rows[:, 1:4] / CELL_SIZE)
    return rows


def _arm_cells(arm: int, rows: Floats, episodes: int) -> Floats:
    """Return the cells (N, 16) of an arm, by the motions of its hand in so many episodes."""
    visits, visit_of = np.unique(rows[:, :4], axis=0, return_inverse=True)  # of a cell by an episode
    fastest = np.zeros((len(visits), 12))
    np.maximum.at(fastest, visit_of.ravel(), np.hstack((rows[:, 4:], -rows[:, 4:])))

    places, place_of = np.unique(visits[:, 1:], axis=0, return_inverse=True)
    cells = np.zeros((0, COLUMNS))
    for index, place in enumerate(places):
        ranked = np.sort(fastest[place_of.ravel() == index], axis=0)[::-1]
        left_out = int(FASTEST_EPISODES * len(ranked) + ODD_EPISODES * episodes)
        if left_out < len(ranked):
            cells = np.vstack((cells, (arm, *place, *ranked[left_out])))
    return cells


@compiled
def cell_near(grid: NDArray[np.float32], low: NDArray[np.int64], arm: int, place: Floats) -> int:
    """Return the index of the cell of a place (3,) among ``grid.reshape(-1, 12)``; -1 outside, and for NaN."""
    index = 0
    for axis in range(4):
        position = float(arm)
        if axis > 0:
            position = np.floor(place[axis - 1] / CELL_SIZE[axis - 1])
        offset = position - low[axis]
        if not 0.0 <= offset < grid.shape[axis]:
            return -1
        index = index * grid.shape[axis] + int(offset)
    return index


@compiled
def healthy_share(limit: SpeedLimit, arm: int, place: Floats, twist: Floats) -> float:
    """Return k, the share of a twist (6,) that healthy hands near a place (3,) went, slack included."""
    cell = cell_near(limit.grid, limit.low, arm, place)
    fastest = limit.grid.reshape(-1, 12)
    share = np.inf
    for axis in range(6):
        direction = axis
        if twist[axis] <= 0.0:
            direction = 6 + axis
        speed = SLACK[axis]
        if cell >= 0:
            speed += ABOVE_HEALTHY * fastest[cell, direction]
        share = min(share, speed / max(abs(twist[axis]), STILL))

    down = DOWN_SLACK
    if cell >= 0:
        down = max(down, ABOVE_HEALTHY_DOWN * fastest[cell, DOWN])
    return min(share, min(down, limit.hand_speed) / max(-twist[2], STILL))


@compiled
def allowed_share(limit: SpeedLimit, arm: int, place: Floats, twist: Floats, speed: float, momentum: float) -> float:
    """Return s, the share that a hand may have of a motion; above 1 where it may go faster.

    Args:
        limit: what the hand may do.
        arm: index of its arm.
        place: (3,) of the hand [m].
        twist: (6,) of the hand, linear and angular [m/s], [rad/s].
        speed: of the hand's fastest point [m/s].
        momentum: of the arm along its hand's motion [N s]; 0 where it is not known.
    """
    share = limit.hand_speed / max(speed, STILL)
    if limit.grid.shape[0] == 0:
        return share
    share = min(share, limit.momentum / max(momentum, STILL))
    return max(share, healthy_share(limit, arm, place, twist))
