"""Where an arm might meet something that does not give way: only towards it is the arm's momentum limited.

What does not give way is fixed to the world, as tables, bins and the robot's own pedestal are, or hangs on a joint, as
doors and other arms do. Things that lie freely do not count: an arm pushes them away, up to what they lie against.
Around each geom of the arm there is a ball, and around each obstacle a box. The directions to boxes that are within
``NEAR`` of a ball are noted in every control step, and compared with the motion in every substep.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.envs.mujoco_views import DIRECTIONS, EVERYWHERE, Ahead, Arms, Floats

# At 0.5 m/s an arm goes half of it in a control step of 50 ms [m].
NEAR = 0.05

Ids = NDArray[np.int64]


class ArmGeoms(NamedTuple):
    """Geoms that one arm may bring together; arrays of MuJoCo are not copied."""

    links: Ids  # (G,) index of the link that each geom of the arm belongs to, from the hand on
    geoms: Ids  # (G,)
    obstacles: Ids  # (O,) other geoms
    radii: Floats  # (ngeom,) of the ball around each geom [m]
    boxes: Floats  # (ngeom, 6) centre and half edges of the box around each, in its frame [m]
    places: Floats  # (ngeom, 3)
    frames: Floats  # (ngeom, 9)

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData, arms: Arms, a: int) -> ArmGeoms:
        """Return the geoms of arm ``a``."""
        collides = (model.geom_contype | model.geom_conaffinity) != 0
        link_of = np.array([_link_of(model, arms[a], body) for body in range(model.nbody)])
        link_of_geom = link_of[model.geom_bodyid]
        own = np.flatnonzero(collides & (link_of_geom >= 0))
        gives_way = np.array([_gives_way(model, body) for body in range(model.nbody)])
        is_obstacle = collides & (link_of_geom < 0) & ~gives_way[model.geom_bodyid]
        return cls(
            links=link_of_geom[own],
            geoms=own,
            obstacles=np.flatnonzero(is_obstacle),
            radii=model.geom_rbound,
            boxes=model.geom_aabb,
            places=data.geom_xpos,
            frames=data.geom_xmat,
        )


class Obstacles:
    """Tells in which directions the links of the arms are near obstacles.

    Args:
        model: a loaded model.
        data: its data.
        arms: its arms.

    Attributes:
        ahead: these directions when ``look`` was called last.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, arms: Arms) -> None:
        self._geoms = [ArmGeoms.of(model, data, arms, a) for a in range(len(arms))]
        self.ahead = Ahead.everywhere(len(arms))

    def look(self) -> None:
        """Write where the arms are now."""
        for a, geoms in enumerate(self._geoms):
            note_ahead(geoms, self.ahead.counts[a], self.ahead.directions[a])


def _link_of(model: mujoco.MjModel, arm: Any, body: int) -> int:
    """Return the index of the link of an arm that carries a body; -1 for none."""
    links = arm.links.tolist()
    while body > 0:
        if body in links:
            return links.index(body)
        body = int(model.body_parentid[body])
    return -1


def _gives_way(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body lies freely, or belongs to one that does."""
    while body > 0:
        first = model.body_jntadr[body]
        if first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
            return True
        body = int(model.body_parentid[body])
    return False


@compiled
def note_ahead(arm: Any, counts: Ids, directions: Floats) -> None:
    """Write in which directions the links of an arm, by its ``ArmGeoms``, are near an obstacle."""
    counts[:] = 0
    way = np.zeros(3)
    for g in range(len(arm.geoms)):
        link = arm.links[g]
        for obstacle in arm.obstacles:
            if counts[link] == EVERYWHERE:
                break
            geom = arm.geoms[g]
            apart = write_way(arm, geom, obstacle, way)
            if apart - arm.radii[geom] > NEAR:
                continue
            if apart == 0.0 or counts[link] == DIRECTIONS:
                counts[link] = EVERYWHERE
                break
            direction = directions[link, counts[link]]
            for axis in range(3):
                direction[axis] = way[axis] / apart
            direction[3] = arm.radii[geom]
            counts[link] += 1


@inner
def write_way(arm: Any, geom: int, obstacle: int, way: Floats) -> float:
    """Write the way (3,) from the centre of a geom to the box of an obstacle; return its length [m], 0 within it."""
    for axis in range(3):
        way[axis] = 0.0
    frame = arm.frames[obstacle]
    square = 0.0
    for axis in range(3):
        along = -arm.boxes[obstacle, axis]
        for k in range(3):
            apart = arm.places[geom, k] - arm.places[obstacle, k]
            along += frame[3 * k + axis] * apart
        half = arm.boxes[obstacle, 3 + axis]
        back = min(max(along, -half), half) - along
        square += back * back
        for k in range(3):
            way[k] += frame[3 * k + axis] * back
    return np.sqrt(square)
