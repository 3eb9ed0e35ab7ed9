"""Compute the torques that an arm's own links ask of its joints, from its body model (URDF), by MuJoCo.

    τ = g(q) + [M(q) q̈ + c(q, q̇)]      weight, and motion

Joints that no column senses are fixed at 0, and so are joints that mimic others. Damping, friction and limits of the
file are left out. MuJoCo comes with the extra ``robosuite``.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from asm_gym.extras import require

Floats = NDArray[np.float64]

LARGEST = 10_000_000  # characters of a file: no arm has more

MOVING = ("revolute", "continuous", "prismatic")

KEPT = {
    "joint": ("origin", "parent", "child", "axis", "mimic"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
}
"""Parts of a body model that weight and inertia need."""

COMPILER = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-12", "boundinertia": "1e-12"}
"""MuJoCo takes links without a mass as nearly massless, and mends a tensor that no body can have."""


@dataclass(frozen=True)
class BodyModel:
    """The joints of an arm that are sensed, and the links that they move."""

    names: tuple[str, ...]  # (J,) of the joints, from the base outwards
    columns: NDArray[np.intp]  # (J,) which column of ``torques`` belongs to each joint
    model: Any  # MuJoCo's

    @classmethod
    def of(cls, urdf: str, labels: Sequence[str]) -> Self:
        """Read a URDF for the joints that labels name (``position[elbow]``), or the first ones of its longest chain.

        Raises:
            ValueError: it is no URDF, MuJoCo cannot read it, or it has fewer joints than there are labels.
        """
        root = _parsed(urdf)
        every = _compiled(root, None)
        names = _joints(every)
        # Each label names a joint by the longest name in it, if all name one of their own.
        asked = [max((n for n in names if n in label), key=len, default="") for label in labels]
        if not all(asked) or len(set(asked)) < len(asked):
            asked = [names[j] for j in _longest_chain(every)[: len(labels)]]
        if len(asked) < len(labels):
            raise ValueError(
                f"{len(labels)} joints are sensed, and the body's longest chain has {len(asked)} that move"
            )
        model = _compiled(root, asked)
        order = _joints(model)
        return cls(tuple(order), np.array([asked.index(name) for name in order], np.intp), model)

    def torques(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """Return the torques (N, J) of weight and of motion [N m; N where a joint slides].

        They are those of angles ``q`` (N, J) [rad or m], speeds [1/s of that] and accelerations [1/s² of that].
        """
        mujoco = _mujoco()
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


def _mujoco() -> Any:
    return require("mujoco", what="a body model")


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
    return pared


def _pared(element: Element) -> Element:
    made = Element(element.tag, dict(element.attrib))
    made.extend(_pared(part) for part in element if part.tag in KEPT.get(element.tag, ()))
    return made


def _compiled(root: Element, asked: Container[str] | None) -> Any:
    """MuJoCo's model, in which the joints that are asked for move, or all that can."""
    body = deepcopy(root)
    for joint in body.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            joint.remove(mimic)
        moves = joint.get("type") in MOVING and mimic is None
        if not moves or (asked is not None and joint.get("name") not in asked):
            joint.set("type", "fixed")
    for inertial in body.iter("inertial"):
        _align(inertial)
    ElementTree.SubElement(ElementTree.SubElement(body, "mujoco"), "compiler", COMPILER)
    try:
        model = _mujoco().MjModel.from_xml_string(ElementTree.tostring(body, encoding="unicode"))
    except ValueError as error:
        raise ValueError(f"the body cannot be read: {' '.join(str(error).split())}") from None
    if not all(np.isfinite(part).all() for part in (model.body_mass, model.body_inertia, model.body_pos)):
        raise ValueError("the body cannot be read: masses, inertias and positions must be finite")
    return model


def _align(inertial: Element) -> None:
    """Turn a tensor into its link's axes, for MuJoCo leaves ``rpy`` of an inertial out."""
    origin, tensor = inertial.find("origin"), inertial.find("inertia")
    if origin is None or tensor is None or not (rpy := origin.attrib.pop("rpy", "")):
        return
    from scipy.spatial.transform import Rotation  # takes a while to import

    turn = Rotation.from_euler("xyz", [float(word) for word in rpy.split()]).as_matrix()
    pairs = [(i, j, f"i{'xyz'[i]}{'xyz'[j]}") for i in range(3) for j in range(i, 3)]
    inertia = np.zeros((3, 3))
    for i, j, name in pairs:
        inertia[i, j] = inertia[j, i] = float(tensor.get(name, 0.0))
    inertia = turn @ inertia @ turn.T
    for i, j, name in pairs:
        tensor.set(name, repr(float(inertia[i, j])))


def _joints(model: Any) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _longest_chain(model: Any) -> list[int]:
    """The joints of the longest chain, from the base outwards."""
    chains: dict[int, list[int]] = {0: []}
    for body in range(1, model.nbody):  # parents come first
        own = [int(model.body_jntadr[body])] if model.body_jntnum[body] else []
        chains[body] = chains[int(model.body_parentid[body])] + own
    return max(chains.values(), key=len)
