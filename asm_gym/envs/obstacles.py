"""Where an arm might meet something: only towards it is the arm's momentum limited.

Around each geom of the arm there is a ball, and around each geom of anything else a box. The directions to boxes that
are within ``NEAR`` of a ball are noted in every control step, and compared with the motion in every substep. What the
hand touches and can be carried belongs to the hand: it is no obstacle, and meets others.
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
# From the hand to the middle of a geom of its gripper, or of what it carries [m].
FROM_HAND = 0.15

Ids = NDArray[np.int64]


class ArmGeoms(NamedTuple):
    """Geoms that one arm may bring together; arrays of MuJoCo are not copied."""

    links: Ids  # (ngeom,) index of the link that carries each geom, from the hand on; else -1
    own: Ids  # (G,) geoms of the arm
    others: Ids  # (O,) other geoms
    carriable: NDArray[np.int32]  # (ngeom,) the body that lies freely and has the geom; else -1
    radii: Floats  # (ngeom,) of the ball around each geom [m]
    reaches: Floats  # (ngeom,) how far each geom of the arm reaches from the origin of its link [m]
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
        free_bodies = [_free_body(model, body) for body in range(model.nbody)]
        return cls(
            links=link_of_geom,
            own=own,
            others=np.flatnonzero(collides & (link_of_geom < 0)),
            carriable=np.array(free_bodies, np.int32)[model.geom_bodyid],
            radii=model.geom_rbound,
            reaches=_reaches(model, arms[a]),
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
        self._data = data
        self._is_carried = np.zeros(model.nbody, np.bool_)
        self._geoms = [ArmGeoms.of(model, data, arms, a) for a in range(len(arms))]
        self.ahead = Ahead.everywhere(len(arms))

    def look(self) -> None:
        """Write where the arms are now."""
        touching = self._data.contact.geom
        for a, geoms in enumerate(self._geoms):
            note_ahead(
                geoms, touching, self._is_carried, self.ahead.counts[a], self.ahead.directions[a]
            )


def _link_of(model: mujoco.MjModel, arm: Any, body: int) -> int:
    """Return the index of the link of an arm that carries a body; -1 for none."""
    links = arm.links.tolist()
    while body > 0:
        if body in links:
            return links.index(body)
        body = int(model.body_parentid[body])
    return -1


def _reaches(model: mujoco.MjModel, arm: Any) -> Floats:
    """Return (ngeom,) how far the ball around each geom reaches from the origin of the link that carries it [m]."""
    centres = np.linalg.norm(model.geom_pos, axis=1)
    is_of_link = np.isin(model.geom_bodyid, arm.links)
    return np.asarray(model.geom_rbound + np.where(is_of_link, centres, FROM_HAND))


def _free_body(model: mujoco.MjModel, body: int) -> int:
    """Return the body that lies freely and carries a body; -1 for none."""
    while body > 0:
        first = model.body_jntadr[body]
        if first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
            return body
        body = int(model.body_parentid[body])
    return -1


@compiled
def note_ahead(
    arm: Any,
    touching: NDArray[np.int32],
    is_carried: NDArray[np.bool_],
    counts: Ids,
    directions: Floats,
) -> None:
    """Write in which directions the links of an arm are near something.

    Args:
        arm: its ``ArmGeoms``.
        touching: (N, 2) geoms that touch.
        is_carried: (nbody,) scratch: the hand touches the body.
        counts: (MOST_BODIES,) as in ``Ahead``, as are the directions.
    """
    counts[:] = 0
    note_carried(arm, touching, is_carried)
    for geom in arm.own:
        note_geom(arm, geom, arm.links[geom], is_carried, counts, directions)
    for geom in arm.others:
        if arm.carriable[geom] >= 0 and is_carried[arm.carriable[geom]]:
            note_geom(arm, geom, 0, is_carried, counts, directions)


@inner
def note_carried(arm: Any, touching: NDArray[np.int32], is_carried: NDArray[np.bool_]) -> None:
    """Write which bodies that lie freely the hand touches."""
    is_carried[:] = False
    for n in range(len(touching)):
        for side in range(2):
            body = arm.carriable[touching[n, side]]
            if body >= 0 and arm.links[touching[n, 1 - side]] == 0:
                is_carried[body] = True


@inner
def note_geom(
    arm: Any,
    geom: int,
    link: int,
    is_carried: NDArray[np.bool_],
    counts: Ids,
    directions: Floats,
) -> None:
    """Note the directions in which a geom of a link is near something."""
    way = np.zeros(3)
    for other in arm.others:
        if counts[link] == EVERYWHERE:
            return
        if arm.carriable[other] >= 0 and is_carried[arm.carriable[other]]:
            continue
        apart = write_way(arm, geom, other, way)
        if apart - arm.radii[geom] > NEAR:
            continue
        # Within the ball nobody knows which side of a long geom will touch.
        if apart < arm.radii[geom] or counts[link] == DIRECTIONS:
            counts[link] = EVERYWHERE
            return
        direction = directions[link, counts[link]]
        for axis in range(3):
            direction[axis] = way[axis] / apart
        direction[3] = arm.reaches[geom]
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
