"""What monitors find in recordings of real arms: faults added to them, and events that happened; and false alarms.

The recordings are of others and lie in a folder; a missing one is named, with where it is published. A recording of an
arm that did nothing wrong is cut into pieces. A quarter of them is tested, in turn; of the others two in three are
learned from, and the greatest surprise of the rest is the threshold. Each tested piece is watched as it is, and with
each fault from its middle on. Pieces are of one trajectory: no table says how a monitor fares on another.

The UR3 of CobotOps stopped and lost its grip by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.selection import complete_parts, pieces
from asm_gym.detection.scores import Largest
from asm_gym.episode import Episode, spans
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import MONITORS, CalibratedMonitor, make_monitor
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.arm_faults import FAULTS, Piece, with_fault
from asm_gym.scripts.reproduce.arm_recordings import ARMS, COBOT, COBOT_EVENTS, COBOT_SOURCE, read_cobot, there
from asm_gym.scripts.reproduce.kit import Findings, Record, where

RULE = "friction_rule"
SETTINGS: dict[str, dict[str, Any]] = {
    "neural_asm": {"values": True},
    "association_values+evidence": {"shrinkage": 1.0},
}
"""The first as ``asm-gym fit`` fits a log, the other without whitening, as the first has it."""
WITH_BODY = {"neural_asm, body": "neural_asm", "association_values, body": "association_values+evidence"}
"""Monitors with a body model in place of sines of angles."""
EXPERIMENTS = (*ARMS, "cobot")
PIECE_S, FOLDS = 1.0, 4
"""Length of a piece [s], and folds of which one is tested at a time."""
AROUND_S = 5.0
"""An alarm this long before or after an event of the cobot belongs to it [s]."""


@dataclass(frozen=True)
class Config(kit.Config):
    """What monitors find in recordings of real arms."""

    folder: Path = option(Path("real_arms"), positional=True, metavar="FOLDER")
    """Folder of the recordings."""
    seeds: int = option(1, least=1)
    """How often pieces are drawn anew."""
    experiments: tuple[str, ...] = option(EXPERIMENTS, quick=("panda",), least=1, known=EXPERIMENTS)
    """Recordings; missing ones are left out, and named."""
    monitors: tuple[str, ...] = option(
        (
            *("neural_asm", "association_values+evidence", "association_linear+evidence", "kalman+evidence"),
            *("window_pca+evidence", "gru+evidence", RULE, "channel_limit"),
        ),
        quick=("association_values+evidence", RULE),
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
    missing = {name: why for name in config.experiments if (why := absent(name, config.folder))}
    found = [name for name in config.experiments if name not in missing]
    if not found:
        raise FileNotFoundError("; ".join(missing.values()))
    jobs = [
        Job(name, monitor, seed, fold)
        for name in found
        for monitor in config.monitors
        if monitor not in WITH_BODY or (name in ARMS and ARMS[name].urdf)
        for seed in config.repetitions
        for fold in range(FOLDS)
    ]
    records = kit.together(kit.each("watching", partial(examined, folder=config.folder), jobs, config))
    first, *others = (table(where(records, experiment=name), name, config.monitors) for name in found)
    left_out = "".join(f" Left out: {why}." for why in missing.values())
    return Findings(records, [replace(first, caption=first.caption + left_out), *others])


def absent(experiment: str, folder: Path) -> str:
    """Return why an experiment cannot be run; empty where it can."""
    place, source = (ARMS[experiment].place, ARMS[experiment].source) if experiment in ARMS else (COBOT, COBOT_SOURCE)
    try:
        there(folder / place, source)
    except FileNotFoundError as error:
        return str(error)
    return ""


def examined(job: Job, folder: Path) -> list[Record]:
    """Return the records of one monitor on one fold."""
    found = on_the_cobot(job, folder) if job.experiment == "cobot" else on_an_arm(job, folder)
    return [job._asdict() | record for record in found]


def fitted(job: Job, episodes: Sequence[Episode], urdf: str = "") -> Any:
    """Return the monitor of a job, fitted but not calibrated: no rate could be promised of so few pieces."""
    spec, name = episodes[0].spec, WITH_BODY.get(job.monitor, job.monitor)
    if job.monitor == RULE:
        return CalibratedMonitor(FrictionRule(spec), Largest(spec), seed=job.seed).fit(list(episodes))
    settings = SETTINGS.get(name, {}) | ({"urdf": urdf} if urdf else {})
    return make_monitor(name, spec, seed=job.seed, **settings).fit(list(episodes))


# ------------------------------------------------------------------ faults added to recordings


def on_an_arm(job: Job, folder: Path) -> list[Record]:
    """Return a record for each tested piece as it is, and for each fault in it."""
    arm = ARMS[job.experiment]
    whole = arm.episode(folder)
    effort = whole.stream[:, whole.spec.slices["effort"]]
    ranges = np.quantile(effort, 0.95, axis=0) - np.quantile(effort, 0.05, axis=0)
    cut = [piece for part in complete_parts(whole) for piece in pieces(part, PIECE_S)]
    tested, learned, calibration = parted(len(cut), job)
    monitor = fitted(job, [cut[i] for i in learned], arm.body(folder) if job.monitor in WITH_BODY else "")
    threshold = max(float(s.value.max()) for s in monitor.score_episodes([cut[i] for i in calibration]))
    rng = np.random.default_rng([job.seed, job.fold])  # the same faults for every monitor
    watched = [("", cut[i]) for i in tested]
    for i, kind in ((i, kind) for i in tested for kind in FAULTS):
        episode = with_fault(
            kind, Piece(cut[i], len(cut[i]) // 2, ranges.astype(np.float64), job.experiment == "panda"), rng
        )
        watched += [] if episode is None else [(kind, episode)]
    scores = monitor.score_episodes([episode for _, episode in watched])
    return [judged(kind, s.value / threshold, whole.spec.dt) for (kind, _), s in zip(watched, scores, strict=True)]


def judged(kind: str, value: NDArray[np.float64], dt: float) -> Record:
    """Return the record of a piece by its surprise as a multiple of the threshold (T,)."""
    if not kind:
        counted = {"alarms": len(spans(value > 1)), "alarm_s": (value > 1).sum() * dt, "seconds": len(value) * dt}
        return {"kind": kind, **counted, "excess": float(value.max())}
    before, after = np.split(value, [len(value) // 2])
    over = np.flatnonzero(after > 1)
    found = bool(len(over)) and not (before > 1).any()
    return {"kind": kind, "found": found, "delay": dt * (over[0] + 1) if found else None, "excess": float(after.max())}


def parted(count: int, job: Job) -> tuple[list[int], list[int], list[int]]:
    """Return the pieces that are tested, learned from, and set the threshold."""
    order = np.random.default_rng(job.seed).permutation(count)
    tested = order[job.fold :: FOLDS]
    others = [int(i) for i in order if i not in set(tested.tolist())]
    if len(others) < 4:
        raise ValueError(f"{job.experiment} has {count} pieces of {PIECE_S:g} s: too few")
    return sorted(tested.tolist()), [i for n, i in enumerate(others) if n % 3], others[::3]


# ------------------------------------------------------------------ events that happened


def on_the_cobot(job: Job, folder: Path) -> list[Record]:
    """Return a record for each event of a fold, a contiguous part of the recording, and one of the rest of it."""
    columns, events = read_cobot(folder)
    whole = Episode.from_table(columns, success=True)
    marks = {
        name: np.nan_to_num(Episode.from_table({**columns, "mark": rows.astype(float)}).stream[:, -1], nan=0.0) > 0.5
        for name, rows in events.items()
    }
    dt, rows = whole.spec.dt, np.arange(len(whole))
    near = round(AROUND_S / dt)
    close = np.convolve(np.logical_or.reduce(list(marks.values())), np.ones(4 * near + 1), "same") > 0
    known = np.isfinite(whole.stream).all(axis=1)
    edges = np.quantile(np.flatnonzero(known), np.linspace(0, 1, FOLDS + 1)).astype(int)
    mine = (rows >= edges[job.fold]) & (rows < edges[job.fold + 1])

    def cut(chosen: NDArray[np.bool_], least: int) -> list[tuple[int, Episode]]:
        parts = [(a, b) for a, b in spans(chosen) if b - a >= least]
        return [(a, Episode.from_stream(whole.stream[a:b], whole.spec, success=True)) for a, b in parts]

    healthy = [episode for _, episode in cut(known & ~close & ~mine, 30)]
    order = np.random.default_rng(job.seed).permutation(len(healthy))
    monitor = fitted(job, [healthy[i] for i in order[::2]])
    maxima = [float(s.value.max()) for s in monitor.score_episodes([healthy[i] for i in order[1::2]])]
    threshold = float(np.quantile(maxima, 0.95))
    alarm, watched = (np.zeros(len(whole), np.bool_) for _ in range(2))
    tested = cut(known & mine, 5)
    for (a, _), score in zip(tested, monitor.score_episodes([episode for _, episode in tested]), strict=True):
        alarm[a : a + len(score.value)] = score.value > threshold
        watched[a : a + len(score.value)] = True
    begins = alarm & ~np.concatenate([[False], alarm[:-1]])  # an alarm that lasts has found nothing new
    records: list[Record] = []
    for name in COBOT_EVENTS:
        for a, b in spans(marks[name] & mine):
            around = slice(max(0, a - near), b + near)
            if watched[around].any():
                over = np.flatnonzero(begins[around])
                delay = (around.start + int(over[0]) - a) * dt if len(over) else None
                records.append({"kind": name, "found": bool(len(over)), "delay": delay})
    quiet = watched & ~close
    alarms = sum(bool(quiet[a]) for a, _ in spans(alarm))
    counted = {"alarms": alarms, "alarm_s": float((alarm & quiet).sum() * dt), "seconds": float(quiet.sum() * dt)}
    return [*records, {"kind": "", **counted}]


# ------------------------------------------------------------------ tables


def table(own: Sequence[Record], experiment: str, monitors: Sequence[str]) -> Table:
    """Return the table of an experiment, a row for each monitor."""
    kinds = [kind for kind in (*FAULTS, *COBOT_EVENTS) if where(own, kind=kind)]
    added = experiment in ARMS
    rows = [row(name, where(own, monitor=name), kinds, added) for name in monitors if where(own, monitor=name)]
    seconds = sum(r["seconds"] for r in where(own, kind="", monitor=own[0]["monitor"]))
    if added:
        caption = (
            f"{ARMS[experiment].robot} ({ARMS[experiment].place}), {seconds:.0f} s as recorded. * added to the "
            "recording, found within half a piece. No false alarm: found by a threshold that no healthy piece passes."
        )
    else:
        caption = f"UR3 of CobotOps, 1 Hz, events that happened, and {seconds / 3600:.1f} h between them."
    headings = ["Monitor", *(f"{k} *" if added else k for k in kinds), "delay [s]"]
    headings += ["no false alarm"] if added else []
    return Table(caption, [*headings, "false alarms an hour", "quiet time in alarm"], rows)


def row(name: str, mine: Sequence[Record], kinds: Sequence[str], added: bool) -> list[object]:
    """Return the row of one monitor."""
    faulty, quiet = [r for r in mine if r["kind"]], where(mine, kind="")
    cells: list[object] = [name]
    for kind in kinds:
        found = [r["found"] for r in where(faulty, kind=kind)]
        cells.append(f"{sum(found)} of {len(found)}")
    delays = [r["delay"] for r in faulty if r["delay"] is not None]
    cells.append(f"{np.median(delays):.3g}" if delays else "")
    if added:
        most = max(1.0, *(r["excess"] for r in quiet))
        cells.append(f"{sum(r['excess'] > most for r in faulty)} of {len(faulty)}")
    seconds = sum(r["seconds"] for r in quiet)
    alarms, share = (sum(r[name] for r in quiet) / seconds for name in ("alarms", "alarm_s"))
    return [*cells, f"{3600 * alarms:.0f}", f"{100 * share:.1f} %"]
