"""Faults put into recordings of real arms: none of them happened, and every table that counts them says so.

    push      τ + Jᵀ F        20 N at the hand, sideways, held; J of the arm's own kinematics
    payload   τ + Jᵀ (0, 0, -m g)                1 kg more in the hand than before
    step      τ_j + 20 % of its range            where the kinematics are not at hand
    frozen    q_j stays as it was at the onset
    slipped   q_j + 0.05 rad from the onset on
    late      τ_j as it was 0.1 s before

Sources: Denavit and Hartenberg 1955; the tables of the two arms as Franka and Universal Robots publish them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.scripts.reproduce.arm_recordings import RealArm

Floats = NDArray[np.float64]

NEWTONS, KILOGRAMS, GRAVITY = 20.0, 1.0, 9.81
STEP_SHARE, SLIP, LATE_S, RISE_S = 0.2, 0.05, 0.1, 0.1
MOVES = 0.02
"""Radians that an encoder must move by after the onset, or nothing shows that it is frozen."""


class PushedTable(NamedTuple):
    """Denavit-Hartenberg parameters, a row a joint."""

    a: tuple[float, ...]  # [m]
    d: tuple[float, ...]  # [m]
    alpha: tuple[float, ...]  # [rad]
    modified: bool  # as Craig has them: α and a of the link before


RIGHT = np.pi / 2
TABLES = {
    "panda": PushedTable(
        (0, 0, 0, 0.0825, -0.0825, 0, 0.088),
        (0.333, 0, 0.316, 0, 0.384, 0, 0.107 + 0.1034),  # to between the fingers
        (0, -RIGHT, RIGHT, RIGHT, -RIGHT, RIGHT, RIGHT),
        True,
    ),
    "ur10": PushedTable(
        (0, -0.612, -0.5723, 0, 0, 0),
        (0.1273, 0, 0, 0.163941, 0.1157, 0.0922),
        (RIGHT, 0, 0, RIGHT, -RIGHT, 0),
        False,
    ),
}


def jacobian(table: PushedTable, q: Floats) -> Floats:
    """(3, J) of the hand's velocity [m/s] by the joints' [rad/s], at angles q (J,)."""
    pose, axes, places = np.eye(4), [], []
    for a, d, alpha, angle in zip(table.a, table.d, table.alpha, q, strict=True):
        turn = _about_z(angle, d)
        link = _about_x(alpha, a)
        if table.modified:
            pose = pose @ link
            axes.append(pose[:3, 2])
            places.append(pose[:3, 3])
            pose = pose @ turn
        else:
            axes.append(pose[:3, 2])
            places.append(pose[:3, 3])
            pose = pose @ turn @ link
    return np.stack([np.cross(z, pose[:3, 3] - p) for z, p in zip(axes, places, strict=True)], axis=1)


def _about_z(angle: float, d: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])


def _about_x(alpha: float, a: float) -> Floats:
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def _force(piece: Episode, onset: int, arm: RealArm, force: Floats) -> Floats:
    """What a force (3,) at the hand adds to each effort from the onset on (T - onset, J)."""
    q = piece.stream[onset:, piece.spec.slices["position"]].astype(np.float64) / arm.unit
    rise = np.minimum(1.0, (1 + np.arange(len(q))) * piece.spec.dt / RISE_S)
    torque = np.array([jacobian(TABLES[arm.model], row).T @ force for row in q])
    added: Floats = torque * rise[:, None]
    return added


def push(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    if not arm.model:
        return None
    angle = rng.uniform(0, 2 * np.pi)
    return _changed(
        piece, "effort", _force(piece, onset, arm, NEWTONS * np.array([np.cos(angle), np.sin(angle), 0.0])), onset
    )


def payload(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    if not arm.model:
        return None
    return _changed(piece, "effort", _force(piece, onset, arm, np.array([0.0, 0.0, -KILOGRAMS * GRAVITY])), onset)


def step(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    if arm.model:
        return None
    effort = piece.stream[:, piece.spec.slices["effort"]].astype(np.float64)
    ranges = np.asarray(piece.info["effort_range"])
    j = int(rng.choice(np.flatnonzero(ranges > 0.1 * ranges.max())))
    added = np.zeros((len(effort) - onset, effort.shape[1]))
    added[:, j] = rng.choice([-1, 1]) * STEP_SHARE * ranges[j]
    added *= np.minimum(1.0, (1 + np.arange(len(added))) * piece.spec.dt / RISE_S)[:, None]
    return _changed(piece, "effort", added, onset)


def frozen(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    q = piece.stream[:, piece.spec.slices["position"]].astype(np.float64)
    moving = np.flatnonzero(np.ptp(q[onset:], axis=0) > MOVES * arm.unit)
    if not len(moving):
        return None
    j = int(rng.choice(moving))
    added = np.zeros_like(q[onset:])
    added[:, j] = q[onset - 1, j] - q[onset:, j]
    return _changed(piece, "position", added, onset)


def slipped(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    where = piece.spec.slices["position"]
    added = np.zeros((len(piece) - onset, where.stop - where.start))
    added[:, rng.integers(added.shape[1])] = rng.choice([-1, 1]) * SLIP * arm.unit
    return _changed(piece, "position", added, onset)


def late(piece: Episode, onset: int, arm: RealArm, rng: np.random.Generator) -> Episode | None:
    effort = piece.stream[:, piece.spec.slices["effort"]].astype(np.float64)
    ranges = np.asarray(piece.info["effort_range"])
    j = int(rng.choice(np.flatnonzero(ranges > 0.1 * ranges.max())))
    rows = max(1, round(LATE_S / piece.spec.dt))
    added = np.zeros_like(effort[onset:])
    added[:, j] = effort[onset - rows : len(effort) - rows, j] - effort[onset:, j]
    return _changed(piece, "effort", added, onset)


FAULTS: dict[str, Callable[[Episode, int, RealArm, np.random.Generator], Episode | None]] = {
    **{"push": push, "payload": payload, "step": step},
    **{"frozen": frozen, "slipped": slipped, "late": late},
}
"""Each makes of a piece, from the onset row on, one with a fault; None where the arm or the piece does not allow it."""


def _changed(piece: Episode, channel: str, added: Floats, onset: int) -> Episode:
    stream = piece.stream.copy()
    stream[onset:, piece.spec.slices[channel]] += added.astype(np.float32)
    return Episode.from_stream(stream, piece.spec, faults=np.arange(len(stream)) >= onset, info=piece.info)
