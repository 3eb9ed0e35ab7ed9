"""Compute the torques that an arm's own links ask of its joints, from its body model (URDF), by MuJoCo.

    τ = g(q) + [M(q) q̈ + c(q, q̇)]      weight, and motion

Joints that no column senses are fixed at 0, and so are joints that mimic others. Damping, friction and limits of the
file are left out, and so are its meshes; several roots stand side by side. MuJoCo comes with the extra ``robosuite``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from asm_gym.extras import require

Floats = NDArray[np.float64]

LARGEST = 10_000_000  # characters of a file: no arm has more

SHOWN = 300  # rows by which orders of joints are compared
TINY, SHORTER = 1e-12, 1e-3

MOVING = ("revolute", "continuous", "prismatic")

KEPT = {
    "joint": ("origin", "parent", "child", "axis", "mimic"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
}
"""Parts of a body model that weight and inertia need."""

COMPILER = {"fusestatic": False, "balanceinertia": True, "boundmass": 1e-12, "boundinertia": 1e-12}
"""MuJoCo takes links without a mass as nearly massless, and mends a tensor that no body can have."""


@dataclass(frozen=True)
class BodyModel:
    """The joints of an arm that are sensed, and the links that they move."""

    names: tuple[str, ...]  # (M,) of the joints, from the base outwards
    columns: NDArray[np.intp]  # (M,) which of the J columns of ``torques`` belongs to each joint
    by_name: bool  # the columns are named as the joints are; otherwise they are taken in the order of the chain
    model: Any  # MuJoCo's

    @classmethod
    def of(cls, urdf: str, labels: Sequence[str]) -> Self:
        """Read a URDF for the joints that labels name (``position[elbow]``), or the first ones of its longest chain.

        Labels that name no joint, as those of fingers, belong to no joint where most do.

        Raises:
            ValueError: it is no URDF, MuJoCo cannot read it, or it has fewer joints than there are labels.
        """
        root = _parsed(urdf)
        every, names = _compiled(root, None)
        place = _matched(names, labels)
        by_name = 2 * len(place) > len(labels)
        if not by_name:
            place = {names[j]: k for k, j in enumerate(_longest_chain(every)[: len(labels)])}
            if len(place) < len(labels):
                raise ValueError(
                    f"{len(labels)} joints are sensed, and the body's longest chain has {len(place)} that move: name "
                    f"the columns as its joints are named ({', '.join(names) or 'it has none'})"
                )
        model, order = _compiled(root, place)
        return cls(tuple(order), np.array([place[name] for name in order], np.intp), by_name, model)

    def in_best_order(self, q: Floats, speed: Floats, acceleration: Floats, torque: Floats) -> Self:
        """Return it with the order of columns that explains measured torques (N, J) best: of the chain, or ABC."""
        rows = np.linspace(0, len(q) - 1, min(len(q), SHOWN)).astype(np.intp)
        q, speed, acceleration, torque = (a[rows] for a in (q, speed, acceleration, torque))
        friction = np.stack(
            [speed, np.tanh(10 * speed / np.maximum(speed.std(axis=0), TINY)), np.ones_like(speed)]
        )

        def unexplained(model: Self) -> float:
            # (N, J, 5)
            inputs = np.stack([*model.torques(q, speed, acceleration), *friction], axis=-1)
            solved = [
                np.linalg.lstsq(inputs[:, j], torque[:, j], rcond=None)[0]
                for j in range(torque.shape[1])
            ]
            left = torque - np.einsum("njk,jk->nj", inputs, solved)
            return float((left.var(axis=0) / np.maximum(torque.var(axis=0), TINY)).sum())

        by_alphabet = replace(self, columns=np.argsort(np.argsort(self.names)))
        return min(self, by_alphabet, key=unexplained)

    def torques(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """Return the torques (N, J) of weight and of motion [N m; N where a joint slides].

        They are those of angles ``q`` (N, J) [rad or m], speeds [1/s of that] and accelerations [1/s² of that].
        """
        mujoco: Any = require("mujoco", what="a body model")
        data, at = mujoco.MjData(self.model), self.columns
        weight, total = np.zeros(q.shape), np.zeros(q.shape)
        for n in range(len(q)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[n, at], 0.0, 0.0
            mujoco.mj_inverse(self.model, data)
            weight[n, at] = data.qfrc_inverse
            data.qvel[:], data.qacc[:] = speed[n, at], acceleration[n, at]
            mujoco.mj_inverse(self.model, data)
            total[n, at] = data.qfrc_inverse
        return weight, total - weight


def read_urdf(path: str | Path) -> str:
    """Return the text of a body model, pared to its joints and the inertia of its links; ValueError if it is none."""
    with Path(path).open(encoding="utf-8", errors="replace") as file:
        text = file.read(LARGEST)
    try:
        return ElementTree.tostring(_parsed(text), encoding="unicode")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _matched(names: Sequence[str], labels: Sequence[str]) -> dict[str, int]:
    """Return the place of the label that means each joint, by the words that the two share.

    A word counts the less, the more joints have it; a name that stands in a label as it is counts most. Of two that
    share as much with a label, as a joint of the arm and one of its fingers may, the shorter one is meant.
    """
    words = [_words(name) for name in names]
    common = Counter(word for own in words for word in own)
    score = np.zeros((len(labels), len(names)))
    for k, label in enumerate(labels):
        for j, name in enumerate(names):
            score[k, j] = sum(1.0 / common[word] for word in _words(label) & words[j])
            score[k, j] += (len(name) if name in label else 0.0) - SHORTER * len(words[j])
    found = {}
    for k, j in zip(*linear_sum_assignment(-score), strict=True):
        if score[k, j] > np.delete(score[k], j).max(initial=0.0):  # no other joint is meant as much
            found[names[j]] = int(k)
    return found


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+\d*|\d+", name.lower()))


def _parsed(urdf: str) -> Element:
    """The pared tree; entities, which could grow without end, are refused."""
    if "<!DOCTYPE" in urdf:
        raise ValueError("the body is no URDF: it declares a document type")
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"the body is no URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"the body is no URDF: its root is <{root.tag}>, not <robot>")
    pared = Element("robot", name=root.get("name", ""))
    pared.extend(_pared(element) for element in root if element.tag in ("link", "joint"))
    for inertial in pared.iter("inertial"):
        _mend(inertial)
    return pared


def _pared(element: Element) -> Element:
    made = Element(element.tag, dict(element.attrib))
    made.extend(_pared(part) for part in element if part.tag in KEPT.get(element.tag, ()))
    return made


def _compiled(root: Element, asked: Container[str] | None) -> tuple[Any, list[str]]:
    """Return MuJoCo's model, in which the joints that are asked for move, or all that can; and their names."""
    mujoco: Any = require("mujoco", what="a body model")
    fixed = {
        joint.get("name")
        for joint in root.findall("joint")
        if joint.get("type") not in MOVING
        or joint.find("mimic") is not None
        or (asked is not None and joint.get("name") not in asked)
    }
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        for name, value in COMPILER.items():
            setattr(spec.compiler, name, value)
        for joint in list(spec.joints):
            if joint.name in fixed:
                spec.delete(joint)
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"the body cannot be read: {' '.join(str(error).split())}") from None
    if not all(
        np.isfinite(part).all() for part in (model.body_mass, model.body_inertia, model.body_pos)
    ):
        raise ValueError("the body cannot be read: masses, inertias and positions must be finite")
    return model, [model.joint(j).name for j in range(model.njnt)]


def _mend(inertial: Element) -> None:
    """Turn a tensor into its link's axes, for MuJoCo leaves ``rpy`` of an inertial out, and make it positive."""
    origin, tensor = inertial.find("origin"), inertial.find("inertia")
    if tensor is None:
        return
    from scipy.spatial.transform import Rotation  # takes a while to import

    rpy = "" if origin is None else origin.attrib.pop("rpy", "")
    turn = Rotation.from_euler(
        "xyz", [float(word) for word in (rpy or "0 0 0").split()]
    ).as_matrix()
    names = [[f"i{'xyz'[min(i, j)]}{'xyz'[max(i, j)]}" for j in range(3)] for i in range(3)]
    inertia = (
        turn @ np.array([[float(tensor.get(name, 0.0)) for name in row] for row in names]) @ turn.T
    )
    if np.isfinite(inertia).all():
        moments, axes = np.linalg.eigh(inertia)
        inertia = axes * np.maximum(moments, TINY) @ axes.T
    for name, value in zip(np.ravel(names), inertia.ravel(), strict=True):
        tensor.set(str(name), repr(float(value)))


def _longest_chain(model: Any) -> list[int]:
    """The joints of the longest chain, from the base outwards."""
    chains: dict[int, list[int]] = {0: []}
    for body in range(1, model.nbody):  # parents come first
        own = [int(model.body_jntadr[body])] if model.body_jntnum[body] else []
        chains[body] = chains[int(model.body_parentid[body])] + own
    return max(chains.values(), key=len)
