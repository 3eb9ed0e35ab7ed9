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
from typing import Any, NamedTuple, Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from asm_gym.extras import require
from asm_gym.monitors.torque.urdf import parsed_urdf

Floats = NDArray[np.float64]

COMPARED_ROWS = 300  # rows by which orders of joints are compared
LEAST_VARIATION = 1e-12  # spread of a speed, and variance of a torque
STEEPNESS = 10.0  # of the friction that orders of joints are compared with, in spreads of a speed
WORD_PENALTY = 1e-3  # what each word of a joint's name takes from its score

MOVING_TYPES = ("revolute", "continuous", "prismatic")

COMPILER = {"fusestatic": False, "balanceinertia": True, "boundmass": 1e-12, "boundinertia": 1e-12}
"""MuJoCo takes links without a mass as nearly massless, and mends a tensor that no body can have."""


class JointMotion(NamedTuple):
    """Motion of J joints in N rows."""

    angle: Floats  # (N, J) [rad; m where a joint slides]
    speed: Floats  # (N, J) [1/s of that]
    acceleration: Floats  # (N, J) [1/s² of that]; 0 where speeds are changes of angles


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
        all_joints = _compiled(root, _moving_joints(root))
        columns = _columns_by_name(_joint_names(all_joints), labels)
        by_name = 2 * len(columns) > len(labels)
        if not by_name:
            columns = _columns_by_chain(all_joints, len(labels))
        model = _compiled(root, columns)
        names = _joint_names(model)
        in_order = [columns[name] for name in names]
        return cls(tuple(names), np.array(in_order, np.intp), by_name=by_name, model=model)

    def in_best_order(self, motion: JointMotion, torque: Floats) -> Self:
        """Return it with the order of columns that explains measured torques (N, J) best.

        Columns are in the order of the chain, or in that of the alphabet.
        """
        last = len(torque) - 1
        rows = np.linspace(0, last, min(len(torque), COMPARED_ROWS)).astype(np.intp)
        compared = JointMotion._make(part[rows] for part in motion)
        alphabetical = replace(self, columns=np.argsort(np.argsort(self.names)))
        return min(self, alphabetical, key=lambda body: body._unexplained(compared, torque[rows]))

    def _unexplained(self, motion: JointMotion, torque: Floats) -> float:
        """Return the share of each torque's variance that body and friction leave, summed over joints."""
        spread = np.maximum(motion.speed.std(axis=0), LEAST_VARIATION)
        friction = np.tanh(STEEPNESS * motion.speed / spread)
        parts = [*self.torques(motion), motion.speed, friction, np.ones_like(friction)]
        inputs = np.stack(parts, axis=-1)  # (N, J, 5)
        rest = torque - explained_torque(inputs, joint_weights(inputs, torque))
        variance = np.maximum(torque.var(axis=0), LEAST_VARIATION)
        return float((rest.var(axis=0) / variance).sum())

    def torques(self, motion: JointMotion) -> tuple[Floats, Floats]:
        """Return the torques (N, J) of weight and of motion [N m; N where a joint slides]."""
        mujoco: Any = require("mujoco", what="a body model")
        data = mujoco.MjData(self.model)
        weight = np.zeros(motion.angle.shape)
        total = np.zeros(motion.angle.shape)
        for n in range(len(weight)):
            data.qpos[:] = motion.angle[n, self.columns]
            data.qvel[:] = 0.0
            data.qacc[:] = 0.0
            mujoco.mj_inverse(self.model, data)
            weight[n, self.columns] = data.qfrc_inverse

            data.qvel[:] = motion.speed[n, self.columns]
            data.qacc[:] = motion.acceleration[n, self.columns]
            mujoco.mj_inverse(self.model, data)
            total[n, self.columns] = data.qfrc_inverse
        return weight, total - weight


def joint_weights(inputs: Floats, torque: Floats) -> Floats:
    """Return the weights (J, K) that predict the torque (N, J) of each joint best from its inputs (N, J, K)."""
    weights = []
    for joint, measured in enumerate(torque.T):
        solution = np.linalg.lstsq(inputs[:, joint], measured, rcond=None)
        weights.append(solution[0])
    return np.array(weights)


def explained_torque(inputs: Floats, weights: Floats) -> Floats:
    """Return the torque (N, J) that weights (J, K) predict from the inputs (N, J, K) of each joint."""
    return np.einsum("njk,jk->nj", inputs, weights)


def _moving_joints(root: Element) -> list[str | None]:
    """Return the names of the joints that move by themselves."""
    joints = [joint for joint in root.findall("joint") if joint.find("mimic") is None]
    return [joint.get("name") for joint in joints if joint.get("type") in MOVING_TYPES]


def _compiled(root: Element, moving: Container[str | None]) -> Any:
    """Return MuJoCo's model, in which the joints of these names move; the others are fixed."""
    mujoco: Any = require("mujoco", what="a body model")
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        for name, value in COMPILER.items():
            setattr(spec.compiler, name, value)
        for equality in list(spec.equalities):  # of mimic joints, which MuJoCo 4 reads
            spec.delete(equality)
        for joint in list(spec.joints):
            if joint.name not in moving:
                spec.delete(joint)
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"the body cannot be read: {' '.join(str(error).split())}") from None
    for part in (model.body_mass, model.body_inertia, model.body_pos):
        if not np.isfinite(part).all():
            raise ValueError(
                "the body cannot be read: masses, inertias and positions must be finite"
            )
    return model


def _joint_names(model: Any) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _columns_by_name(names: Sequence[str], labels: Sequence[str]) -> dict[str, int]:
    """Return the index of the label that means each joint, by the words that the two share.

    A word counts the less, the more joints have it; a name that stands in a label as it is counts most. Of two that
    share as much with a label, as a joint of the arm and one of its fingers may, the shorter one is meant.
    """
    words = [_words(name) for name in names]
    joints_with = Counter(word for words_of_name in words for word in words_of_name)
    score = np.zeros((len(labels), len(names)))
    for k, label in enumerate(labels):
        for j, name in enumerate(names):
            shared = _words(label) & words[j]
            score[k, j] = sum(1.0 / joints_with[word] for word in shared)
            score[k, j] += len(name) * (name in label) - WORD_PENALTY * len(words[j])

    columns = {}
    for k, j in zip(*linear_sum_assignment(-score), strict=True):
        second_best = np.delete(score[k], j).max(initial=0.0)
        if score[k, j] > second_best:
            columns[names[j]] = int(k)
    return columns


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+\d*|\d+", name.lower()))


def _columns_by_chain(model: Any, count: int) -> dict[str, int]:
    """Return the index, from the base, of each of the first joints of the longest chain.

    Raises ValueError where they are too few.
    """
    chain = _longest_chain(model)[:count]
    names = _joint_names(model)
    if len(chain) < count:
        raise ValueError(
            f"{count} joints are sensed, and the body's longest chain has {len(chain)} that move: "
            f"name the columns as its joints are named ({', '.join(names) or 'it has none'})"
        )
    return {names[joint]: index for index, joint in enumerate(chain)}


def _longest_chain(model: Any) -> list[int]:
    """Return the joints of the longest chain, from the base outwards."""
    chains: dict[int, list[int]] = {0: []}
    for body in range(1, model.nbody):  # parents come first
        chains[body] = list(chains[int(model.body_parentid[body])])
        if model.body_jntnum[body]:
            chains[body].append(int(model.body_jntadr[body]))
    return max(chains.values(), key=len)
