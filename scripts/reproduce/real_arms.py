"""What monitors find in recordings of real arms: faults added to them, and false alarms.

The recordings are of others and lie in a folder; a missing one is named, with where it is published. Each is of an arm
that did nothing wrong, cut into pieces. A quarter of them is tested, in turn; of the others two in three are learned
from, and the greatest surprise of the rest is the threshold. Each tested piece is watched as it is, and with each fault
from its middle on. Pieces are of one trajectory: no table says how a monitor fares on another.

    push, payload    τ + Jᵀ F      J of the outermost link, by the arm's own URDF
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.bags import read_bag
from asm_gym.data.episode import Episode
from asm_gym.data.selection import complete_parts, pieces
from asm_gym.detection import alarms_in
from asm_gym.detection.scores import Largest
from asm_gym.evaluation.tables import Table
from asm_gym.extras import require
from asm_gym.monitors import MONITORS, CalibratedMonitor, make_monitor
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.monitors.torque.urdf import read_urdf
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record, where

Floats = NDArray[np.float64]

RULE = "friction_rule"
SETTINGS: dict[str, dict[str, Any]] = {"neural_asm": {"values": True}}
"""As ``asm-gym fit`` fits a log."""
WITH_BODY = {
    "neural_asm, body": "neural_asm",
    "association_values, body": "association_values",
    f"{RULE}, body": RULE,
}
"""Monitors with a body model."""
PIECE_S, FOLDS = 1.0, 4  # length of a piece [s], and folds of which one is tested at a time


def read_joint_states(path: Path) -> dict[str, NDArray[Any]]:
    """Return time, position [rad], velocity and effort of each joint of a ROS 2 bag."""
    return {name.removeprefix("joint_states."): values for name, values in read_bag(path).items()}


class RealArm(NamedTuple):
    """A recording of an arm that did nothing wrong, and its body model."""

    robot: str
    place: str  # bag below the folder of all recordings
    urdf: str  # file in the folder ``urdf`` of that of all recordings


SOURCE = "unisa-acg/inverse-dynamics-solver @ 41e196de (BSD-3-Clause)"
ARMS = {
    "panda": RealArm("Franka Panda", "unisa_acg/panda_exciting_trajectory.db3", "panda.urdf"),
    "ur10": RealArm("UR10", "unisa_acg/ur10_exciting_trajectory.db3", "ur10_robot.urdf"),
}


# ------------------------------------------------------------------ faults added to recordings


class Piece(NamedTuple):
    """A piece of a recording, and where a fault in it begins."""

    episode: Episode
    onset: int  # row
    ranges: Floats  # (J,) of each effort in the whole recording
    body: BodyModel | None  # of an arm with torques in N m

    def column(self, name: str) -> Floats:
        """Return position or effort (T, J)."""
        return self.episode.stream[:, self.episode.spec.slices[name]].astype(np.float64)


NEWTONS, GRAVITY = 20.0, 9.81  # push at the hand, and weight of a payload of 1 kg [N]
STEP_SHARE, SLIP, LATE_S, RISE_S = 0.2, 0.05, 0.1, 0.1
MOVES = 0.02  # angle that an encoder must move by after the onset, or nothing shows that it is frozen [rad]
FAULTS = dict.fromkeys(("push", "payload", "step"), "effort")
FAULTS |= {"frozen": "position", "slipped": "position", "late": "effort"}
"""Column that each fault changes: a push of 20 N sideways or a payload of 1 kg at the hand; a step of 20 % of a joint's
effort range; an encoder that freezes or slips by 0.05 rad; an effort that comes 0.1 s late. None of them happened, and
every table that counts them says so."""


def jacobian(body: BodyModel, q: Floats) -> Floats:
    """Return the velocity of the outermost link [m/s] by each joint's [rad/s] (3, J), at angles q (J,)."""
    mujoco: Any = require("mujoco", what="a push at a hand")
    model, data = body.model, mujoco.MjData(body.model)
    data.qpos[:] = q[body.columns]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    depth, moved, found = np.zeros(model.nbody), np.zeros((3, model.nv)), np.zeros((3, len(q)))
    for n in range(1, model.nbody):  # parents come first
        depth[n] = depth[model.body_parentid[n]] + 1
    mujoco.mj_jacBody(model, data, moved, None, int(depth.argmax()))
    found[:, body.columns] = moved
    return found


def with_fault(kind: str, piece: Piece, rng: np.random.Generator) -> Episode | None:
    """Return the piece with a fault from the onset on; None where the piece does not allow it."""
    episode, onset, dt = piece.episode, piece.onset, piece.episode.spec.dt
    q, effort = piece.column("position"), piece.column("effort")
    after, strong = slice(onset, len(q)), np.flatnonzero(piece.ranges > 0.1 * piece.ranges.max())
    rise = np.minimum(1.0, (1 + np.arange(len(q) - onset)) * dt / RISE_S)
    added = np.zeros_like(q[after])  # (T - onset, J)
    if kind in ("push", "payload"):
        if piece.body is None:
            return None
        force = np.array([0.0, 0.0, -GRAVITY])
        if kind == "push":
            angle = rng.uniform(0, 2 * np.pi)
            force = NEWTONS * np.array([np.cos(angle), np.sin(angle), 0.0])
        added[:] = (
            np.array([jacobian(piece.body, row).T @ force for row in q[after]]) * rise[:, None]
        )
    elif kind == "step":
        j = int(rng.choice(strong))
        added[:, j] = rng.choice([-1, 1]) * STEP_SHARE * piece.ranges[j] * rise
    elif kind == "frozen":
        moving = np.flatnonzero(np.ptp(q[after], axis=0) > MOVES)
        if not len(moving):
            return None
        j = int(rng.choice(moving))
        added[:, j] = q[onset - 1, j] - q[after, j]
    elif kind == "slipped":
        angle = rng.choice([-1, 1]) * SLIP
        added[:, int(rng.integers(len(piece.ranges)))] = angle
    else:  # late
        j, rows = int(rng.choice(strong)), max(1, round(LATE_S / dt))
        added[:, j] = effort[onset - rows : len(effort) - rows, j] - effort[after, j]
    stream = episode.stream.copy()
    stream[after, episode.spec.slices[FAULTS[kind]]] += added.astype(np.float32)
    return Episode.from_stream(stream, episode.spec, faults=np.arange(len(stream)) >= onset)


# ------------------------------------------------------------------ the study


@dataclass(frozen=True)
class Config(kit.Config):
    """What monitors find in recordings of real arms."""

    folder: Path = option(Path("real_arms"), positional=True, metavar="FOLDER")
    """Folder of the recordings."""
    seeds: int = option(1, least=1)
    """How often pieces are drawn anew."""
    experiments: tuple[str, ...] = option(tuple(ARMS), quick=("panda",), least=1, known=ARMS)
    """Recordings; missing ones are left out, and named."""
    monitors: tuple[str, ...] = option(
        (
            "neural_asm",
            "association_values",
            "association_linear+evidence",
            "kalman+evidence",
            "gru+evidence",
            RULE,
        ),
        quick=("association_values", RULE),
        least=1,
        known=(*MONITORS, *WITH_BODY, RULE),
    )
    """Monitors; those named with a body read the arm's URDF."""


class Job(NamedTuple):
    """One monitor on one fold of one recording."""

    experiment: str
    monitor: str
    seed: int
    fold: int


def run(config: Config) -> Findings:
    """Run the experiments whose recordings are in the folder."""
    places = {name: config.folder / ARMS[name].place for name in config.experiments}
    missing = [
        f"{place} is missing: it is {SOURCE}" for place in places.values() if not place.exists()
    ]
    found = [name for name, place in places.items() if place.exists()]
    if not found:
        raise FileNotFoundError("; ".join(missing))
    jobs = [Job(*one) for one in product(found, config.monitors, config.repetitions, range(FOLDS))]
    each = kit.each("watching", partial(examined, folder=config.folder), jobs, config)
    records = [record for own in each for record in own]
    first, *others = (table(where(records, experiment=name), ARMS[name]) for name in found)
    left_out = "".join(f" Left out: {why}." for why in missing)
    return Findings(records, [replace(first, caption=first.caption + left_out), *others])


def examined(job: Job, folder: Path) -> list[Record]:
    """Return a record for each tested piece as it is, and for each fault in it."""
    arm = ARMS[job.experiment]
    whole = Episode.from_table(read_joint_states(folder / arm.place), success=True)
    effort = whole.stream[:, whole.spec.slices["effort"]].astype(np.float64)
    ranges = np.quantile(effort, 0.95, axis=0) - np.quantile(effort, 0.05, axis=0)
    cut = [piece for part in complete_parts(whole) for piece in pieces(part, PIECE_S)]
    order = [int(i) for i in np.random.default_rng(job.seed).permutation(len(cut))]
    tested, others = (
        sorted(order[job.fold :: FOLDS]),
        [i for n, i in enumerate(order) if n % FOLDS != job.fold],
    )
    if len(others) < 4:
        raise ValueError(f"{job.experiment} has {len(cut)} pieces of {PIECE_S:g} s: too few")
    learned, calibration = (
        [cut[i] for n, i in enumerate(others) if n % 3],
        [cut[i] for i in others[::3]],
    )
    model = folder / "urdf" / arm.urdf
    if not model.is_file():
        raise FileNotFoundError(f"{model} is missing: it is in example-robot-data 6.0.0 (PyPI)")
    urdf = read_urdf(model)
    angles = whole.spec.labels[whole.spec.slices["position"]]
    body = BodyModel.of(urdf, angles)
    monitor = fitted(job, learned, urdf)
    threshold = monitor.calibrate(calibration, 1.0 / (len(calibration) + 1)).threshold
    rng = np.random.default_rng([job.seed, job.fold])  # the same faults for every monitor
    watched = [("", cut[i]) for i in tested]
    for i, kind in ((i, kind) for i in tested for kind in FAULTS):
        faulty = with_fault(kind, Piece(cut[i], len(cut[i]) // 2, ranges, body), rng)
        watched += [] if faulty is None else [(kind, faulty)]
    scores = monitor.score_episodes([episode for _, episode in watched])
    ratios = [s.value / threshold for s in scores]
    return [
        job._asdict() | judged(kind, v, whole.spec.dt)
        for (kind, _), v in zip(watched, ratios, strict=True)
    ]


def fitted(job: Job, episodes: Sequence[Episode], urdf: str) -> Any:
    """Return the monitor of a job, fitted; one that is named with a body reads the text of ``urdf``."""
    spec, name = episodes[0].spec, WITH_BODY.get(job.monitor, job.monitor)
    settings = SETTINGS.get(name, {}) | ({"urdf": urdf} if job.monitor in WITH_BODY else {})
    if name == RULE:
        return CalibratedMonitor(FrictionRule(spec, **settings), Largest(spec), seed=job.seed).fit(
            list(episodes)
        )
    return make_monitor(name, spec, seed=job.seed, **settings).fit(list(episodes))


def judged(kind: str, value: Floats, dt: float) -> Record:
    """Return the record of a piece by its surprise as a multiple of the threshold (T,)."""
    if not kind:
        counted = {
            "alarms": alarms_in(value, 1.0, dt),
            "alarm_s": (value > 1).sum() * dt,
            "seconds": len(value) * dt,
        }
        return {"kind": kind, **counted, "excess": float(value.max())}
    before, after = np.split(value, [len(value) // 2])
    over = np.flatnonzero(after > 1)
    found = bool(len(over)) and not (before > 1).any()
    return {
        "kind": kind,
        "found": found,
        "delay": dt * (over[0] + 1) if found else None,
        "excess": float(after.max()),
    }


def table(records: Sequence[Record], arm: RealArm) -> Table:
    """Return the table of a recording, a row for each monitor."""
    kinds = [kind for kind in FAULTS if where(records, kind=kind)]
    monitors = list(dict.fromkeys(r["monitor"] for r in records))
    healthy = {
        n: sorted((r["excess"] for r in where(records, monitor=n, kind="")), reverse=True)
        for n in monitors
    }
    fewest = min(sum(excess > 1 for excess in own) for own in healthy.values())
    rows = []
    for name in monitors:
        own = where(records, monitor=name)
        quiet, faulty = where(own, kind=""), [r for r in own if r["kind"]]
        found = [[r["found"] for r in where(faulty, kind=kind)] for kind in kinds]
        delays = [r["delay"] for r in faulty if r["found"]]
        told = [r for r in faulty if r["kind"] in ("push", "payload")]
        seconds, alarms, alarm_s = (
            sum(r[value] for r in quiet) for value in ("seconds", "alarms", "alarm_s")
        )
        shares = [
            f"{sum(f)} of {len(f)}"
            for f in (*found, [r["excess"] > healthy[name][fewest] for r in told])
        ]
        delay = f"{np.median(delays):.3g}" if delays else ""
        healthily = f"{3600 * alarms / seconds:.0f}", f"{100 * alarm_s / seconds:.1f} %"
        rows.append((name, *shares[:-1], delay, shares[-1], *healthily))
    caption = (
        f"{arm.robot} ({arm.place}), {seconds:.0f} s as recorded. * added to the recording, found within half a piece. "
        f"At {fewest}: pushes and payloads found by the threshold that {fewest} healthy pieces pass."
    )
    headings = ("Monitor", *(f"{kind} *" for kind in kinds), "delay [s]", f"at {fewest}")
    return Table(caption, (*headings, "false alarms an hour", "healthy time in alarm"), rows)
