"""Faults added to recordings of real arms; none of them happened, and every table that counts them says so.

push      τ + Jᵀ F                           20 N at the hand, sideways, held; J of a Panda
payload   τ + Jᵀ (0, 0, -m g)                1 kg more in the hand than before
step      τ_j + 20 % of its range            other arms than a Panda
frozen    q_j stays as it was at the onset
slipped   q_j + 0.05 rad from the onset on
late      τ_j as it was 0.1 s before
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.rollouts.staging import environment
from asm_gym.tasks import env_id

Floats = NDArray[np.float64]

NEWTONS, KILOGRAMS, GRAVITY = 20.0, 1.0, 9.81
STEP_SHARE, SLIP, LATE_S, RISE_S = 0.2, 0.05, 0.1, 0.1
MOVES = 0.02
"""Angle that an encoder must move by after the onset, or nothing shows that it is frozen [rad]."""


def jacobian(q: Floats) -> Floats:
    """Return the velocity of a Panda's hand [m/s] by each joint's [rad/s] (3, J), at angles q (J,)."""
    arm: Any = environment(env_id("Lift")).unwrapped
    robot, model = arm.robosuite_env.robots[0], arm.simulation.model
    data, found = mujoco.MjData(model), np.zeros((3, model.nv))
    data.qpos[robot._ref_joint_pos_indexes] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_jacSite(model, data, found, None, robot.eef_site_id["right"])
    return found[:, robot._ref_joint_vel_indexes]


class Piece(NamedTuple):
    """A piece of a recording, and where a fault in it begins.

    Attributes:
        episode: the piece.
        onset: row of the onset.
        ranges: range of each effort in the whole recording (J,).
        panda: whether the arm is a Panda, whose effort is in N m.
    """

    episode: Episode
    onset: int
    ranges: Floats
    panda: bool

    def column(self, name: str) -> Floats:
        """Return position or effort (T, J)."""
        return self.episode.stream[:, self.episode.spec.slices[name]].astype(np.float64)

    def ramp(self, rows: int) -> Floats:
        """Return how far the fault has risen (rows, 1)."""
        return np.minimum(1.0, (1 + np.arange(rows)) * self.episode.spec.dt / RISE_S)[:, None]


Added = Floats | None
"""Numbers added to a column from the onset on (T - onset, J); None where the arm or the piece does not allow it."""


def _force(piece: Piece, force: Floats) -> Floats:
    """Return the torques of a force (3,) at the hand."""
    q = piece.column("position")[piece.onset :]
    return np.array([jacobian(row).T @ force for row in q]) * piece.ramp(len(q))


def _one_joint(piece: Piece, column: str, joint: int, added: Floats) -> Floats:
    made = np.zeros_like(piece.column(column)[piece.onset :])
    made[:, joint] = added
    return made


def _strong_joint(piece: Piece, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(piece.ranges > 0.1 * piece.ranges.max())))


def push(piece: Piece, rng: np.random.Generator) -> Added:
    if not piece.panda:
        return None
    angle = rng.uniform(0, 2 * np.pi)
    return _force(piece, NEWTONS * np.array([np.cos(angle), np.sin(angle), 0.0]))


def payload(piece: Piece, rng: np.random.Generator) -> Added:
    return _force(piece, np.array([0.0, 0.0, -KILOGRAMS * GRAVITY])) if piece.panda else None


def step(piece: Piece, rng: np.random.Generator) -> Added:
    if piece.panda:
        return None
    joint = _strong_joint(piece, rng)
    size = rng.choice([-1, 1]) * STEP_SHARE * piece.ranges[joint]
    return _one_joint(piece, "effort", joint, size * piece.ramp(len(piece.episode) - piece.onset)[:, 0])


def frozen(piece: Piece, rng: np.random.Generator) -> Added:
    q = piece.column("position")
    moving = np.flatnonzero(np.ptp(q[piece.onset :], axis=0) > MOVES)
    if not len(moving):
        return None
    joint = int(rng.choice(moving))
    return _one_joint(piece, "position", joint, q[piece.onset - 1, joint] - q[piece.onset :, joint])


def slipped(piece: Piece, rng: np.random.Generator) -> Added:
    angle = rng.choice([-1, 1]) * SLIP
    joint = int(rng.integers(len(piece.ranges)))
    return _one_joint(piece, "position", joint, np.full(len(piece.episode) - piece.onset, angle))


def late(piece: Piece, rng: np.random.Generator) -> Added:
    effort, joint = piece.column("effort"), _strong_joint(piece, rng)
    rows = max(1, round(LATE_S / piece.episode.spec.dt))
    delayed = effort[piece.onset - rows : len(effort) - rows, joint]
    return _one_joint(piece, "effort", joint, delayed - effort[piece.onset :, joint])


FAULTS: dict[str, tuple[str, Callable[[Piece, np.random.Generator], Added]]] = {
    "push": ("effort", push),
    "payload": ("effort", payload),
    "step": ("effort", step),
    "frozen": ("position", frozen),
    "slipped": ("position", slipped),
    "late": ("effort", late),
}
"""Column that each fault changes, and what it adds to it."""


def with_fault(kind: str, piece: Piece, rng: np.random.Generator) -> Episode | None:
    """Return the piece with a fault from the onset on; None where the arm or the piece does not allow it."""
    column, make = FAULTS[kind]
    added = make(piece, rng)
    if added is None:
        return None
    episode = piece.episode
    stream = episode.stream.copy()
    stream[piece.onset :, episode.spec.slices[column]] += added.astype(np.float32)
    return Episode.from_stream(stream, episode.spec, faults=np.arange(len(stream)) >= piece.onset)
