"""How fast healthy hands went, by place and direction: learned from episodes, looked up by place.

Space is divided into cells of 4 × 4 × 2 cm. Of each cell the map holds the greatest speed in each direction,

    g = max of the kept episodes of max_t v_t      while the hand is in the cell,

where the fastest 5 % of the episodes that visit a cell, and 0.2 % of all, are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from asm_gym.data.episode import Episode
from asm_gym.detection.hand_speed import AXES, CELL_SIZE, DOWNWARDS, Floats, cell_near
from asm_gym.spec import StreamSpec

AnyFloats = NDArray[np.floating[Any]]

# Columns of a map's cells.
ARM_AND_PLACE = slice(0, 4)  # the arm, and the cell's place along x, y and z in cells
FASTEST_COLUMNS = slice(4, 16)
"""Greatest speed along each axis of the twist, then against each [m/s], [rad/s]."""

FARTHEST_CELL = 100  # hands that are more cells away from the origin are not learned of
OWN_MAP_EPISODES = 40  # of a task that has a map of its own: elsewhere others may go down fast
FASTEST_EPISODES = 0.05
"""Share of the episodes that visit a cell, the fastest, which do not count there,"""
ODD_EPISODES = 0.002
"""and of all episodes: of hundreds, an odd one sets no speed where few others go."""

MOMENTUM = 2.3
"""Limit of a hand or link where no healthy hand was: 15 kg at the usual speed [N s]. MuJoCo's contacts answer with
about 105/s times that."""
PACE_MOMENTUM = 3.0  # of a hand where one was [N s]

TILTING = [3, 4, 9, 10]  # of the 12 directions, about the horizontal axes
TILTED_SPEED = 0.5  # in most places hands of a task that tilts them turn faster [rad/s]
LEAST_UPRIGHT = 0.9  # other hands point down to within 26 degrees


class HandSpeedMap:
    """How fast healthy hands went, by place and direction.

    Args:
        cells: (N, 16) see ``ARM_AND_PLACE`` and ``FASTEST_COLUMNS``. The greatest counts where a place is given twice.
        momentum: limit of the momentum of an arm's hand and links, where no healthy hand was [N s].
        pace_momentum: that of a hand where one was [N s].

    Raises:
        ValueError: cells of another shape, places that are too far away, or negative speeds.

    Attributes:
        grid: (arms, x, y, z, 12) the greatest speeds of healthy hands in each cell and its neighbours.
        low: (4,) arm and place of the grid's first cell.
        least_upright: cosine of the greatest tilt at which a hand may go as fast as healthy ones did.
    """

    def __init__(
        self,
        cells: AnyFloats,
        momentum: float = MOMENTUM,
        pace_momentum: float = PACE_MOMENTUM,
    ) -> None:
        if not _are_cells(cells):
            raise ValueError(
                f"pace must be rows of {FASTEST_COLUMNS.stop} numbers, "
                f"places within {FARTHEST_CELL} cells, got {cells.shape}"
            )
        self.cells = cells
        self.momentum = momentum
        self.pace_momentum = pace_momentum

        places = cells[:, ARM_AND_PLACE].astype(np.int64)
        self.low = places.min(axis=0) - (0, 1, 1, 1)
        offsets = places - self.low
        shape = np.add(offsets.max(axis=0), (1, 2, 2, 2))
        grid = np.zeros((*shape, 2 * AXES), np.float32)
        at = tuple(offsets.T)
        np.maximum.at(grid, at, cells[:, FASTEST_COLUMNS])

        tilting = cells[:, FASTEST_COLUMNS][:, TILTING].max(axis=1)
        self.least_upright = LEAST_UPRIGHT
        if np.median(tilting) > TILTED_SPEED:
            self.least_upright = -1.0

        # A hand may go as fast as others beside its cell; downwards, only as others at its height.
        downward = grid[..., DOWNWARDS]
        self.grid = maximum_filter(grid, (1, 3, 3, 3, 1))
        self.grid[..., DOWNWARDS] = maximum_filter(downward, (1, 3, 3, 1))

    @classmethod
    def of(
        cls,
        cells_by_task: Mapping[str, AnyFloats],
        task: str = "",
    ) -> Self | None:
        """Return the map of a task; that of all tasks where it has none, None where there are no cells."""
        if task and task in cells_by_task:
            return cls(cells_by_task[task])
        if not cells_by_task:
            return None
        return cls(np.concatenate(list(cells_by_task.values())))

    @classmethod
    def by_task(
        cls, episodes: Sequence[Episode], spec: StreamSpec
    ) -> dict[str, NDArray[np.float32]]:
        """Return the cells of each task with ``OWN_MAP_EPISODES``, and of all others under an empty name."""
        streams: defaultdict[str, list[NDArray[np.float32]]] = defaultdict(list)
        for episode in episodes:
            task = episode.label.task if episode.label else ""
            streams[task].append(episode.stream)
        for task in list(streams):
            if len(streams[task]) < OWN_MAP_EPISODES:
                streams[""] = streams.pop(task) + streams[""]

        cells = {task: cls.learned(own, spec) for task, own in streams.items()}
        return {task: learned for task, learned in cells.items() if learned is not None}

    @staticmethod
    def learned(streams: Sequence[AnyFloats], spec: StreamSpec) -> NDArray[np.float32] | None:
        """Return the cells (N, 16) of healthy streams (T, D); None where these do not tell how hands move."""
        cells = []
        positions = [name for name in spec.slices if name.endswith("hand_position")]
        for arm, position in enumerate(positions):
            hand = position.removesuffix("position")
            names = (position, f"{hand}velocity", f"{hand}angular_velocity")
            if spec.slices.keys() >= set(names):
                columns = np.hstack([np.arange(spec.size)[spec.slices[name]] for name in names])
                rows = _motions(streams, columns)
                cells.append(_cells_of(arm, rows, len(streams)))
        if not cells:
            return None
        return np.concatenate(cells).astype(np.float32)

    def fastest_near(
        self,
        arm: int,
        place: Floats,
    ) -> AnyFloats:
        """Return (2, 6) the greatest twist near a place (3,), along the axes and against them; else 0."""
        cell = cell_near(self.grid, self.low, arm, place)
        if cell < 0:
            return np.zeros((2, AXES))
        return self.grid.reshape(-1, 2, AXES)[cell]


def _are_cells(cells: AnyFloats) -> bool:
    if cells.ndim != 2 or cells.shape[1] != FASTEST_COLUMNS.stop or cells.size == 0:
        return False
    near = np.abs(cells[:, ARM_AND_PLACE]) <= FARTHEST_CELL
    arms_and_speeds = np.delete(cells, (1, 2, 3), axis=1)
    positive = arms_and_speeds >= 0
    return bool(near.all() and positive.all())


def _motions(streams: Sequence[AnyFloats], columns: NDArray[np.intp]) -> Floats:
    """Return (T, 10) the rows of all streams: index of the episode, place in cells (3,), twist (6,)."""
    motions = []
    for episode, stream in enumerate(streams):
        motion = np.asarray(stream[:, columns], np.float64)
        motions.append(np.insert(motion, 0, episode, axis=1))
    rows = np.concatenate(motions)
    places = rows[:, 1:4] / CELL_SIZE
    rows[:, 1:4] = np.floor(places)
    is_near = (np.abs(places) < FARTHEST_CELL).all(axis=1)
    is_known = np.isfinite(rows).all(axis=1)
    return rows[is_known & is_near]


def _cells_of(
    arm: int,
    rows: Floats,
    episodes: int,
) -> Floats:
    """Return the cells (N, 16) of an arm, by the motions of its hand in so many episodes."""
    # A visit is all rows of an episode in a cell.
    visits, visit_of = np.unique(rows[:, :4], axis=0, return_inverse=True)
    twists = rows[:, 4:]
    fastest = np.zeros((len(visits), 2 * AXES))
    np.maximum.at(fastest, visit_of.ravel(), np.hstack((twists, -twists)))

    cells = []
    visited = visits[:, 1:]
    for place in np.unique(visited, axis=0):
        here = np.all(visited == place, axis=1)
        ascending = np.sort(fastest[here], axis=0)
        left_out = FASTEST_EPISODES * len(ascending) + ODD_EPISODES * episodes
        kept = len(ascending) - int(left_out)
        if kept > 0:
            cells.append(np.hstack((arm, place, ascending[kept - 1])))
    return np.reshape(cells, (-1, FASTEST_COLUMNS.stop))
