r"""What an arm's links weigh on its joints, by the body model that came with it (URDF): gravity, and inertia.

    τ = g(q) + [M(q) q̈ + c(q, q̇)]      each joint's torque by recursive Newton-Euler, links from the base outwards

    ω_i = ω_p + q̇ z,   ω̇_i = ω̇_p + q̈ z + ω_p × q̇ z              where joint i of parent p turns about z
    a_i = a_p + ω̇_p × r + ω_p × (ω_p × r),   a_base = -gravity     r: from joint p to joint i
    f_i = m (a_i + ω̇_i × c + ω_i × (ω_i × c)) + Σ f_child          c: from the joint to the centre of mass
    n_i = I ω̇_i + ω_i × I ω_i + c × m (…) + Σ (n_child + r × f_child),   τ_i = z · n_i

All in the frame of the base. What does not move against a link is a part of it; so is what moves by a joint that nobody
senses, which stands at 0.

Source: Luh, Walker and Paul 1980 (Journal of Dynamic Systems, Measurement, and Control 102).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled

Floats = NDArray[np.float64]

GRAVITY = 9.81
"""Downwards along the base's z [m/s²]."""

LARGEST, MOST_JOINTS = 10_000_000, 200
"""Characters of a file, and joints: no arm has more."""

TURNS, SLIDES = ("revolute", "continuous"), ("prismatic",)


KEPT = ("parent", "turn", "place", "axis", "slides", "mass", "centre", "inertia")
"""What is known of a link that moves."""


class BodyModel(NamedTuple):
    """The links of an arm that move, from the base outwards.

    Attributes:
        names: (J,) of the joint that moves each.
        columns: (J,) which column of what it is told is of each.
        parent: (J,) which link each stands on; -1 is the base.
        turn, place: (J, 3, 3) and (J, 3) where a joint stands in its parent's frame [m].
        axis: (J, 3) of the joint, in its own frame.
        slides: (J,) whether a joint slides and does not turn.
        mass, centre, inertia: (J,) [kg], (J, 3) [m], (J, 3, 3) about the centre [kg m²].
    """

    names: tuple[str, ...]
    columns: NDArray[np.intp]
    parent: NDArray[np.intp]
    turn: Floats
    place: Floats
    axis: Floats
    slides: NDArray[np.bool_]
    mass: Floats
    centre: Floats
    inertia: Floats

    @classmethod
    def of(cls, urdf: str, labels: Sequence[str]) -> Self:
        """By a URDF's text, of the joints that labels name, or else the first of the longest chain of joints.

        Raises:
            ValueError: it is no URDF, its joints are no tree, or it has fewer joints than there are labels.
        """
        root = _root(urdf)
        every = _moving(root, None)
        names = [link.name for link in every]
        asked = _by_name(names, labels) or _longest([link.parent for link in every])[: len(labels)]
        if len(asked) < len(labels):
            raise ValueError(
                f"{len(labels)} joints are sensed, and the body's longest chain has {len(asked)} that move"
            )
        told = [names[i] for i in asked]
        links = _moving(root, told)
        parts = {n: np.array([getattr(link, n) for link in links]) for n in KEPT}
        columns = np.array([told.index(link.name) for link in links], np.intp)
        return cls(tuple(link.name for link in links), columns, **parts)

    def torques(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """By weight and by motion, (N, J) each, for what the J joints do (N, J)."""
        x, v, a = (np.ascontiguousarray(part[:, self.columns], np.float64) for part in (q, speed, acceleration))
        still, links = np.zeros_like(x), self[2:]
        weight, motion = np.zeros(q.shape), np.zeros(q.shape)
        weight[:, self.columns] = newton_euler(x, still, still, GRAVITY, links)
        motion[:, self.columns] = newton_euler(x, v, a, 0.0, links)
        return weight, motion


@compiled
def newton_euler(q: Any, speed: Any, acceleration: Any, gravity: float, links: Any) -> Any:
    """(N, J) torques and forces of the joints; see the top of this file. ``links`` are what ``KEPT`` names."""
    parent, turn, place, axis, slides, mass, centre, inertia = links
    N, J = q.shape
    found, R = np.zeros((N, J)), np.zeros((J, 3, 3))
    at, z, spin, spun, moved, force, moment = [np.zeros((J, 3)) for _ in range(7)]
    for n in range(N):
        for i in range(J):
            p = parent[i]
            base = p < 0
            stand = turn[i] if base else _product(R[p], turn[i])
            r = place[i] if base else _times(R[p], place[i])
            z[i] = _times(stand, axis[i])
            x, v, a = q[n, i], speed[n, i], acceleration[n, i]
            if slides[i]:
                R[i], r = stand, r + x * z[i]
            else:
                R[i] = _product(stand, _turn(axis[i], x))
            if base:
                at[i], moved[i], spin[i], spun[i] = r, np.array([0.0, 0.0, gravity]), 0.0, 0.0
            else:
                at[i] = at[p] + r
                moved[i] = moved[p] + _cross(spun[p], r) + _cross(spin[p], _cross(spin[p], r))
                spin[i], spun[i] = spin[p], spun[p]
            if slides[i]:
                moved[i] += a * z[i] + 2.0 * v * _cross(spin[i], z[i])
            else:
                spun[i] += a * z[i] + v * _cross(spin[i], z[i])
                spin[i] += v * z[i]
            c = _times(R[i], centre[i])
            force[i] = mass[i] * (moved[i] + _cross(spun[i], c) + _cross(spin[i], _cross(spin[i], c)))
            turned = _product(_product(R[i], inertia[i]), R[i].T)
            moment[i] = _times(turned, spun[i]) + _cross(spin[i], _times(turned, spin[i])) + _cross(c, force[i])
        for i in range(J - 1, -1, -1):
            found[n, i] = (z[i] * (force[i] if slides[i] else moment[i])).sum()
            p = parent[i]
            if p >= 0:
                force[p] += force[i]
                moment[p] += moment[i] + _cross(at[i] - at[p], force[i])
    return found


@compiled
def _cross(a: Any, b: Any) -> Any:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@compiled
def _times(matrix: Any, v: Any) -> Any:
    found = np.zeros(3)
    for i in range(3):
        found[i] = matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2]
    return found


@compiled
def _product(a: Any, b: Any) -> Any:
    found = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            found[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return found


@compiled
def _turn(axis: Any, angle: float) -> Any:
    """(3, 3) about an axis."""
    s, c = np.sin(angle), np.cos(angle)
    found = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            found[i, j] = (1.0 - c) * axis[i] * axis[j] + (c if i == j else 0.0)
    found[0, 1] -= s * axis[2]
    found[1, 0] += s * axis[2]
    found[0, 2] += s * axis[1]
    found[2, 0] -= s * axis[1]
    found[1, 2] -= s * axis[0]
    found[2, 1] += s * axis[0]
    return found


def read_urdf(path: str | Path) -> str:
    """The text of a body model, pared to its joints and to what the links weigh.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no URDF.
    """
    with Path(path).open(encoding="utf-8", errors="replace") as file:
        text = file.read(LARGEST)
    try:
        root = _root(text)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    pared = Element("robot", name=root.get("name", ""))
    for joint in root.findall("joint"):
        _copied(joint, pared, ("origin", "parent", "child", "axis", "mimic"), ("name", "type"))
    for link in root.findall("link"):
        made = _copied(link, pared, (), ("name",))
        for inertial in link.findall("inertial"):
            _copied(inertial, made, ("origin", "mass", "inertia"), ())
    return ElementTree.tostring(pared, encoding="unicode")


def _copied(element: Element, under: Element, parts: Sequence[str], attributes: Sequence[str]) -> Element:
    """The same element under another, with those attributes and parts alone."""
    made = ElementTree.SubElement(under, element.tag, {n: v for n in attributes if (v := element.get(n)) is not None})
    for part in (p for p in element if p.tag in parts):
        ElementTree.SubElement(made, part.tag, dict(part.attrib))
    return made


def _by_name(names: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Which joint each column names, by the longest name in it; none unless each names one of its own."""
    named = [max((n for n in names if n in column), key=len, default="") for column in columns]
    return [names.index(n) for n in named] if all(named) and len(set(named)) == len(named) else []


def _longest(parents: Sequence[int]) -> list[int]:
    """The links of the longest chain, from the base outwards."""
    chains: list[list[int]] = []
    for i, parent in enumerate(parents):
        chains.append([*(chains[parent] if parent >= 0 else []), i])
    return max(chains, key=len, default=[])


@dataclass
class _Link:
    """One that moves, and all that it carries."""

    name: str
    parent: int
    turn: Floats
    place: Floats
    axis: Floats
    slides: bool
    mass: float = 0.0
    centre: Floats = field(default_factory=lambda: np.zeros(3))
    inertia: Floats = field(default_factory=lambda: np.zeros((3, 3)))

    def carry(self, link: Element, turn: Floats, place: Floats) -> None:
        """Adds what a link weighs that stands so in its frame."""
        inertial = link.find("inertial")
        if inertial is None:
            return
        offset, own = _origin(inertial)
        mass = float(_numbers(inertial.find("mass"), "value", (0.0,))[0])
        xx, xy, xz, yy, yz, zz = (
            float(_numbers(inertial.find("inertia"), f"i{ij}", (0.0,))[0])
            for ij in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        turned, centre, together = turn @ own, place + turn @ offset, self.mass + mass
        if not together > 0:
            return
        middle = (self.mass * self.centre + mass * centre) / together
        own_inertia = turned @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turned.T
        self.inertia = (
            self.inertia + own_inertia + _point(self.mass, self.centre - middle) + _point(mass, centre - middle)
        )
        self.mass, self.centre = together, middle


def _moving(root: Element, told: Container[str] | None) -> list[_Link]:
    """The links that move by those joints, or by any, each after the one that it stands on."""
    links = {_text(link, "name"): link for link in root.findall("link")}
    below: dict[str, list[Element]] = {}
    joints = root.findall("joint")
    for joint in joints:
        below.setdefault(_end(joint, "parent"), []).append(joint)
    ends = {_end(joint, "child") for joint in joints}
    bases = [name for name in links if name not in ends]
    no_tree = ValueError(
        f"the joints of the body are no tree of at most {MOST_JOINTS} with one base: {len(joints)} joints, "
        f"{len(links)} links, of which no joint moves {', '.join(bases[:5]) or 'none'}"
    )
    if len(bases) != 1 or len(ends) != len(joints) or not ends <= set(links) or len(joints) > MOST_JOINTS:
        raise no_tree
    found, seen = list[_Link](), 0
    waiting = [(bases[0], -1, np.eye(3), np.zeros(3))]  # a link, on which moving one it stands, and how
    while waiting:
        name, on, turn, place = waiting.pop(0)
        seen += 1
        if on >= 0:
            found[on].carry(links[name], turn, place)
        for joint in below.get(name, ()):
            offset, own = _origin(joint)
            there, turned, moved = place + turn @ offset, turn @ own, _end(joint, "child")
            if not _moves(joint) or (told is not None and joint.get("name") not in told):
                waiting.append((moved, on, turned, there))
                continue
            axis = _numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
            if not (length := np.linalg.norm(axis)) > 0:
                raise ValueError(f"the axis of joint {joint.get('name')} has no direction")
            found.append(_Link(_text(joint, "name"), on, turned, there, axis / length, joint.get("type") in SLIDES))
            waiting.append((moved, len(found) - 1, np.eye(3), np.zeros(3)))
    if seen != len(links):
        raise no_tree
    return found


def _moves(joint: Element) -> bool:
    """Whether it does so by itself."""
    return joint.get("type") in (*TURNS, *SLIDES) and joint.find("mimic") is None


def _point(mass: float, r: Floats) -> Floats:
    """(3, 3) inertia of a point at r [m]."""
    found: Floats = mass * (r @ r * np.eye(3) - np.outer(r, r))
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
    about_x, about_y, about_z = (_turn(axis, angle) for axis, angle in zip(np.eye(3), (roll, pitch, yaw), strict=True))
    return offset, about_z @ about_y @ about_x


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
