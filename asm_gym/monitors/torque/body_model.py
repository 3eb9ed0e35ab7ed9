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
from typing import Any, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from asm_gym.extras import require
from asm_gym.monitors.torque.urdf import parsed_urdf

Floats = NDArray[np.float64]

COMPARED_ROWS = 300  # rows by which orders of joints are compared
LEAST_SPREAD = 1e-12  # of a speed, and least variance of a torque
STEEPNESS = 10.0  # of the friction that orders of joints are compared with, in spreads of a speed
SHORTER = 1e-3  # what each further word of a joint's name takes from its score

MOVING = ("revolute", "continuous", "prismatic")

COMPILER = {"fusestatic": False, "balanceinertia": True, "boundmass": 1e-12, "boundinertia": 1e-12}
"""MuJoCo takes links without a mass as nearly massless, and mends a tensor that no body can have."""


@dataclass(frozen=True)
class BodyModel:
    """The joints of an arm that are sensed, and the links that they move.

    Attributes:
        names: (M,) names of the joints, from the base outwards.
        columns: (M,) which of the J columns of ``torques`` belongs to each joint.
        by_name: the columns are named as the joints are; otherwise they are taken in the order of the chain.
        model: MuJoCo's.
    """

    names: tuple[str, ...]
    columns: NDArray[np.intp]
    by_name: bool
    model: Any

    @classmethod
    def of(cls, urdf: str, labels: Sequence[str]) -> Self:
        """Read a URDF for the joints that labels name (``position[elbow]``), or the first ones of its longest chain.

        Labels that name no joint, as those of fingers, belong to no joint where most do.

        Raises:
            ValueError: it is no URDF, MuJoCo cannot read it, or it has fewer joints than there are labels.
        """
        root = parsed_urdf(urdf)
        whole = _compiled(root)
        columns = _columns_by_name(_joint_names(whole), labels)
        by_name = 2 * len(columns) > len(labels)
        if not by_name:
            columns = _columns_by_chain(whole, len(labels))
        model = _compiled(root, columns)
        names = _joint_names(model)
        places = np.array([columns[name] for name in names], np.intp)
        return cls(names=tuple(names), columns=places, by_name=by_name, model=model)

    def in_best_order(self, q: Floats, speed: Floats, acceleration: Floats, torque: Floats) -> Self:
        """Return it with the order of columns that explains measured torques (N, J) best: of the chain, or ABC."""
        rows = np.linspace(0, len(q) - 1, min(len(q), COMPARED_ROWS)).astype(np.intp)
        moving = speed[rows]
        measured = torque[rows]
        spread = np.maximum(moving.std(axis=0), LEAST_SPREAD)
        friction = (moving, np.tanh(STEEPNESS * moving / spread), np.ones_like(moving))
        variance = np.maximum(measured.var(axis=0), LEAST_SPREAD)

        def unexplained(body: Self) -> float:
            weight, motion = body.torques(q[rows], moving, acceleration[rows])
            inputs = np.stack([weight, motion, *friction], axis=-1)  # (N, J, 5)
            rest = measured - np.einsum("njk,jk->nj", inputs, joint_weights(inputs, measured))
            return float((rest.var(axis=0) / variance).sum())

        by_alphabet = replace(self, columns=np.argsort(np.argsort(self.names)))
        return min(self, by_alphabet, key=unexplained)

    def torques(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """Return the torques (N, J) of weight and of motion [N m; N where a joint slides].

        They are those of angles ``q`` (N, J) [rad or m], speeds [1/s of that] and accelerations [1/s² of that].
        """
        mujoco: Any = require("mujoco", what="a body model")
        data = mujoco.MjData(self.model)
        weight = np.zeros(q.shape)
        total = np.zeros(q.shape)
        for n in range(len(q)):
            data.qpos[:] = q[n, self.columns]
            data.qvel[:] = 0.0
            data.qacc[:] = 0.0
            mujoco.mj_inverse(self.model, data)
            weight[n, self.columns] = data.qfrc_inverse

            data.qvel[:] = speed[n, self.columns]
            data.qacc[:] = acceleration[n, self.columns]
            mujoco.mj_inverse(self.model, data)
            total[n, self.columns] = data.qfrc_inverse
        return weight, total - weight


def joint_weights(inputs: Floats, torque: Floats) -> Floats:
    """Return the weights (J, K) that predict the torque (N, J) of each joint best from its inputs (N, J, K)."""
    joints = range(torque.shape[1])
    return np.array([np.linalg.lstsq(inputs[:, j], torque[:, j], rcond=None)[0] for j in joints])


def _compiled(root: Element, asked: Container[str] | None = None) -> Any:
    """Return MuJoCo's model, in which the joints that are asked for move, or all that can."""
    mujoco: Any = require("mujoco", what="a body model")
    moving = [joint.get("name") for joint in root.findall("joint") if _moves(joint)]
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        for name, value in COMPILER.items():
            setattr(spec.compiler, name, value)
        for joint in list(spec.joints):
            if joint.name not in moving or (asked is not None and joint.name not in asked):
                spec.delete(joint)
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"the body cannot be read: {' '.join(str(error).split())}") from None
    parts = (model.body_mass, model.body_inertia, model.body_pos)
    if not all(np.isfinite(part).all() for part in parts):
        raise ValueError("the body cannot be read: masses, inertias and positions must be finite")
    return model


def _moves(joint: Element) -> bool:
    """Return whether a joint moves by itself."""
    return joint.get("type") in MOVING and joint.find("mimic") is None


def _joint_names(model: Any) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _columns_by_name(names: Sequence[str], labels: Sequence[str]) -> dict[str, int]:
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
            score[k, j] += len(name) * (name in label) - SHORTER * len(words[j])

    columns = {}
    for k, j in zip(*linear_sum_assignment(-score), strict=True):
        if score[k, j] > np.delete(score[k], j).max(initial=0.0):  # no other joint is meant as much
            columns[names[j]] = int(k)
    return columns


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+\d*|\d+", name.lower()))


def _columns_by_chain(model: Any, count: int) -> dict[str, int]:
    """Return the place of each of the first joints of the longest chain.

    Raises ValueError where they are too few.
    """
    chain = _longest_chain(model)[:count]
    names = _joint_names(model)
    if len(chain) < count:
        raise ValueError(
            f"{count} joints are sensed, and the body's longest chain has {len(chain)} that move: "
            f"name the columns as its joints are named ({', '.join(names) or 'it has none'})"
        )
    return {names[joint]: place for place, joint in enumerate(chain)}


def _longest_chain(model: Any) -> list[int]:
    """Return the joints of the longest chain, from the base outwards."""
    chains: dict[int, list[int]] = {0: []}
    for body in range(1, model.nbody):  # parents come first
        chains[body] = list(chains[int(model.body_parentid[body])])
        if model.body_jntnum[body]:
            chains[body].append(int(model.body_jntadr[body]))
    return max(chains.values(), key=len)
