"""What monitors find in recordings of real arms: faults added to them, and false alarms.

The recordings are of others and lie in a folder; a missing one is named, with where it is published. Each is of an arm
that did nothing wrong, cut into pieces. A quarter of them is tested, in turn; of the others two in three are learned
from, and the greatest surprise of the rest is the threshold. Each tested piece is watched as it is, and with each fault
from its middle on. Pieces are of one trajectory: no table says how a monitor fares on another.

    push, payload    τ + Jᵀ F      J of the outermost link, by the arm's own URDF
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.data.bags import read_bag
from asm_gym.data.episode import Episode
from asm_gym.data.training_selection import complete_parts, pieces
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
from asm_gym.scripts.reproduce.kit import Findings, Record

Floats = NDArray[np.float64]

RULE = "friction_rule"
BODY = ", body"  # ends the name of a monitor that reads the arm's URDF
WITH_BODY = tuple(name + BODY for name in ("neural_asm", "association_values", RULE))
PIECE_S = 1.0  # length of a piece [s]
FOLDS = 4  # of which one is tested at a time


# ------------------------------------------------------------------ recordings


class RealArm(NamedTuple):
    """A recording of an arm that did nothing wrong, and its body model."""

    robot: str
    bag: str  # below the folder of all recordings
    urdf: str  # file in the folder ``urdf`` of that of all recordings


SOURCE = "unisa-acg/inverse-dynamics-solver @ 41e196de (BSD-3-Clause)"
ARMS = {
    "panda": RealArm("Franka Panda", "unisa_acg/panda_exciting_trajectory.db3", "panda.urdf"),
    "ur10": RealArm("UR10", "unisa_acg/ur10_exciting_trajectory.db3", "ur10_robot.urdf"),
}


def read_joint_states(path: Path) -> dict[str, NDArray[Any]]:
    """Return time, position [rad], velocity and effort of each joint of a ROS 2 bag."""
    return {name.removeprefix("joint_states."): values for name, values in read_bag(path).items()}


def read_body(folder: Path, arm: RealArm) -> str:
    """Return the text of an arm's URDF."""
    path = folder / "urdf" / arm.urdf
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: it is in example-robot-data 6.0.0 (PyPI)")
    return read_urdf(path)


class Piece(NamedTuple):
    """A piece of a recording, and where a fault in it begins."""

    episode: Episode
    onset: int  # row
    ranges: Floats  # (J,) of each effort in the whole recording
    body: BodyModel | None  # of an arm with torques in N m

    def column(self, name: str) -> Floats:
        """Return position or effort (T, J)."""
        return self.episode.stream[:, self.episode.spec.slices[name]].astype(np.float64)

    def rise(self) -> Floats:
        """Return the share (T - onset,) of its size that a growing fault has reached."""
        rows = np.arange(len(self.episode) - self.onset)
        since = (1 + rows) * self.episode.spec.dt  # [s]
        return np.minimum(1.0, since / RISE_S)

    def strong_joint(self, rng: np.random.Generator) -> int:
        """Draw one of the joints whose effort ranges far."""
        strong = np.flatnonzero(self.ranges > 0.1 * self.ranges.max())
        return int(rng.choice(strong))

    def at_joint(self, joint: int, values: Floats | float) -> Floats:
        """Return (T - onset, J): ``values`` (T - onset,) at one joint, 0 at the others."""
        rows = len(self.episode) - self.onset
        added = np.zeros((rows, len(self.ranges)))
        added[:, joint] = values
        return added

    def torques(self, force: Sequence[float]) -> Floats:
        """Return the torques (T - onset, J) of a growing force (3,) [N] at the outermost link."""
        assert self.body is not None
        angles = self.column("position")[self.onset :]
        torques = [jacobian(self.body, q).T @ np.array(force) for q in angles]
        return np.array(torques) * self.rise()[:, None]


# ------------------------------------------------------------------ faults added to recordings

NEWTONS = 20.0  # push at the hand
GRAVITY = 9.81  # weight of a payload of 1 kg [N]
STEP_SHARE = 0.2  # step of a joint's effort, in its range
SLIP = 0.05  # of an encoder [rad]
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


def step(piece: Piece, rng: np.random.Generator) -> Floats:
    """Shift the effort of a joint."""
    joint = piece.strong_joint(rng)
    sign = rng.choice([-1, 1])
    size = sign * STEP_SHARE * piece.ranges[joint]
    return piece.at_joint(joint, size * piece.rise())


def freeze(piece: Piece, rng: np.random.Generator) -> Floats | None:
    """Freeze the encoder of a joint that moves; None where none does."""
    angles = piece.column("position")
    after = angles[piece.onset :]
    moving = np.flatnonzero(np.ptp(after, axis=0) > MOVES)
    if not len(moving):
        return None
    joint = int(rng.choice(moving))
    frozen = angles[piece.onset - 1, joint]
    return piece.at_joint(joint, frozen - after[:, joint])


def slip(piece: Piece, rng: np.random.Generator) -> Floats:
    """Let an encoder slip."""
    angle = rng.choice([-1, 1]) * SLIP
    joint = int(rng.integers(len(piece.ranges)))
    return piece.at_joint(joint, angle)


def delay(piece: Piece, rng: np.random.Generator) -> Floats:
    """Delay the effort of a joint."""
    joint = piece.strong_joint(rng)
    effort = piece.column("effort")[:, joint]
    rows = max(1, round(LATE_S / piece.episode.spec.dt))
    late = effort[piece.onset - rows : len(effort) - rows]
    return piece.at_joint(joint, late - effort[piece.onset :])


class Fault(NamedTuple):
    """A fault that is added to a recording; none of them happened, as every table says."""

    column: str  # "position" or "effort"
    added: Callable[[Piece, np.random.Generator], Floats | None]  # (T - onset, J) from the onset on
    needs_body: bool = False


ADDED_FAULTS = {
    "push": Fault("effort", push, needs_body=True),
    "payload": Fault("effort", payload, needs_body=True),
    "step": Fault("effort", step),
    "frozen": Fault("position", freeze),
    "slipped": Fault("position", slip),
    "late": Fault("effort", delay),
}


def with_fault(kind: str, piece: Piece, rng: np.random.Generator) -> Episode | None:
    """Return the piece with a fault from the onset on; None where the piece does not allow it."""
    fault = ADDED_FAULTS[kind]
    if fault.needs_body and piece.body is None:
        return None
    added = fault.added(piece, rng)
    if added is None:
        return None
    spec = piece.episode.spec
    columns = spec.slices[fault.column]
    stream = piece.episode.stream.copy()
    stream[piece.onset :, columns] += added.astype(np.float32)
    is_faulty = np.arange(len(stream)) >= piece.onset
    return Episode.from_stream(stream, spec, faults=is_faulty)


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
    present = []
    missing = []
    for name in config.experiments:
        path = config.folder / ARMS[name].bag
        if path.exists():
            present.append(name)
        else:
            missing.append(f"{path} is missing: it is {SOURCE}")
    if not present:
        raise FileNotFoundError("; ".join(missing))

    grid = product(present, config.monitors, config.repetitions, range(FOLDS))
    jobs = [Job._make(one) for one in grid]
    work = partial(examined, folder=config.folder)
    records = kit.records_of("watching", work, jobs, config)
    tables = [table(kit.where(records, experiment=name), ARMS[name]) for name in present]
    left_out = "".join(f" Left out: {reason}." for reason in missing)
    tables[0] = replace(tables[0], caption=tables[0].caption + left_out)
    return Findings(records, tables)


class Split(NamedTuple):
    """Pieces of a recording by their use."""

    learned: list[Episode]
    calibration: list[Episode]
    tested: list[Episode]


def split(job: Job, whole: Episode) -> Split:
    """Cut a recording into pieces, and deal them out for one fold."""
    cut = [piece for part in complete_parts(whole) for piece in pieces(part, PIECE_S)]
    order = np.random.default_rng(job.seed).permutation(len(cut))
    is_tested = np.arange(len(cut)) % FOLDS == job.fold
    tested = np.sort(order[is_tested])
    others = order[~is_tested]
    if len(others) < 4:
        raise ValueError(f"{job.experiment} has {len(cut)} pieces of {PIECE_S:g} s: too few")
    is_learned = np.arange(len(others)) % 3 > 0
    return Split(
        learned=[cut[i] for i in others[is_learned]],
        calibration=[cut[i] for i in others[~is_learned]],
        tested=[cut[i] for i in tested],
    )


def examined(job: Job, folder: Path) -> list[Record]:
    """Return a record for each tested piece as it is, and for each fault in it."""
    arm = ARMS[job.experiment]
    whole = Episode.from_table(read_joint_states(folder / arm.bag), success=True)
    spec = whole.spec
    use = split(job, whole)
    urdf = read_body(folder, arm)
    monitor = fitted(job, use.learned, urdf)
    rate = 1.0 / (len(use.calibration) + 1)
    threshold = monitor.calibrate(use.calibration, rate).threshold

    effort = whole.stream[:, spec.slices["effort"]].astype(np.float64)
    low, high = np.quantile(effort, (0.05, 0.95), axis=0)
    body = BodyModel.of(urdf, spec.labels[spec.slices["position"]])
    rng = np.random.default_rng([job.seed, job.fold])  # the same faults for every monitor
    kinds = [""] * len(use.tested)
    episodes = [*use.tested]
    for episode, kind in product(use.tested, ADDED_FAULTS):
        piece = Piece(episode, onset=len(episode) // 2, ranges=high - low, body=body)
        faulty = with_fault(kind, piece, rng)
        if faulty is not None:
            kinds.append(kind)
            episodes.append(faulty)
    records = []
    for kind, score in zip(kinds, monitor.score_episodes(episodes), strict=True):
        result = result_of(kind, score.value / threshold, spec.dt)
        records.append(job._asdict() | result)
    return records


def fitted(job: Job, episodes: Sequence[Episode], urdf: str) -> Any:
    """Return the monitor of a job, fitted; one that is named with a body reads the text of ``urdf``."""
    spec = episodes[0].spec
    name = job.monitor.removesuffix(BODY)
    settings: dict[str, Any] = {}
    if name == "neural_asm":
        settings["values"] = True  # as ``asm-gym fit`` fits a log
    if job.monitor in WITH_BODY:
        settings["urdf"] = urdf
    if name == RULE:
        rule = FrictionRule(spec, **settings)
        monitor: Any = CalibratedMonitor(rule, Largest(spec), seed=job.seed)
    else:
        monitor = make_monitor(name, spec, seed=job.seed, **settings)
    return monitor.fit(list(episodes))


def result_of(kind: str, surprise: Floats, dt: float) -> Record:
    """Return the result of a piece, by its surprise (T,) [thresholds]; a fault begins in its middle."""
    is_over = surprise > 1
    if not kind:
        return {
            "kind": kind,
            "alarms": alarms_in(surprise, 1.0, dt),
            "alarm_s": is_over.sum() * dt,
            "seconds": len(surprise) * dt,
            "excess": float(surprise.max()),
        }
    onset = len(surprise) // 2
    rows_over = np.flatnonzero(is_over[onset:])
    found = bool(len(rows_over)) and not is_over[:onset].any()
    delay = np.nan
    if found:
        delay = dt * (rows_over[0] + 1)
    excess = float(surprise[onset:].max())
    return {"kind": kind, "found": found, "delay": delay, "excess": excess}


def table(records: pd.DataFrame, arm: RealArm) -> Table:
    """Return the table of a recording, a row for each monitor."""
    healthy = records[records.kind == ""]
    monitors = records.groupby("monitor", sort=False)
    pieces_over = (healthy.excess > 1).groupby(healthy.monitor).sum()
    fewest = int(pieces_over.min())
    seconds = healthy.seconds.sum() / len(monitors)
    caption = (
        f"{arm.robot} ({arm.bag}), {seconds:.0f} s as recorded. "
        "* added to the recording, found within half a piece. "
        f"At {fewest}: pushes and payloads found by the threshold "
        f"that {fewest} healthy pieces pass."
    )
    return kit.table_of(caption, [monitor_row(name, own, fewest) for name, own in monitors])


def monitor_row(name: str, records: pd.DataFrame, fewest: int) -> dict[str, str]:
    """Return the row of a monitor.

    Monitors are compared at thresholds of their own that ``fewest`` healthy pieces pass.
    """
    row = {"Monitor": name}
    for kind in ADDED_FAULTS:
        faulty = records[records.kind == kind]
        if len(faulty):
            row[f"{kind} *"] = f"{faulty.found.astype(int).sum()} of {len(faulty)}"
    row["delay [s]"] = ""
    if records.delay.notna().any():
        row["delay [s]"] = f"{records.delay.median():.3g}"

    healthy = records[records.kind == ""]
    pushed = records[records.kind.isin(["push", "payload"])]
    comparable_threshold = healthy.excess.nlargest(fewest + 1).iloc[-1]
    is_found = pushed.excess > comparable_threshold
    row[f"at {fewest}"] = f"{is_found.sum()} of {len(pushed)}"
    seconds = healthy.seconds.sum()
    row["false alarms an hour"] = f"{3600 * healthy.alarms.sum() / seconds:.0f}"
    row["healthy time in alarm"] = f"{100 * healthy.alarm_s.sum() / seconds:.1f} %"
    return row
