"""Learn a memory of normal motion from recordings: run folders, datasets, or logs of a robot.

The memory learns from half of the episodes; the others set the threshold. Episodes that failed or contain a fault are
left out. A file of a folder that cannot be read is named and left out, with exit code 2.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data import selection
from asm_gym.data.episode import Episode
from asm_gym.data.live import lines_from, live_source, record
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.selection import SHORTEST_S, normal_episodes, pieces
from asm_gym.data.timing import bridge_of, filled
from asm_gym.detection import conformal_episodes
from asm_gym.detection.conformal import EPISODE
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE
from asm_gym.files import writable
from asm_gym.monitors import MONITORS, CalibratedMonitor, NeuralASM, make_monitor, monitor_class
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.monitor_registry import check_monitor_name
from asm_gym.monitors.torque.urdf import read_urdf
from asm_gym.monitors.torque.value_association import ValueAssociation
from asm_gym.monitors.training_data import mute_channels
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import option, run
from asm_gym.scripts.log_options import LogOptions, ended
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import check_number

SILENCE_S = 2.0  # a live source without a row for this long has ended [s]
# longest pieces of a live recording [s], and how many more there are than the promise needs
PIECE_S, SPARE = (
    5.0,
    4,
)
ANY_EPISODE = 0.5  # a rate that one episode can promise: a promise by the hour needs hours
CALIBRATION_SHARE = 0.5  # share of the episodes that set the threshold, and are not learned from
QUICK_EPISODES, QUICK_EPOCHS = 20, 5  # most episodes and passes with ``--quick``


@dataclass(frozen=True, kw_only=True)
class Args(LogOptions):
    """A memory from recordings."""

    data: Path = option(positional=True, metavar="DATA")
    """A log or a folder of logs (.csv, .tsv, .txt, .jsonl, .parquet, .npz, .npy; .mcap, .db3 or .bag of ROS), a LeRobot
    or Minari dataset, or a run folder of collect or evaluate. Or a live source of asm-gym watch with JSON objects,
    which is recorded beside FILE."""
    out: Path = option(Path("runs/fit/memory.asm"), metavar="FILE")
    """File to write the memory to."""
    monitor: str = option("neural_asm", check=check_monitor_name, known=MONITORS)
    """Name of the monitor."""
    false_alarm_rate: float = option(FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of normal episodes that may raise an alarm, in (0, 1)."""
    false_alarms_per_hour: float | None = option(None, metavar="X")
    """Alarms per hour of normal motion, in place of --false-alarm-rate."""
    action: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns of commands: names, or patterns such as 'cmd*'."""
    bridge: float | None = option(
        None, check=partial(check_number, "bridge", low=0.0), metavar="SECONDS"
    )
    """Longest gap to interpolate, by default two rows; a log is cut at longer gaps."""
    urdf: Path | None = option(None, metavar="FILE")
    """Body model of the arm, to predict torques from the weight of its links, which finds weaker pushes."""
    split: float | None = option(
        None, check=partial(check_number, "split", above=0), metavar="SECONDS"
    )
    """Cut long logs into pieces of this length; each piece counts as an episode."""
    minutes: float = option(10.0, check=partial(check_number, "minutes", above=0))
    """Longest recording of a live source."""
    seed: int = option(0, least=0)
    """Seed of the memory and of the choice of episodes to learn from."""
    quick: bool = False
    """Learn briefly from few episodes, to see that the command works."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.promise  # refuses an impossible rate
        if self.out.is_dir():
            raise ValueError(f"out must be a file, and {self.out} is a folder")
        if self.urdf is not None and "urdf" not in monitor_class(self.monitor).hyperparameters:
            raise ValueError(f"{self.monitor} takes no body model: leave --urdf out")

    @property
    def promise(self) -> AlarmRate:
        """The promise of the threshold."""
        hourly = self.false_alarms_per_hour
        return AlarmRate.of(self.false_alarm_rate if hourly is None else None, hourly)

    @property
    def needed(self) -> int:
        """Calibration episodes that the promise takes; 0 for one by the hour."""
        return conformal_episodes(self.false_alarm_rate) if self.promise.per == EPISODE else 0


def record_live(args: Args, say: Callable[[str], None]) -> Args:
    """Record a live source; return how to learn from that, cut into as many pieces as the promise needs."""
    to = args.out.with_suffix(".jsonl")
    seconds, ended = record(lines_from(str(args.data), sys.stdin, SILENCE_S), to, args.minutes)
    say(f"{ended}, kept in {to}")
    count = args.needed / CALIBRATION_SHARE + SPARE if args.needed else 1
    split = args.split or min(PIECE_S, seconds / count)
    return replace(args, data=to, split=max(split, SHORTEST_S))


def divide(
    args: Args, logs: list[list[Episode]], in_time: bool
) -> tuple[list[Episode], list[Episode]]:
    """Return episodes to learn from, and to calibrate on. Raises ValueError where they are too few for the promise."""
    by_episode = args.promise.per == EPISODE
    if in_time or (args.split is not None and not by_episode):
        fitting, calibration = selection.split_in_time(logs, CALIBRATION_SHARE)
        if len(calibration) < args.needed:
            raise ValueError(
                f"a false-alarm rate of {args.false_alarm_rate:g} needs {args.needed} pieces to calibrate on, got "
                f"{len(calibration)} of {args.split:g} s: record for longer, or take a higher --false-alarm-rate"
            )
    else:
        needed = conformal_episodes(args.false_alarm_rate if by_episode else ANY_EPISODE)
        fitting, calibration = selection.split_at_random(
            [p for log in logs for p in log], needed, CALIBRATION_SHARE, args.seed
        )
    args.promise.check_hours(hours_of(calibration))
    return fitting[: QUICK_EPISODES if args.quick else None], calibration


def parts_between_gaps(args: Args, episodes: list[Episode]) -> tuple[list[Episode], list[str]]:
    """Return the parts between lost rows, short gaps filled, and what was done, a line each.

    Where parts are too few for the promise, logs are cut at short gaps too, as they would be without a bridge.
    Raises ValueError where no part is left, and says which numbers are missing.
    """
    dt = episodes[0].spec.dt
    seconds = bridge_of(args.bridge, dt)
    bridged = [replace(e, stream=filled(e.stream, dt, seconds)) for e in episodes]
    cut = [selection.complete_parts(e) for e in bridged]
    if args.split is None and sum(map(len, cut)) < args.needed / CALIBRATION_SHARE:
        shorter = [selection.complete_parts(e) for e in episodes]
        if sum(map(len, shorter)) > sum(map(len, cut)):
            bridged, cut = episodes, shorter
    parts = [part for of_one in cut for part in of_one]
    if not parts:
        missing = np.mean([np.isnan(e.stream).mean(axis=0) for e in episodes], axis=0)  # (D,)
        worst = [
            f"{episodes[0].spec.labels[k]} in {missing[k]:.0%}"
            for k in np.argsort(-missing)[:4]
            if missing[k]
        ]
        raise ValueError(
            f"no stretch of {SHORTEST_S:g} s is complete: rows that lack a number are {', '.join(worst)} of all; "
            "--ignore leaves such columns out, --bridge SECONDS fills longer gaps"
        )
    rows = sum(
        int((np.isnan(a.stream) != np.isnan(b.stream)).any(axis=1).sum())
        for a, b in zip(episodes, bridged, strict=True)
    )
    said = (
        [f"Filled {rows} rows that lacked a number, in gaps of at most {seconds:.3g} s."]
        if rows
        else []
    )
    holed = [
        of_one
        for of_one, whole in zip(cut, bridged, strict=True)
        if not np.isfinite(whole.stream).all()
    ]
    if holed:
        hint = "" if args.bridge else " --bridge 0.05 fills gaps up to 0.05 s."
        made = sum(map(len, holed))
        said.append(
            f"Rows were lost: {len(holed)} of {len(cut)} episodes were cut there, into {made} parts.{hint}"
        )
    return parts, said


def settings(args: Args) -> dict[str, Any]:
    """Return the hyperparameters that suit the recordings."""
    suitable: dict[str, Any] = {"seed": args.seed}
    if args.quick:
        suitable["epochs"] = QUICK_EPOCHS
    if args.urdf is not None:
        suitable["urdf"] = read_urdf(args.urdf)
    known = monitor_class(args.monitor).hyperparameters
    return {name: value for name, value in suitable.items() if name in known}


def notes_on_columns(args: Args, spec: StreamSpec) -> Iterator[str]:
    """Yield notes on which columns of a log are commands."""
    names = ", ".join(c.name for c in spec.channels if c.group == MOTOR)
    if spec.source == "table" and not names:
        yield "no command is recorded, so faults are found later; --action names the columns of commands"
    elif spec.source == "table" and not args.action:
        yield f"read as commands, by name: {names}; the output of a controller would hide pushes"


def notes_on_body(args: Args, monitor: CalibratedMonitor) -> Iterator[str]:
    """Yield notes on the gain from the body model, and the column of each joint."""
    values = monitor.values_ if isinstance(monitor, NeuralASM) else None
    model = monitor.model if values is None else values.monitor.model
    if args.urdf is None or not isinstance(model, ValueAssociation):
        return
    left = f"with it the squared error of held-out torques is {model.left_by_body:.2f} of that without it"
    if model.links is None:
        yield f"{args.urdf} is not used: {left}; check its masses, and that it names joints as the log does"
        return
    joints = ", ".join(f"{label} for {joint}" for label, joint in model.joints)
    how = (
        "by name"
        if model.links.by_name
        else "by the best fit to the torques, as no column names a joint"
    )
    yield f"{args.urdf} is used: {left}; angles are assigned {how}: {joints}"


def hours_of(episodes: list[Episode]) -> float:
    """Return their total length [h]."""
    return sum(len(e) * e.spec.dt for e in episodes) / 3600


def fit(args: Args, console: Console) -> int:
    """Read, learn, calibrate, save, and print a summary."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    live = live_source(str(args.data)) is not None
    args = record_live(args, say) if live else args
    start = time.perf_counter()
    writable(args.out)
    with stage("reading", console, {}) as progress, noted() as notes:
        found, reasons = normal_episodes(
            read_logs(args.data, args.hints(args.action), args.given_schema()),
            args.split is not None,
            progress,
        )
    left_out = ", ".join(f"{count} {why}" for why, count in reasons.items())
    if not found:
        hint = (
            "; --split 5 learns from between the marked rows of a log" if args.split is None else ""
        )
        hint += (
            "; --ignore a column that is wrongly taken for a label"
            if reasons["with a fault"]
            else ""
        )
        raise ValueError(f"{args.data} holds no normal episode: {left_out or 'it is empty'}{hint}")
    parts, cuts = parts_between_gaps(args, found)
    fitting, calibration = divide(
        args, [[p] if args.split is None else pieces(p, args.split) for p in parts], live
    )
    spec = fitting[0].spec
    with stage("learning", console, {}) as progress:
        monitor: Any = make_monitor(args.monitor, spec, **settings(args)).fit(fitting, progress)
        monitor.calibrate(calibration, **args.promise.named)
    monitor.save(args.out)
    for line in [
        *notes,
        *notes_on_columns(args, spec),
        *notes_on_body(args, monitor),
        *mute_channels(fitting),
    ]:
        say(f"Note: {line}.")
    rows, hours, used = sum(map(len, fitting)), monitor.blocks_.total, len(monitor.maxima_)
    say(
        f"Learned from {len(fitting)} episodes: {rows} rows of {spec.size} numbers, {1 / spec.dt:g} a second."
    )
    for line in [f"Left out: {left_out}."] * bool(left_out) + cuts:
        say(line)
    promise = f"at most {args.promise.rate:g} alarms an hour, from {hours:.3g} normal hours"
    if args.promise.per == EPISODE:
        promise = f"an alarm in at most {args.false_alarm_rate:.1%} of normal ones"
    modelled = (
        ", by a model of the tail of their maxima, as they are few"
        if monitor.promise.modelled
        else ""
    )
    ceilings = (
        f"; {len(calibration) - used} more say how far each sense goes"
        if used < len(calibration)
        else ""
    )
    say(
        f"Threshold {monitor.threshold:.4g}, from {used} other episodes: {promise}{modelled}{ceilings}."
    )
    expected, most = monitor.promise.hourly(hours)
    more = (
        ""
        if expected <= 1.0
        else f" A promise of 1 an hour takes {1 / CALIBRATION_SHARE:g} hours of recordings."
    )
    say(
        f"Expected false alarms for motion as in these {60 * hours:.2g} minutes: {expected:.3g} an hour, at most "
        f"{most:.3g} with 95 % confidence; other motion raises more.{more}"
    )
    seconds = time.perf_counter() - start
    say(f"Wrote {args.out} after {seconds:.0f} s. Next: asm-gym watch LOG --monitor {args.out}")
    return ended(notes)


main = partial(run, "fit", Args, fit)
