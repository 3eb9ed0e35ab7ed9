r"""What an arm's links weigh on its joints, by the body model that came with it (URDF): gravity, and inertia.

    τ = g(q) + [M(q) q̈ + c(q, q̇)]      each joint's torque by recursive Newton-Euler, links from the base outwards

    ω_i = Rᵢᵀ ω_p + q̇ z,   ω̇_i = Rᵢᵀ ω̇_p + q̈ z + Rᵢᵀ ω_p × q̇ z       where joint i turns about z
    a_i = Rᵢᵀ (a_p + ω̇_p × p + ω_p × (ω_p × p)),   a_base = -gravity
    f_i = m (a_i + ω̇_i × c + ω_i × (ω_i × c)),   n_i = I ω̇_i + ω_i × I ω_i + c × f_i

Frames are those of the links, p is where a joint stands in its parent's, c the centre of mass. What does not move against
a link is a part of it; joints that no column tells stand at 0.

Source: Luh, Walker and Paul 1980 (Journal of Dynamic Systems, Measurement, and Control 102).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GRAVITY = 9.81
"""Downwards along the base's z [m/s²]."""

TURNS, SLIDES = ("revolute", "continuous"), ("prismatic",)


class BodyModel(NamedTuple):
    """Links that move, from the base outwards, of which the last J are what it was asked about.

    Attributes:
        names: (L,) of the joint that moves each.
        parents: (L,) which link each stands on; -1 is the base.
        turns, places: (L, 3, 3) and (L, 3) where a joint stands in its parent's frame [m].
        axes: (L, 3) of the joints, in their own frames.
        slides: (L,) whether a joint slides and does not turn.
        mass, centre, inertia: (L,) [kg], (L, 3) [m], (L, 3, 3) about the centre [kg m²].
        asked: (J,) which links stand in the columns of what it is told.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    turns: Floats
    places: Floats
    axes: Floats
    slides: NDArray[np.bool_]
    mass: Floats
    centre: Floats
    inertia: Floats
    asked: NDArray[np.intp]

    @classmethod
    def of(cls, urdf: str, columns: Sequence[str]) -> Self:
        """By a URDF's text, for a column a joint: by joints' names, or else the first of the longest chain of joints.

        Raises:
            ValueError: it is no URDF, its joints are no tree, or it has fewer joints than there are columns.
        """
        root = _root(urdf)
        joints = {_text(j, "name"): j for j in root.findall("joint")}
        below: dict[str, list[str]] = {}
        for name, joint in joints.items():
            below.setdefault(_end(joint, "parent"), []).append(name)
        ends = {_end(joint, "child") for joint in joints.values()}
        links = {_text(link, "name"): link for link in root.findall("link")}
        bases = [name for name in links if name not in ends]
        if len(bases) != 1 or len(ends) != len(joints) or not ends <= set(links):
            raise ValueError(f"the joints of the body are no tree with one base: bases are {', '.join(bases) or 'none'}")
        found = _Links([], [], [], [], [], [], [], [], [])
        _gather(found, bases[0], -1, np.eye(3), np.zeros(3), links, joints, below)
        asked = _by_name(found.names, columns) or _longest(found.parents)[: len(columns)]
        if len(asked) < len(columns):
            raise ValueError(f"{len(columns)} joints are sensed, and the body's longest chain has {len(asked)} that move")
        return cls(
            *(tuple(found.names), tuple(found.parents), np.array(found.turns), np.array(found.places), np.array(found.axes)),
            *(np.array(found.slides), np.array(found.mass), np.array(found.centre), np.array(found.inertia)),
            np.array(asked, np.intp),
        )

    def torques(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """By gravity and by motion, (N, J) each, for what J joints do (N, J)."""
        still = np.zeros_like(q)
        weight = self._torques(q, still, still, GRAVITY)
        return weight, self._torques(q, speed, acceleration, 0.0)

    def _torques(self, q: Floats, speed: Floats, acceleration: Floats, gravity: float) -> Floats:
        N, L = len(q), len(self.names)
        told = np.zeros((3, N, L))
        told[:, :, self.asked] = q, speed, acceleration
        turns = []  # (N, 3, 3) from each link's frame to its parent's
        places, spin, spun, moved = [], [], [], []  # (N, 3) ω, ω̇ and a of each, in its own frame
        forces, moments = [], []
        for i, parent in enumerate(self.parents):
            x, v, a = told[..., i, None]
            axis, slides = self.axes[i], self.slides[i]
            turn = self.turns[i] @ (np.broadcast_to(np.eye(3), (N, 3, 3)) if slides else _about(axis, x[:, 0]))
            place = self.places[i] + (x * (self.turns[i] @ axis) if slides else np.zeros((N, 3)))
            w0, dw0 = (spin[parent], spun[parent]) if parent >= 0 else (np.zeros((N, 3)), np.zeros((N, 3)))
            a0 = moved[parent] if parent >= 0 else np.tile([0.0, 0.0, gravity], (N, 1))
            w, dw = _back(turn, w0), _back(turn, dw0)
            linear = _back(turn, a0 + np.cross(dw0, place) + np.cross(w0, np.cross(w0, place)))
            if slides:
                linear = linear + a * axis + 2 * np.cross(w, v * axis)
            else:
                dw = dw + a * axis + np.cross(w, v * axis)
                w = w + v * axis
            centre, inertia = self.centre[i], self.inertia[i]
            force = self.mass[i] * (linear + np.cross(dw, centre) + np.cross(w, np.cross(w, centre)))
            moment = dw @ inertia + np.cross(w, w @ inertia) + np.cross(centre, force)
            for kept, new in zip(
                (turns, places, spin, spun, moved, forces, moments),
                (turn, place, w, dw, linear, force, moment),
                strict=True,
            ):
                kept.append(new)
        found = np.zeros((N, L))
        for i in range(L - 1, -1, -1):
            found[:, i] = (forces[i] if self.slides[i] else moments[i]) @ self.axes[i]
            parent = self.parents[i]
            if parent >= 0:
                force = (turns[i] @ forces[i][..., None])[..., 0]
                moments[parent] = (
                    moments[parent] + (turns[i] @ moments[i][..., None])[..., 0] + np.cross(places[i], force)
                )
                forces[parent] = forces[parent] + force
        return found[:, self.asked]


class _Links(NamedTuple):
    """The same as of a BodyModel, while it is made."""

    names: list[str]
    parents: list[int]
    turns: list[Floats]
    places: list[Floats]
    axes: list[Floats]
    slides: list[bool]
    mass: list[float]
    centre: list[Floats]
    inertia: list[Floats]


def _by_name(names: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Which joint each column names, the longest name that is a part of it; none where not each names one of its own."""
    named = [max((n for n in names if n in column), key=len, default="") for column in columns]
    return [names.index(n) for n in named] if all(named) and len(set(named)) == len(named) else []


def _longest(parents: Sequence[int]) -> list[int]:
    """The links of the longest chain, from the base outwards."""
    chains: list[list[int]] = []
    for i, parent in enumerate(parents):
        chains.append([*(chains[parent] if parent >= 0 else []), i])
    return max(chains, key=len, default=[])


def _gather(
    found: _Links,
    link: str,
    at: int,
    turn: Floats,
    place: Floats,
    links: dict[str, Element],
    joints: dict[str, Element],
    below: dict[str, list[str]],
) -> None:
    """Adds a link, that stands so in the frame of the moving link ``at``, and all that stands on it."""
    if at >= 0:
        _weigh(found, at, links[link], turn, place)
    for name in below.get(link, ()):
        joint = joints[name]
        offset, own = _origin(joint)
        there, turned = place + turn @ offset, turn @ own
        kind = joint.get("type")
        if kind in (*TURNS, *SLIDES) and joint.find("mimic") is None:
            axis = _numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
            length = np.linalg.norm(axis)
            if not length > 0:
                raise ValueError(f"the axis of joint {name} has no direction")
            found.names.append(name)
            found.parents.append(at)
            for kept, new in ((found.turns, turned), (found.places, there), (found.axes, axis / length)):
                kept.append(new)
            found.slides.append(kind in SLIDES)
            found.mass.append(0.0)
            found.centre.append(np.zeros(3))
            found.inertia.append(np.zeros((3, 3)))
            _gather(found, _end(joint, "child"), len(found.names) - 1, np.eye(3), np.zeros(3), links, joints, below)
        else:
            _gather(found, _end(joint, "child"), at, turned, there, links, joints, below)


def _weigh(found: _Links, at: int, link: Element, turn: Floats, place: Floats) -> None:
    """Adds what a link weighs to the moving one that it is a part of."""
    inertial = link.find("inertial")
    if inertial is None:
        return
    offset, own = _origin(inertial)
    mass = float(_numbers(inertial.find("mass"), "value", (0.0,))[0])
    tag = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (float(_numbers(tag, f"i{ij}", (0.0,))[0]) for ij in ("xx", "xy", "xz", "yy", "yz", "zz"))
    turned = turn @ own
    inertia = turned @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turned.T
    centre = place + turn @ offset
    before, together = found.mass[at], found.mass[at] + mass
    if not together > 0:
        return
    middle = (before * found.centre[at] + mass * centre) / together
    found.inertia[at] = (
        found.inertia[at] + inertia + _point(before, found.centre[at] - middle) + _point(mass, centre - middle)
    )
    found.mass[at], found.centre[at] = together, middle


def _point(mass: float, r: Floats) -> Floats:
    """(3, 3) inertia of a point at r [m]."""
    found: Floats = mass * (r @ r * np.eye(3) - np.outer(r, r))
    return found


def _about(axis: Floats, angle: Floats) -> Floats:
    """(N, 3, 3) turns about an axis (3,) by angles (N,)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    found: Floats = np.eye(3) + s * cross + (1 - c) * (cross @ cross)
    return found


def _back(turn: Floats, v: Floats) -> Floats:
    """Rᵀ v of each row (N, 3)."""
    found: Floats = (v[:, None, :] @ turn)[:, 0, :]
    return found


def _root(urdf: str) -> Element:
    """Raises ValueError where it is no URDF; entities, that could grow without end, are none either."""
    if "<!DOCTYPE" in urdf:
        raise ValueError("the body is no URDF: it declares a document type")
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"the body is no URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"the body is no URDF: its root is <{root.tag}>, not <robot>")
    return root


def _text(element: Element, name: str) -> str:
    if not (found := element.get(name)):
        raise ValueError(f"a <{element.tag}> of the body has no {name}")
    return found


def _end(joint: Element, which: str) -> str:
    end = joint.find(which)
    if end is None:
        raise ValueError(f"joint {joint.get('name')} of the body has no <{which}>")
    return _text(end, "link")


def _origin(element: Element) -> tuple[Floats, Floats]:
    """Offset (3,) and turn (3, 3) from roll, pitch and yaw."""
    origin = element.find("origin")
    offset, (roll, pitch, yaw) = (_numbers(origin, name, (0.0, 0.0, 0.0)) for name in ("xyz", "rpy"))
    x, y, z = (_about(np.eye(3)[k], np.array([angle]))[0] for k, angle in enumerate((roll, pitch, yaw)))
    return offset, z @ y @ x


def _numbers(element: Element | None, name: str, default: tuple[float, ...]) -> Floats:
    """Raises ValueError unless it is as many finite numbers as the default."""
    said = None if element is None else element.get(name)
    if said is None:
        return np.array(default)
    try:
        found = np.array([float(word) for word in said.split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (len(default),) or not np.isfinite(found).all():
        raise ValueError(f"{name}={said!r} of the body should be {len(default)} numbers")
    return found
