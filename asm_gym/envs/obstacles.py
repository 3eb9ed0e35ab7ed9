"""Where an arm might meet something: only towards it is the arm slowed down more than elsewhere.

Around each geom of the arm there is a ball, and around each geom of anything else a box. Of pairs whose ball and box
are within ``NEAR``, MuJoCo tells the nearest points, in every control step; of those that are nearest, in every fifth
substep again, for a link that rolls on a table always touches it with another point. In every substep the place and
the speed of the arm's point tell how soon they would touch (``arm_brake``). What the hand touches and can be carried
belongs to the hand: it is no obstacle, and meets others.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.envs.controllers import length
from asm_gym.envs.mujoco_views import NEAR_POINTS, Ahead, Arm, Arms, Floats, Ints, link_library

# Beyond it nothing is touched within a control step of 50 ms at 1 m/s [m].
NEAR = 0.06

LOOK_AGAIN_EVERY = 5  # substeps
LOOK_AGAIN_WITHIN = 0.02  # [m]
NUDGE = 1e-5  # moves a geom to where its distance is found again [m]
WORLD = 0  # the body that all others stand on

link_library()
_distance: Any = types.ExternalFunction(
    "mj_geomDistance",
    types.float64(types.intp, types.intp, types.int32, types.int32, types.float64, types.intp),
)


class ArmGeoms(NamedTuple):
    """Geoms that one arm may bring together; arrays of MuJoCo are not copied."""

    model: int  # its address
    data: int  # its address
    link_bodies: Ints  # (MOST_BODIES,) the links, from the hand on; then -1
    links: Ints  # (ngeom,) index of the link that carries each geom, from the hand on; else -1
    own: Ints  # (G,) geoms of the arm
    others: Ints  # (O,) other geoms
    bodies: NDArray[np.int32]  # (ngeom,) that have the geoms
    parents: NDArray[np.int32]  # (nbody,) that carry the bodies
    carriable: NDArray[np.int32]  # (ngeom,) the body that lies freely and has the geom; else -1
    radii: Floats  # (ngeom,) of the ball around each geom [m]
    boxes: Floats  # (ngeom, 6) centre and half edges of the box around each, in its frame [m]
    places: Floats  # (ngeom, 3)
    frames: Floats  # (ngeom, 9)
    body_places: Floats  # (nbody, 3)
    body_frames: Floats  # (nbody, 9)
    is_carried: NDArray[np.bool_]  # (nbody,) scratch: the hand touches a body that lies freely
    ends: Floats  # (2, 3) scratch: the nearest points of two geoms [m]

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData, arms: Arms, a: int) -> ArmGeoms:
        """Return the geoms of arm ``a``."""
        collides = (model.geom_contype | model.geom_conaffinity) != 0
        link_of = np.array([_link_of(model, arms[a], body) for body in range(model.nbody)])
        link_of_geom = link_of[model.geom_bodyid]
        free_bodies = [_free_body(model, body) for body in range(model.nbody)]
        return cls(
            model=model._address,
            data=data._address,
            link_bodies=arms[a].links,
            links=link_of_geom,
            own=np.flatnonzero(collides & (link_of_geom >= 0)),
            others=np.flatnonzero(collides & (link_of_geom < 0)),
            bodies=model.geom_bodyid,
            parents=model.body_parentid,
            carriable=np.array(free_bodies, np.int32)[model.geom_bodyid],
            radii=model.geom_rbound,
            boxes=model.geom_aabb,
            places=data.geom_xpos,
            frames=data.geom_xmat,
            body_places=data.xpos,
            body_frames=data.xmat,
            is_carried=np.zeros(model.nbody, np.bool_),
            ends=np.zeros((2, 3)),
        )


class Obstacles:
    """Tells where the links of the arms are near obstacles.

    Args:
        model: a loaded model.
        data: its data.
        arms: its arms.

    Attributes:
        ahead: these places when ``look`` was called last.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, arms: Arms) -> None:
        self._data = data
        self._geoms = [ArmGeoms.of(model, data, arms, a) for a in range(len(arms))]
        self.ahead = Ahead.everywhere(len(arms))

    def look(self) -> None:
        """Write where the arms are now."""
        touching = self._data.contact.geom
        for a, geoms in enumerate(self._geoms):
            note_ahead(geoms, touching, self.ahead, a)


def _link_of(model: mujoco.MjModel, arm: Arm, body: int) -> int:
    """Return the index of the link of an arm that carries a body; -1 for none."""
    links = arm.links.tolist()
    while body > 0:
        if body in links:
            return int(links.index(body))
        body = int(model.body_parentid[body])
    return -1


def _free_body(model: mujoco.MjModel, body: int) -> int:
    """Return the body that lies freely and carries a body; -1 for none."""
    while body > 0:
        first = model.body_jntadr[body]
        if first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
            return body
        body = int(model.body_parentid[body])
    return -1


@compiled
def note_ahead(arm: Any, touching: NDArray[np.int32], ahead: Ahead, a: int) -> None:
    """Write where the links of arm ``a`` are near something.

    Args:
        arm: its ``ArmGeoms``.
        touching: (N, 2) geoms that touch.
        ahead: written to.
        a: index of the arm.
    """
    ahead.counts[a, :] = 0
    note_carried(arm, touching)
    for geom in arm.own:
        note_geom(arm, geom, arm.links[geom], ahead, a)
    for geom in arm.others:
        if belongs_to_hand(arm, geom):
            note_geom(arm, geom, 0, ahead, a)


@inner
def note_carried(arm: Any, touching: NDArray[np.int32]) -> None:
    """Write which bodies that lie freely the hand touches."""
    arm.is_carried[:] = False
    for n in range(len(touching)):
        for side in range(2):
            body = arm.carriable[touching[n, side]]
            if body >= 0 and arm.links[touching[n, 1 - side]] == 0:
                arm.is_carried[body] = True


@inner
def belongs_to_hand(arm: Any, geom: int) -> bool:
    """Whether a geom is one of what the hand touches and can carry."""
    return arm.carriable[geom] >= 0 and arm.is_carried[arm.carriable[geom]]


@inner
def nearest_points(
    model: int, data: int, places: Floats, geom: int, other: int, ends: Floats
) -> float:
    """Write the nearest points of two geoms into ``ends`` (2, 3), where they are within ``NEAR``; return the gap [m].

    MuJoCo 3.3.5 to 3.10 says of some convex geoms that are apart that they are exactly 0 apart, and tells points that
    lie anywhere on them (google-deepmind/mujoco issue 3383). A hundredth of a millimetre away it finds the right ones.

    Args:
        model, data: their addresses.
        places: (ngeom, 3) of the geoms; those of ``geom`` are as before on return.
    """
    gap = _distance(model, data, geom, other, NEAR, ends.ctypes.data)
    for axis in range(3):
        if gap != 0.0:
            break
        place = places[geom, axis]
        places[geom, axis] = place + NUDGE
        gap = _distance(model, data, geom, other, NEAR, ends.ctypes.data)
        places[geom, axis] = place
    return gap


@inner
def note_geom(arm: Any, geom: int, link: int, ahead: Ahead, a: int) -> None:
    """Note the points of a geom of a link that are near something."""
    for other in arm.others:
        if belongs_to_hand(arm, other):
            continue
        # A link turns on the one that carries it, and never meets it.
        carrier = arm.parents[arm.bodies[geom]]
        if carrier == arm.bodies[other] and carrier != WORLD:
            continue
        if box_distance(arm, geom, other) > NEAR + arm.radii[geom]:
            continue
        gap = nearest_points(arm.model, arm.data, arm.places, geom, other, arm.ends)
        if gap < NEAR:
            point = point_to_keep(ahead, a, link, gap)
            if point >= 0:
                near = ahead.points[a, link, point]
                near.geom = geom
                near.obstacle = other
                body = arm.link_bodies[link]
                write_point(arm.body_places[body], arm.body_frames[body], arm.ends, gap, near)


@inner
def look_again(views: Any, arm: Any, a: int, ahead: Ahead, ends: Floats) -> None:
    """Write anew where what was nearest to arm ``a`` is nearest now; see ``Views``, ``Arm``."""
    n = 0
    while arm.links[n] >= 0:
        body = arm.links[n]
        for k in range(ahead.counts[a, n]):
            near = ahead.points[a, n, k]
            if near.gap < LOOK_AGAIN_WITHIN:
                gap = nearest_points(
                    views.model, views.data, views.geom_xpos, near.geom, near.obstacle, ends
                )
                write_point(views.xpos[body], views.xmat[body], ends, gap, near)
        n += 1


@inner
def box_distance(arm: Any, geom: int, obstacle: int) -> float:
    """Return how far the centre of a geom is from the box of an obstacle [m]."""
    square = 0.0
    for axis in range(3):
        along = -arm.boxes[obstacle, axis]
        for k in range(3):
            apart = arm.places[geom, k] - arm.places[obstacle, k]
            along += arm.frames[obstacle, 3 * k + axis] * apart
        beyond = max(0.0, abs(along) - arm.boxes[obstacle, 3 + axis])
        square += beyond * beyond
    return np.sqrt(square)


@inner
def point_to_keep(ahead: Ahead, a: int, link: int, gap: float) -> int:
    """Return which of the points of a link of arm ``a`` gives way to one so near; -1 where all are nearer."""
    kept = ahead.counts[a, link]
    if kept < NEAR_POINTS:
        ahead.counts[a, link] += 1
        return kept
    points = ahead.points[a, link]
    farthest = 0
    for k in range(1, NEAR_POINTS):
        if points[k].gap > points[farthest].gap:
            farthest = k
    if points[farthest].gap <= gap:
        return -1
    return farthest


@inner
def write_point(
    body_place: Floats, body_frame: Floats, ends: Floats, gap: float, point: Any
) -> None:
    """Write the point of a link from the nearest points ``ends`` (2, 3) of one of its geoms and another.

    Args:
        body_place, body_frame: (3,) and (9,) of the link.
        ends: see above.
        gap: from one to the other; negative where the geoms overlap [m].
        point: of ``NEAR_POINT``, written to.
    """
    point.gap = gap
    for axis in range(3):
        point.place[axis] = ends[0, axis]
        point.way[axis] = ends[1, axis] - ends[0, axis]
    distance = length(point.way)
    if gap < 0.0:
        distance = -distance  # the nearest points of geoms that overlap lie the other way
    for axis in range(3):
        if distance != 0.0:
            point.way[axis] /= distance
        point.in_link[axis] = 0.0
        for k in range(3):
            from_link = point.place[k] - body_place[k]
            point.in_link[axis] += body_frame[3 * k + axis] * from_link
