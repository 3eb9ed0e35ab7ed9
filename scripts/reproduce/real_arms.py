"""What is found in recordings of real arms: faults put into them, and faults that happened, with false alarms beside.

Recordings are of others, and must lie in a folder; what is missing is named, with where it is published. An arm that
did nothing wrong is cut into pieces. A quarter of them is tested, in turn; of the others two in three are learned from,
and one sets the threshold, their greatest surprise. Each tested piece is watched as it is, and with each fault, put
into its middle. Pieces are of the same trajectory: nothing here says how a monitor fares on another.

The UR3 of CobotOps stopped and lost its grip by itself; the executions of Camarinha-Matos and others failed or did not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.selection import pieces, unbroken
from asm_gym.detection.scores import Largest
from asm_gym.episode import Episode, spans
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import MONITORS, CalibratedMonitor, make_monitor
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.arm_recordings import (
    ARMS,
    COBOT_EVENTS,
    EXECUTION_ROWS,
    EXECUTION_S,
    RealArm,
    read_cobot,
    read_executions,
)
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.pushed import FAULTS

RULE = "friction_rule"
SETTINGS: dict[str, dict[str, Any]] = {
    "neural_asm": {"values": True},
    "association_values+evidence": {"shrinkage": 1.0},
}
"""The first as ``asm-gym fit`` has it of a log, the other without whitening, as the first has it beside."""
WITH_BODY = {"neural_asm, body": "neural_asm", "association_values, body": "association_values+evidence"}
"""With a body model in place of sines of angles."""
EXPERIMENTS = (*ARMS, "cobot", "executions")
AROUND_S = 5.0
"""An alarm so long before or after an event of the cobot belongs to it."""


@dataclass(frozen=True)
class Config(kit.Config):
    """What is found in recordings of real arms."""

    folder: Path = option(Path("real_arms"), positional=True, metavar="FOLDER")
    """Where the recordings lie."""
    seeds: int = option(1, least=1)
    """How often pieces are drawn anew."""
    workers: int = option(1, least=1)
    """Processes."""
    experiments: tuple[str, ...] = option(EXPERIMENTS, quick=("panda", "executions"), least=1, known=EXPERIMENTS)
    """Which recordings; those that are missing are left out, and named."""
    monitors: tuple[str, ...] = option(
        (
            *("neural_asm", "association_values+evidence", "association_linear+evidence", "kalman+evidence"),
            *("window_pca+evidence", "gru+evidence", RULE, "channel_limit"),
        ),
        quick=("association_values+evidence", RULE),
        least=1,
        known=(*MONITORS, *WITH_BODY, RULE),
    )
    """Names of monitors, friction_rule, or monitors with a body model."""
    piece: float = fixed(1.0)
    """Length of a piece [s]."""
    folds: int = fixed(4, least=2)
    """One in so many pieces is tested at a time."""


class Job(NamedTuple):
    """One monitor on one fold of one recording."""

    experiment: str
    monitor: str
    seed: int
    fold: int


def run(config: Config) -> Findings:
    """All experiments whose recordings are there."""
    missing = {name: why for name in config.experiments if (why := absent(name, config.folder))}
    there = [name for name in config.experiments if name not in missing]
    if not there:
        raise FileNotFoundError("; ".join(missing.values()))
    jobs = [
        Job(name, monitor, seed, fold)
        for name in there
        for monitor in config.monitors
        if not (monitor == RULE and name == "executions")
        and (monitor not in WITH_BODY or (name in ARMS and ARMS[name].urdf))
        for seed in config.repetitions
        for fold in range(config.folds)
    ]
    records = kit.together(kit.each("watching", partial(examined, config=config), jobs, config))
    tables = [table(records, name, config) for name in there]
    left_out = "".join(f" Left out: {why}." for why in missing.values())
    first, *others = tables
    return Findings(records, [replace(first, caption=first.caption + left_out), *others])


def absent(experiment: str, folder: Path) -> str:
    """Why an experiment cannot be made; empty where it can."""
    try:
        if experiment in ARMS:
            if not (folder / ARMS[experiment].place).exists():
                ARMS[experiment].episode(folder)
        elif experiment == "cobot":
            read_cobot(folder)
        else:
            next(read_executions(folder))
    except FileNotFoundError as error:
        return str(error)
    return ""


def examined(job: Job, config: Config) -> list[Record]:
    """What one monitor made of one fold."""
    if job.experiment in ARMS:
        found = on_an_arm(job, ARMS[job.experiment], config)
    else:
        found = {"cobot": on_the_cobot, "executions": on_executions}[job.experiment](job, config)
    return [
        {"experiment": job.experiment, "monitor": job.monitor, "seed": job.seed, "fold": job.fold} | r for r in found
    ]


# ------------------------------------------------------------------ faults put into recordings


def on_an_arm(job: Job, arm: RealArm, config: Config) -> list[Record]:
    """A record a tested piece and fault, and one of the piece as it is."""
    whole = arm.episode(config.folder)
    effort = whole.stream[:, whole.spec.slices["effort"]]
    ranges = (np.quantile(effort, 0.95, axis=0) - np.quantile(effort, 0.05, axis=0)).tolist()
    cut = [replace(p, info={"effort_range": ranges}) for part in unbroken(whole) for p in pieces(part, config.piece)]
    tested, learned, calibration = parted(len(cut), job, config)
    urdf = arm.body(config.folder) if job.monitor in WITH_BODY else ""
    monitor = fitted(job, [cut[i] for i in learned], urdf)
    threshold = greatest(monitor, [cut[i] for i in calibration])
    rng = np.random.default_rng([job.seed, job.fold])  # the same faults for every monitor
    quiet = [cut[i] for i in tested]
    made = [(i, kind, fault(cut[i], len(cut[i]) // 2, arm, rng)) for i in tested for kind, fault in FAULTS.items()]
    faulty = [(i, kind, episode) for i, kind, episode in made if episode is not None]
    scores = monitor.score_episodes([*quiet, *(episode for _, _, episode in faulty)])
    dt, records = whole.spec.dt, list[Record]()
    for i, score in zip(tested, scores[: len(quiet)], strict=True):
        records.append(quiet_record(score.value, threshold, dt) | {"piece": i})
    for (i, kind, episode), score in zip(faulty, scores[len(quiet) :], strict=True):
        onset = len(episode) // 2
        after = score.value[onset:]
        over = np.flatnonzero(after > threshold)
        before = bool((score.value[:onset] > threshold).any())
        record: Record = {"kind": kind, "piece": i, "found": bool(len(over)) and not before}
        record |= {"delay": 1e3 * dt * (over[0] + 1) if len(over) and not before else None}
        records.append(record | {"excess": float(after.max() / threshold)})
    return records


def quiet_record(value: NDArray[np.float64], threshold: float, dt: float) -> Record:
    """Of a piece in which nothing is wrong."""
    alarm = value > threshold
    count = len(spans(alarm))
    return {"kind": "", "alarms": count, "alarm_s": alarm.sum() * dt, "seconds": len(value) * dt} | {
        "excess": float(value.max() / threshold)
    }


def parted(count: int, job: Job, config: Config) -> tuple[list[int], list[int], list[int]]:
    """Which pieces are tested, learned from and set the threshold; none learned from is tested."""
    order = np.random.default_rng(job.seed).permutation(count)
    tested = order[job.fold :: config.folds]
    others = [int(i) for i in order if i not in set(tested.tolist())]
    if len(others) < 4:
        raise ValueError(f"{job.experiment} has {count} pieces of {config.piece:g} s: too few")
    return sorted(tested.tolist()), [i for n, i in enumerate(others) if n % 3], others[::3]


def fitted(job: Job, episodes: Sequence[Episode], urdf: str = "") -> Any:
    """The monitor, fitted; its threshold is set here, for so few pieces that none could be promised."""
    spec = episodes[0].spec
    name = WITH_BODY.get(job.monitor, job.monitor)
    if job.monitor == RULE:
        made = CalibratedMonitor(FrictionRule(spec), Largest(spec), seed=job.seed)
    else:
        body = {"urdf": urdf} if urdf else {}
        made = make_monitor(name, spec, seed=job.seed, **SETTINGS.get(name, {}), **body)
    return made.fit(list(episodes))


def greatest(monitor: Any, episodes: Sequence[Episode]) -> float:
    """The greatest surprise in what sets the threshold."""
    return max(float(score.value.max()) for score in monitor.score_episodes(list(episodes)))


# ------------------------------------------------------------------ faults that happened


def on_the_cobot(job: Job, config: Config) -> list[Record]:
    """A record an event of a contiguous part of the recording, and one of all else in it."""
    columns, events = read_cobot(config.folder)
    whole = Episode.from_table({n: v for n, v in columns.items()}, success=True)
    marks = {
        name: np.nan_to_num(Episode.from_table({**columns, "mark": wrong.astype(float)}).stream[:, -1], nan=0.0) > 0.5
        for name, wrong in events.items()
    }
    dt, rows = whole.spec.dt, len(whole)
    near = round(AROUND_S / dt)
    wrong = np.logical_or.reduce(list(marks.values()))
    close = np.convolve(wrong, np.ones(4 * near + 1), "same") > 0
    known = np.isfinite(whole.stream).all(axis=1)
    edges = np.quantile(np.flatnonzero(known), np.linspace(0, 1, config.folds + 1)).astype(int)
    mine = (np.arange(rows) >= edges[job.fold]) & (np.arange(rows) < edges[job.fold + 1])
    learnable = [s for s in spans(known & ~close & ~mine) if s[1] - s[0] >= 30]
    cut = [Episode.from_stream(whole.stream[a:b], whole.spec, success=True) for a, b in learnable]
    order = np.random.default_rng(job.seed).permutation(len(cut))
    monitor = fitted(job, [cut[i] for i in order[::2]])
    maxima = [float(s.value.max()) for s in monitor.score_episodes([cut[i] for i in order[1::2]])]
    threshold = float(np.quantile(maxima, 0.95))
    records, alarm = list[Record](), np.zeros(rows, np.bool_)
    parts = [(a, b) for a, b in spans(known & mine) if b - a >= 5]
    for (a, b), score in zip(
        parts,
        monitor.score_episodes([Episode.from_stream(whole.stream[a:b], whole.spec) for a, b in parts]),
        strict=True,
    ):
        alarm[a:b] = score.value > threshold
    begins = alarm & ~np.concatenate([[False], alarm[:-1]])  # what was in alarm before has found nothing
    watched = np.zeros(rows, np.bool_)
    for a, b in parts:
        watched[a:b] = True
    for name in COBOT_EVENTS:
        for a, b in spans(marks[name] & mine):
            around = slice(max(0, a - near), b + near)
            if watched[around].any():
                over = np.flatnonzero(begins[around])
                delay = None if not len(over) else (around.start + int(over[0]) - a) * dt
                records.append({"kind": name, "found": bool(len(over)), "delay": delay})
    quiet = watched & ~close
    onsets = [a for a, _ in spans(alarm) if quiet[a]]
    counted = {"kind": "", "alarms": len(onsets), "alarm_s": float((alarm & quiet).sum() * dt)}
    return [*records, counted | {"seconds": float(quiet.sum() * dt)}]


def on_executions(job: Job, config: Config) -> list[Record]:
    """A record an execution that was not learned from: how surprising its worst row was."""
    records: list[Record] = []
    by_problem: dict[str, list[tuple[str, NDArray[np.float64]]]] = {}
    for problem, kind, rows in read_executions(config.folder):
        by_problem.setdefault(problem, []).append((kind, rows))
    for problem, executions in by_problem.items():
        made = [
            Episode.from_table(
                {"force": rows[:, :3], "torque": rows[:, 3:]}, rate=EXECUTION_ROWS / EXECUTION_S, success=True
            )
            for _, rows in executions
        ]
        normal = [i for i, (kind, _) in enumerate(executions) if kind in ("normal", "ok")]
        tested = set(np.random.default_rng(job.seed).permutation(normal)[job.fold :: config.folds].tolist())
        monitor = fitted(job, [made[i] for i in normal if i not in tested])
        judged = [i for i in range(len(made)) if i in tested or i not in normal]
        for i, score in zip(judged, monitor.score_episodes([made[i] for i in judged]), strict=True):
            records.append({"kind": problem, "failed": i not in normal, "excess": float(score.value.max())})
    return records


# ------------------------------------------------------------------ tables


def table(records: Sequence[Record], experiment: str, config: Config) -> Table:
    """One of an experiment, a row a monitor."""
    own = [r for r in records if r["experiment"] == experiment]
    if experiment == "executions":
        return executions_table(own, config)
    kinds = [kind for kind in (*FAULTS, *COBOT_EVENTS) if any(r["kind"] == kind for r in own)]
    put_in = experiment in ARMS
    headings = ["Monitor", *(f"{k} *" if put_in else k for k in kinds), "delay"]
    headings += ["no false alarm"] if put_in else []
    rows = []
    for name in config.monitors:
        mine = [r for r in own if r["monitor"] == name]
        if mine:
            rows.append(row(name, mine, kinds, put_in))
    return Table(caption(experiment, own), [*headings, "false alarms an hour", "quiet time in alarm"], rows)


def caption(experiment: str, own: Sequence[Record]) -> str:
    """What the table is of."""
    quiet = [r for r in own if r["kind"] == "" and r["monitor"] == own[0]["monitor"]]
    seconds = sum(r["seconds"] for r in quiet)
    if experiment == "cobot":
        return f"UR3 of CobotOps, 1 Hz, events that happened, and {seconds / 3600:.1f} h between them."
    arm = ARMS[experiment]
    return (
        f"{arm.robot} ({arm.place}, {arm.licence}), {seconds:.0f} s as recorded. * put into the recording, found "
        "within half a piece. No false alarm: found by a threshold that no tested quiet piece of any fold passes."
    )


def row(name: str, mine: Sequence[Record], kinds: Sequence[str], put_in: bool) -> list[object]:
    """Of one monitor."""
    faulty, quiet = [r for r in mine if r["kind"]], [r for r in mine if not r["kind"]]
    cells: list[object] = [name]
    for kind in kinds:
        found = [r["found"] for r in faulty if r["kind"] == kind]
        cells.append(f"{sum(found)} of {len(found)}")
    delays = [r["delay"] for r in faulty if r["delay"] is not None]
    unit = "ms" if put_in else "s"
    cells.append(f"{np.median(delays):.0f} {unit}" if delays else "")
    if put_in:
        most = max(r["excess"] for r in quiet)
        clear = [r["excess"] > max(most, 1.0) for r in faulty]
        cells.append(f"{sum(clear)} of {len(clear)}")
    seconds = sum(r["seconds"] for r in quiet)
    cells.append(f"{3600 * sum(r['alarms'] for r in quiet) / seconds:.0f}")
    cells.append(f"{100 * sum(r['alarm_s'] for r in quiet) / seconds:.1f} %")
    return cells


def executions_table(own: Sequence[Record], config: Config) -> Table:
    """AUROC of failed executions against normal ones, by problem."""
    problems = sorted({r["kind"] for r in own})
    rows = []
    for name in config.monitors:
        mine = [r for r in own if r["monitor"] == name]
        if not mine:
            continue
        areas = [area([r for r in mine if r["kind"] == problem]) for problem in problems]
        rows.append([name, *(f"{a:.3f}" for a in areas), f"{np.mean(areas):.3f}"])
    folds, normal = len({r["fold"] for r in own}), sum(not r["failed"] for r in own) // max(len(rows), 1)
    said = (
        "Executions of a robot that failed or did not (UCI), force and torque of 15 rows: AUROC of the worst row, mean "
    )
    return Table(f"{said}over {folds} folds, {normal} normal executions.", ["Monitor", *problems, "mean"], rows)


def area(mine: Sequence[Record]) -> float:
    """The mean over folds, for each has a monitor of its own."""
    folds = sorted({(r["seed"], r["fold"]) for r in mine})
    found = []
    for fold in folds:
        here = [r for r in mine if (r["seed"], r["fold"]) == fold]
        failed, normal = ([r["excess"] for r in here if r["failed"] is what] for what in (True, False))
        if failed and normal:
            found.append(auroc(failed, normal))
    return float(np.mean(found))
