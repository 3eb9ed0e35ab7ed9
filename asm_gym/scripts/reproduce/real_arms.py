"""What monitors find in recordings of real arms: faults added to them, labelled ones, and false alarms.

The recordings are of others and lie in a folder; a missing one is named, with where it is published. Runs in which the
arm did nothing wrong are cut into pieces and dealt out at random. A quarter of the pieces is tested, in turn; of the
others two in three are learned from, and the rest sets the threshold, for the fewest false alarms an hour that it can
promise. Each tested piece is watched as it is, and a clip about its middle with each fault for a second. Pieces are of
one robot and few programs: no table says how a monitor fares on other motion.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.data.training_selection import complete_parts, pieces
from asm_gym.detection.incidents import incidents_in, power_of
from asm_gym.detection.scores import Largest
from asm_gym.evaluation.statistics import Rate
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import MONITORS, CalibratedMonitor, make_monitor
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.sight import MOST, clip_of, first_alarm, seen_again, sights
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.monitors.torque.urdf import read_urdf
from asm_gym.readings import spans
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.added_faults import ADDED_FAULTS, POSITION, Piece, with_fault
from asm_gym.scripts.reproduce.arm_recordings import ARMS, REAL, RealArm
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.torque_residuals import RESIDUAL, residual_records, residual_table

Floats = NDArray[np.float64]
LOG = logging.getLogger("asm_gym.reproduce")

RULE = "friction_rule"
BODY = ", body"  # ends the name of a monitor that reads the arm's URDF
WITH_BODY = tuple(name + BODY for name in ("neural_asm", "association_values", RULE))
SEES = "sees"  # kind of the errors that a monitor says it sees
HALF_SECOND = 0.5  # length of the windows in which senses may rest [s]
AT_REST = 0.1  # share of these windows in which they do
FOLDS = 4  # of which one is tested at a time


@dataclass(frozen=True)
class Config(kit.Config):
    """What monitors find in recordings of real arms."""

    folder: Path = option(Path("real_arms"), positional=True, metavar="FOLDER")
    """Folder of the recordings."""
    seeds: int = option(1, least=1)
    """How often pieces are drawn anew."""
    experiments: tuple[str, ...] = option(REAL, quick=("panda",), least=1, known=ARMS)
    """Recordings; missing ones are left out, and named. One set is simulated."""
    monitors: tuple[str, ...] = option(
        ("neural_asm", "association_values", RULE, RULE + BODY, "gru", "kalman"),
        quick=("association_values", RULE),
        least=1,
        known=(*MONITORS, *WITH_BODY, RULE),
    )
    """Monitors; those named with a body read the arm's URDF."""
    folds: int = option(FOLDS, least=1)
    """How many of the four quarters are tested, in turn."""
    minutes: tuple[float, ...] = option((0.0,), least=1)
    """Most minutes to learn from, in turn; 0 for all that there are."""


class Job(NamedTuple):
    """One monitor on one fold of one recording."""

    experiment: str
    monitor: str
    seed: int
    fold: int
    minutes: float = 0.0  # most to learn from; 0 for all


def run(config: Config) -> Findings:
    """Run the experiments whose recordings are in the folder."""
    present = []
    missing = []
    for name in config.experiments:
        path = config.folder / ARMS[name].place
        if path.exists() or not ARMS[name].place:
            present.append(name)
        else:
            missing.append(f"{path} is missing: it is {ARMS[name].source}")
    if not present:
        raise FileNotFoundError("; ".join(missing))

    grid = product(
        present, config.monitors, config.repetitions, range(config.folds), config.minutes
    )
    jobs = [job for job in map(Job._make, grid) if is_possible(job)]
    work = partial(examined, folder=config.folder)
    records = kit.records_of("watching", work, jobs, config)
    present = watched(records, present)
    tables = [table(kit.where(records, experiment=name), ARMS[name]) for name in present]
    left_out = "".join(f" Left out: {reason}." for reason in missing)
    with_torques = [name for name in present if ARMS[name].has_joint_torques]
    tables += [residual_table(kit.where(records, experiment=name)) for name in with_torques]
    others = [name for name in present if not ARMS[name].one_campaign]
    tables += [noise_table(ARMS[name], config.folder) for name in others]
    tables[0] = replace(tables[0], caption=tables[0].caption + left_out)
    return Findings(records, tables)


def is_possible(job: Job) -> bool:
    """Return whether the arm senses what the monitor needs."""
    arm = ARMS[job.experiment]
    if job.monitor in WITH_BODY and not arm.urdf:
        return False
    return arm.has_joint_torques or not job.monitor.startswith(RULE)


class Split(NamedTuple):
    """Pieces of recordings by their use."""

    learned: list[Episode]
    calibration: list[Episode]
    tested: list[Episode]


def split(job: Job, runs: Sequence[Episode]) -> Split:
    """Cut runs into pieces, and deal them out for one fold."""
    parts = [part for whole in runs for part in complete_parts(whole)]
    cut = parts
    piece_s = ARMS[job.experiment].piece_s
    if np.isfinite(piece_s):
        cut = [piece for part in parts for piece in pieces(part, piece_s)]
    order = np.random.default_rng(job.seed).permutation(len(cut))
    is_tested = np.arange(len(cut)) % FOLDS == job.fold
    tested = np.sort(order[is_tested])
    others = order[~is_tested]
    if len(others) < 4:
        raise ValueError(f"{job.experiment} has {len(cut)} pieces of {piece_s:g} s: too few")
    is_learned = np.arange(len(others)) % 3 > 0
    learned = [cut[i] for i in others[is_learned]]
    if job.minutes:
        ends = np.cumsum([minutes_of([piece]) for piece in learned])
        learned = learned[: max(1, int((ends <= job.minutes).sum()))]
    return Split(
        learned=learned,
        calibration=[cut[i] for i in others[~is_learned]],
        tested=[cut[i] for i in tested],
    )


def minutes_of(episodes: Sequence[Episode]) -> float:
    """Return the length of episodes [min]."""
    return sum(len(episode) * episode.spec.dt for episode in episodes) / 60


def watched(records: Sequence[Record], present: Sequence[str]) -> list[str]:
    """Return the recordings on which a monitor has a threshold."""
    found = {record["experiment"] for record in records}
    if not found:
        raise ValueError("no monitor has a threshold on any recording: see the warnings")
    return [name for name in present if name in found]


def read_body(folder: Path, arm: RealArm) -> str:
    """Return the text of an arm's URDF; empty where the arm has none."""
    if not arm.urdf:
        return ""
    path = folder / "urdf" / arm.urdf
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: it is in example-robot-data 6.0.0 (PyPI)")
    return read_urdf(path)


def examined(job: Job, folder: Path) -> list[Record]:
    """Return a record for each tested piece as it is, for each fault in it, and for each labelled fault.

    There is none where the calibration set is too unlike what was learned from for any threshold; that is logged.
    """
    arm = ARMS[job.experiment]
    runs, labelled = arm.episodes(folder)
    use = split(job, runs)
    urdf = read_body(folder, arm)
    monitor = fitted(job, use.learned, urdf)
    promised = 60.0 / minutes_of(use.calibration)  # the fewest that it can promise [1/h]
    try:
        monitor.calibrate(use.calibration, false_alarms_per_hour=promised * (1 + 1e-9))
    except ValueError as error:
        LOG.warning(
            "left out: %s on quarter %d of %s: %s", job.monitor, job.fold, job.experiment, error
        )
        return []
    about = {**job._asdict(), "learned_min": minutes_of(use.learned), "promised": promised}

    scores = monitor.score_episodes(use.tested)
    records = [about | healthy_result(monitor, score) for score in scores]
    kinds, clips = faulty_clips(job, arm, use.tested, urdf)
    for kind, clip, score in zip(kinds, clips, monitor.score_episodes(clips), strict=True):
        records.append(about | fault_result(monitor, kind, clip, score))
    if job.fold == 0:
        if arm.has_joint_torques:
            records += [about | one for one in residual_records(monitor, use.tested)]
        again = seen_again(monitor, sights(monitor, use.calibration), use.tested)
        records += [about | {"kind": SEES, "found": found} for found in again]
        for kind, episodes in labelled.items():
            for episode, score in zip(episodes, monitor.score_episodes(episodes), strict=True):
                records += [about | one for one in labelled_results(monitor, kind, episode, score)]
    return records


def fitted(job: Job, episodes: Sequence[Episode], urdf: str) -> CalibratedMonitor:
    """Return the monitor of a job, fitted; one that is named with a body reads the text of ``urdf``."""
    spec = episodes[0].spec
    name = job.monitor.removesuffix(BODY)
    settings: dict[str, Any] = {}
    if job.monitor in WITH_BODY:
        settings["urdf"] = urdf
    if name == RULE:
        rule = FrictionRule(spec, **settings)
        return CalibratedMonitor(rule, Largest(spec), seed=job.seed).fit(list(episodes))
    return make_monitor(name, spec, seed=job.seed, **settings).fit(list(episodes))


def faulty_clips(
    job: Job, arm: RealArm, tested: Sequence[Episode], urdf: str
) -> tuple[list[str], list[Episode]]:
    """Return kinds of faults, and a clip with each."""
    spec = tested[0].spec
    body = None
    if urdf:
        body = BodyModel.of(urdf, spec.labels[spec.slices[POSITION]])
    ranges = np.zeros(0)
    if arm.efforts:
        effort = np.concatenate([episode.stream for episode in tested]).astype(np.float64)
        columns = Piece(tested[0], 0, ranges=ranges, body=None, arm=arm).columns("effort")
        low, high = np.quantile(effort[:, columns], (0.05, 0.95), axis=0)
        ranges = high - low
    rng = np.random.default_rng([job.seed, job.fold])  # the same faults for every monitor
    kinds = []
    clips = []
    for episode, kind in product(tested, ADDED_FAULTS):
        clip, onset = clip_of(episode)
        piece = Piece(clip, onset, ranges=ranges, body=body, arm=arm)
        faulty = with_fault(kind, piece, rng)
        if faulty is not None:
            kinds.append(kind)
            clips.append(faulty)
    return kinds, clips


def healthy_result(monitor: CalibratedMonitor, score: Surprise) -> Record:
    """Return how many alarms a healthy piece raises, and its largest surprise [thresholds]."""
    threshold = monitor.threshold
    dt = monitor.spec.dt
    shares_of = score.attribution.__getitem__
    alarms = incidents_in(score.value, threshold, dt, shares_of, power_of(monitor))
    return {
        "kind": "",
        "alarms": alarms,
        "alarm_s": (score.value > threshold).sum() * dt,
        "seconds": len(score.value) * dt,
        "excess": float(score.value.max() / threshold),
    }


def fault_result(monitor: CalibratedMonitor, kind: str, clip: Episode, score: Surprise) -> Record:
    """Return whether a fault was found, after which delay [s], and its largest surprise [thresholds]."""
    onset = int(clip.faults.argmax())
    alarm_row = first_alarm(score, monitor.threshold, onset)
    delay = np.nan
    if alarm_row is not None:
        delay = clip.spec.dt * (alarm_row - onset + 1)
    excess = float(score.value[onset:].max() / monitor.threshold)
    found = alarm_row is not None
    return {"kind": kind, "added": True, "found": found, "delay": delay, "excess": excess}


def labelled_results(
    monitor: CalibratedMonitor, kind: str, episode: Episode, score: Surprise
) -> list[Record]:
    """Return whether each labelled stretch of a run was found; a run without a label is one stretch."""
    is_faulty = np.ones(len(episode), bool)
    if episode.faults.any():
        is_faulty = episode.faults
    records = []
    for start, stop in spans(is_faulty):
        excess = float(score.value[start:stop].max() / monitor.threshold)
        seconds = (stop - start) * episode.spec.dt
        record = {"kind": kind, "added": False, "found": excess > 1, "excess": excess}
        records.append({**record, "seconds": seconds})
    return records


def table(records: pd.DataFrame, arm: RealArm) -> Table:
    """Return the table of a recording, a row for each monitor and for each length that it learned from."""
    by_row = records.groupby(["monitor", "minutes"], sort=False)
    healthy = records[records.kind == ""]
    over = (healthy.excess > 1).groupby([healthy.monitor, healthy.minutes]).sum()
    fewest = int(over.min())
    seconds = healthy.seconds.sum() / by_row.ngroups
    caption = (
        f"{arm.robot} ({arm.place}), {seconds / 60:.1f} min as recorded. * added to the recording, "
        f"found within a second. At {fewest}: added faults found by the threshold that {fewest} "
        "healthy pieces pass. Sees again: errors of the sizes that it says it sees in "
        f"{MOST:.0%} of places, that it sees in tested pieces without an alarm before."
    )
    rows = [monitor_row(name, own, fewest) for (name, _), own in by_row]
    columns = dict.fromkeys(column for row in rows for column in row)
    # Labelled faults are watched in the first quarter alone, where a monitor may have no threshold.
    return kit.table_of(caption, [{name: row.get(name, "") for name in columns} for row in rows])


def noise_table(arm: RealArm, folder: Path) -> Table:
    """Return the noise of each channel at rest in healthy runs, and in those with faults.

    Rest is the tenth of the half seconds of a run in which a sense varies least.
    """
    healthy, faulty = arm.episodes(folder)
    rows = []
    for kind, episodes in {"healthy": healthy, **faulty}.items():
        of_runs = []
        for episode in episodes:
            length = round(HALF_SECOND / episode.spec.dt)
            whole = episode.stream[: len(episode) // length * length]
            deviations = whole.reshape(-1, length, episode.spec.size).std(axis=1)
            of_runs.append(np.quantile(deviations, AT_REST, axis=0))
        noise = np.median(of_runs, axis=0)
        row: dict[str, str] = {"runs": kind}
        for name, columns in episodes[0].spec.slices.items():
            row[name] = f"{noise[columns].mean():.2g}"
        rows.append(row)
    caption = f"{arm.robot} ({arm.place}): deviation at rest, the median of runs"
    return kit.table_of(caption, rows)


def monitor_row(name: str, records: pd.DataFrame, fewest: int) -> dict[str, str]:
    """Return the row of a monitor.

    Monitors are compared at thresholds of their own that ``fewest`` healthy pieces pass. Of labelled stretches of rows
    some are found by chance, at the rate of false alarms.
    """
    healthy = records[records.kind == ""]
    again = records[records.kind == SEES]
    faulty = records[~records.kind.isin(("", SEES, RESIDUAL))]
    raised = Rate(int(healthy.alarms.sum()), healthy.seconds.sum() / 3600)
    row = {
        "Monitor": name,
        "learned [min]": f"{healthy.learned_min.mean():.3g}",
        "promised [1/h]": f"{healthy.promised.mean():.0f}",
        "raised [1/h]": raised.text,
    }
    for kind, own in faulty.groupby("kind", sort=False):
        cell = f"{own.found.astype(int).sum()} of {len(own)}"
        if own.added.all():
            row[f"{kind} *"] = cell
            continue
        by_chance = 1.0 - np.exp(-raised.value * own.seconds / 3600)
        row[kind] = f"{cell} ({by_chance.sum():.1f} by chance)"
    row["delay [s]"] = ""
    if records.delay.notna().any():
        row["delay [s]"] = f"{records.delay.median():.3g}"

    added = faulty[faulty.added.astype(bool)]
    comparable_threshold = healthy.excess.nlargest(fewest + 1).iloc[-1]
    row[f"at {fewest}"] = f"{(added.excess > comparable_threshold).sum()} of {len(added)}"
    row["sees again"] = f"{again.found.astype(int).sum()} of {len(again)}"
    row["time in alarm"] = f"{100 * healthy.alarm_s.sum() / healthy.seconds.sum():.1f} %"
    return row
