"""Faults that are added to pieces of recordings of real arms, from an onset on.

push, payload    τ + Jᵀ F      J of the outermost link, by the arm's own URDF
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.extras import require
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.scripts.reproduce.arm_recordings import SLIP_RAD, RealArm

Floats = NDArray[np.float64]

POSITION = "position"
EFFORT = "effort"


class Piece(NamedTuple):
    """A piece of a recording, and where a fault in it begins."""

    episode: Episode
    onset: int  # row
    ranges: Floats  # (E,) of each effort in the whole recording
    body: BodyModel | None  # of an arm with torques in N m
    arm: RealArm

    def columns(self, what: str) -> NDArray[np.intp]:
        """Return the columns in the stream of ``"position"``, or of ``"effort"``."""
        names = self.arm.efforts
        if what == POSITION:
            names = (POSITION,)
        spec = self.episode.spec
        columns = [np.arange(spec.size)[spec.slices[name]] for name in names]
        return np.concatenate(columns)

    def values(self, what: str) -> Floats:
        """Return positions or efforts (T, J)."""
        return self.episode.stream[:, self.columns(what)].astype(np.float64)

    def rise(self) -> Floats:
        """Return the share (T - onset,) of its size that a growing fault has reached."""
        rows = np.arange(len(self.episode) - self.onset)
        since = (1 + rows) * self.episode.spec.dt  # [s]
        return np.minimum(1.0, since / RISE_S)

    def strong_joint(self, rng: np.random.Generator) -> int:
        """Draw one of the joints whose effort ranges far."""
        strong = np.flatnonzero(self.ranges > 0.1 * self.ranges.max())
        return int(rng.choice(strong))

    def at_joint(self, what: str, joint: int, values: Floats | float) -> Floats:
        """Return (T - onset, J): ``values`` (T - onset,) at one joint, 0 at the others."""
        rows = len(self.episode) - self.onset
        added = np.zeros((rows, len(self.columns(what))))
        added[:, joint] = values
        return added

    def torques(self, force: Sequence[float]) -> Floats:
        """Return the torques (T - onset, J) of a growing force (3,) [N] at the outermost link."""
        assert self.body is not None
        angles = self.values(POSITION)[self.onset :]
        torques = [jacobian(self.body, q).T @ np.array(force) for q in angles]
        return np.array(torques) * self.rise()[:, None]


NEWTONS = 20.0  # push at the hand
GRAVITY = 9.81  # weight of a payload of 1 kg [N]
STEP_SHARES = (0.2, 0.1)  # steps of a joint's effort, in its range
LATE_S = 0.1  # delay of an effort [s]
RISE_S = 0.1  # time in which a force grows [s]
MOVES = 0.02  # least angle of motion after the onset that shows a frozen encoder [rad]


def jacobian(body: BodyModel, q: Floats) -> Floats:
    """Return the velocity of the outermost link [m/s] by each joint's [rad/s] (3, J), at angles q (J,)."""
    mujoco: Any = require("mujoco", what="a push at a hand")
    model = body.model
    data = mujoco.MjData(model)
    data.qpos[:] = q[body.columns]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    depth = np.zeros(model.nbody)
    for link in range(1, model.nbody):  # parents come first
        depth[link] = depth[model.body_parentid[link]] + 1
    outermost = int(depth.argmax())
    by_column = np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, by_column, None, outermost)
    by_joint = np.zeros((3, len(q)))
    by_joint[:, body.columns] = by_column
    return by_joint


def push(piece: Piece, rng: np.random.Generator) -> Floats:
    """Push the hand sideways."""
    angle = rng.uniform(0, 2 * np.pi)
    force = [NEWTONS * np.cos(angle), NEWTONS * np.sin(angle), 0.0]
    return piece.torques(force)


def payload(piece: Piece, rng: np.random.Generator) -> Floats:
    """Hang 1 kg on the hand."""
    return piece.torques([0.0, 0.0, -GRAVITY])


def step(piece: Piece, rng: np.random.Generator, share: float) -> Floats:
    """Shift the effort of a joint by a share of its range."""
    joint = piece.strong_joint(rng)
    sign = rng.choice([-1, 1])
    size = sign * share * piece.ranges[joint]
    return piece.at_joint(EFFORT, joint, size * piece.rise())


def freeze(piece: Piece, rng: np.random.Generator) -> Floats | None:
    """Freeze the encoder of a joint that moves; None where none does."""
    angles = piece.values(POSITION)
    after = angles[piece.onset :]
    radians = SLIP_RAD / piece.arm.slip
    moving = np.flatnonzero(np.ptp(after, axis=0) * radians > MOVES)
    if not len(moving):
        return None
    joint = int(rng.choice(moving))
    frozen = angles[piece.onset - 1, joint]
    return piece.at_joint(POSITION, joint, frozen - after[:, joint])


def slip(piece: Piece, rng: np.random.Generator) -> Floats:
    """Let an encoder slip."""
    angle = rng.choice([-1, 1]) * piece.arm.slip
    joint = int(rng.integers(len(piece.columns(POSITION))))
    return piece.at_joint(POSITION, joint, angle)


def delay(piece: Piece, rng: np.random.Generator) -> Floats:
    """Delay the effort of a joint."""
    joint = piece.strong_joint(rng)
    effort = piece.values(EFFORT)[:, joint]
    rows = max(1, round(LATE_S / piece.episode.spec.dt))
    late = effort[piece.onset - rows : len(effort) - rows]
    return piece.at_joint(EFFORT, joint, late - effort[piece.onset :])


class Fault(NamedTuple):
    """A fault that is added to a recording; none of them happened, as every table says."""

    what: str  # "position" or "effort"
    added: Callable[[Piece, np.random.Generator], Floats | None]  # (T - onset, J) from the onset on
    needs_body: bool = False


ADDED_FAULTS = {
    "push": Fault(EFFORT, push, needs_body=True),
    "payload": Fault(EFFORT, payload, needs_body=True),
    **{f"step {share:.0%}": Fault(EFFORT, partial(step, share=share)) for share in STEP_SHARES},
    "frozen": Fault(POSITION, freeze),
    "slipped": Fault(POSITION, slip),
    "late": Fault(EFFORT, delay),
}


def with_fault(kind: str, piece: Piece, rng: np.random.Generator) -> Episode | None:
    """Return the piece with a fault from the onset on; None where the piece does not allow it."""
    fault = ADDED_FAULTS[kind]
    if fault.needs_body and piece.body is None:
        return None
    if fault.what == EFFORT and not piece.arm.efforts:
        return None
    added = fault.added(piece, rng)
    if added is None:
        return None
    spec = piece.episode.spec
    stream = piece.episode.stream.copy()
    stream[piece.onset :, piece.columns(fault.what)] += added.astype(np.float32)
    is_faulty = np.arange(len(stream)) >= piece.onset
    return Episode.from_stream(stream, spec, faults=is_faulty)
