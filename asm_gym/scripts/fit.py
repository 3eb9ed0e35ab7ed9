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
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data import training_selection
from asm_gym.data.bridging import bridge_of, filled
from asm_gym.data.episode import Episode
from asm_gym.data.live_sources import lines_from, live_source, record
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.training_selection import SHORTEST_PART_S, normal_episodes, pieces
from asm_gym.detection import conformal_episodes
from asm_gym.detection.conformal import EPISODE, hourly_promise
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE
from asm_gym.files import writable
from asm_gym.monitors import MONITORS, CalibratedMonitor, NeuralASM, make_monitor, monitor_class
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.monitor_registry import check_monitor_name
from asm_gym.monitors.sight import LASTS_S, MOST, sights
from asm_gym.monitors.torque.urdf import read_urdf
from asm_gym.monitors.torque.value_association import ValueAssociation
from asm_gym.monitors.training_data import mute_channels
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import option, run
from asm_gym.scripts.log_options import LogOptions, exit_code_of_reading
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import check_number

SILENCE_S = 2.0  # a live source without a row for this long has ended [s]
PIECE_S = 5.0  # longest pieces of a live recording [s]
SPARE_PIECES = 4  # pieces of a live recording beyond what the promise needs
FEWEST_WITHOUT_RATE = 4  # calibration episodes where no rate is asked for: one false alarm in 5
FEWEST_CALIBRATION = 1  # calibration episodes for a promise by the hour, which needs hours instead
CALIBRATION_SHARE = 0.5  # share of the episodes that set the threshold, and are not learned from
QUICK_EPISODES = 20  # most episodes with ``--quick``
QUICK_EPOCHS = 5  # most passes with ``--quick``
MOST_COLUMNS = 4  # incomplete columns that an error names


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
    false_alarm_rate: float | None = option(None, check=conformal_episodes, metavar="SHARE")
    """Share of normal episodes that may raise an alarm, in (0, 1); by default 0.05, or what fewer than 38 can
    promise."""
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
        if self.false_alarms_per_hour is None:
            return AlarmRate.of(self.false_alarm_rate or FALSE_ALARM_RATE, None)
        return AlarmRate.of(None, self.false_alarms_per_hour)

    @property
    def needed(self) -> int:
        """Calibration episodes that the promise takes; 0 for one by the hour."""
        if self.promise.per != EPISODE:
            return 0
        return conformal_episodes(self.promise.rate)

    @property
    def fewest(self) -> int:
        """Calibration episodes below which it refuses: a rate that was not asked for may be higher than the default."""
        if self.false_alarm_rate is None:
            return min(self.needed, FEWEST_WITHOUT_RATE)
        return self.needed

    def promising(self, calibration_episodes: int) -> Args:
        """Return options with the least rate that so many episodes can promise, where none was asked for."""
        if self.promise.per != EPISODE or self.false_alarm_rate is not None:
            return self
        possible = 1.0 / (calibration_episodes + 1)
        return replace(self, false_alarm_rate=max(FALSE_ALARM_RATE, possible))


def record_live(args: Args, say: Callable[[str], None]) -> Args:
    """Record a live source; return options that read the recording, in as many pieces as the promise needs."""
    file = args.out.with_suffix(".jsonl")
    if file == args.out or str(args.data) == f"tail:{file}":
        raise ValueError(f"rows are kept in {file}, which is in use: give --out another name")
    lines = lines_from(str(args.data), sys.stdin, SILENCE_S)
    seconds, how_it_ended = record(lines, file, args.minutes)
    say(f"{how_it_ended}, kept in {file}")
    piece_s = args.split
    if piece_s is None:
        pieces_needed = 1.0
        if args.needed:
            pieces_needed = args.needed / CALIBRATION_SHARE + SPARE_PIECES
        piece_s = min(PIECE_S, seconds / pieces_needed)
    return replace(args, data=file, split=max(piece_s, SHORTEST_PART_S))


def divide(
    args: Args, stretches: list[list[Episode]], is_live: bool
) -> tuple[list[Episode], list[Episode]]:
    """Return episodes to learn from, and to calibrate on.

    Args:
        args: of the command.
        stretches: the pieces of each stretch without a gap, in their order.
        is_live: whether all are of one recording of a live source.

    Raises:
        ValueError: they are too few for the promise.
    """
    by_hour = args.promise.per != EPISODE
    if is_live or (by_hour and args.split is not None):
        fitting, calibration = training_selection.split_in_time(stretches, CALIBRATION_SHARE)
        if len(calibration) < args.fewest:
            raise ValueError(
                f"a false-alarm rate of {args.promise.rate:g} needs {args.needed} pieces to "
                f"calibrate on, got {len(calibration)} of {args.split:g} s: record for longer, or "
                "take a higher --false-alarm-rate"
            )
    else:
        needed = args.fewest or FEWEST_CALIBRATION
        fitting, calibration = training_selection.split_at_random(
            flat(stretches), needed, CALIBRATION_SHARE, args.seed
        )
    args.promise.check_hours(hours_of(calibration))
    if args.quick:
        fitting = fitting[:QUICK_EPISODES]
    return fitting, calibration


def parts_between_gaps(args: Args, episodes: list[Episode]) -> tuple[list[Episode], list[str]]:
    """Return the parts between lost rows, short gaps filled, and notes on what was done.

    Where parts are too few for the promise, logs are cut at short gaps too, as they would be without a bridge.

    Raises:
        ValueError: no part is left; the message says which numbers are missing.
    """
    dt = episodes[0].spec.dt
    seconds = bridge_of(args.bridge, dt)
    bridged = [replace(e, stream=filled(e.stream, dt, seconds)) for e in episodes]
    parts = [training_selection.complete_parts(e) for e in bridged]  # of each episode
    if args.split is None and len(flat(parts)) < args.needed / CALIBRATION_SHARE:
        parts_without_bridge = [training_selection.complete_parts(e) for e in episodes]
        if len(flat(parts_without_bridge)) > len(flat(parts)):
            bridged = episodes
            parts = parts_without_bridge
    if not flat(parts):
        raise ValueError(
            f"no stretch of {SHORTEST_PART_S:g} s is complete: rows that lack a number are "
            f"{incomplete_columns(episodes)} of all; --ignore leaves such columns out, "
            "--bridge SECONDS fills longer gaps"
        )

    return flat(parts), notes_on_gaps(args, episodes, bridged, parts)


def notes_on_gaps(
    args: Args, episodes: list[Episode], bridged: list[Episode], parts: list[list[Episode]]
) -> list[str]:
    """Return notes: how many rows were filled, and how many episodes were cut.

    Args:
        args: of the command.
        episodes: as they were read.
        bridged: the same with short gaps filled.
        parts: of each bridged episode, between its other gaps.
    """
    seconds = bridge_of(args.bridge, episodes[0].spec.dt)
    notes = []
    filled_rows = 0
    cut_episodes = 0
    cut_parts = 0
    for before, after, own_parts in zip(episodes, bridged, parts, strict=True):
        is_filled = np.isnan(before.stream) & ~np.isnan(after.stream)
        filled_rows += int(is_filled.any(axis=1).sum())
        if not np.isfinite(after.stream).all():
            cut_episodes += 1
            cut_parts += len(own_parts)
    if filled_rows:
        notes.append(
            f"Filled {filled_rows} rows that lacked a number, in gaps of at most {seconds:.3g} s."
        )
    if cut_episodes:
        note = (
            f"Rows were lost: {cut_episodes} of {len(episodes)} episodes were cut there, "
            f"into {cut_parts} parts."
        )
        if args.bridge is None:
            longer = f"{2 * seconds:.3g}"
            note += f" --bridge {longer} fills gaps up to {longer} s."
        notes.append(note)
    return notes


def flat(groups: list[list[Episode]]) -> list[Episode]:
    """Return the episodes of all groups."""
    return list(chain.from_iterable(groups))


def incomplete_columns(episodes: list[Episode]) -> str:
    """Return the columns that lack the most numbers, and in how many rows."""
    missing = np.mean([np.isnan(e.stream).mean(axis=0) for e in episodes], axis=0)  # (D,)
    labels = episodes[0].spec.labels
    worst = [column for column in np.argsort(-missing)[:MOST_COLUMNS] if missing[column]]
    return ", ".join(f"{labels[column]} in {missing[column]:.0%}" for column in worst)


def settings(args: Args) -> dict[str, Any]:
    """Return the hyperparameters that the options set, of those that the monitor has."""
    wanted: dict[str, Any] = {"seed": args.seed}
    if args.quick:
        wanted["epochs"] = QUICK_EPOCHS
    if args.urdf is not None:
        wanted["urdf"] = read_urdf(args.urdf)
    known = monitor_class(args.monitor).hyperparameters
    return {name: value for name, value in wanted.items() if name in known}


def notes_on_columns(args: Args, spec: StreamSpec) -> Iterator[str]:
    """Yield notes on which columns of a log are commands."""
    if spec.source != "table" or args.schema is not None:
        return
    names = ", ".join(channel.name for channel in spec.channels if channel.group == MOTOR)
    if not names:
        yield (
            "no command is recorded, so faults are found later; "
            "--action names the columns of commands"
        )
    elif not args.action:
        yield f"read as commands, by name: {names}; --action names others"


def notes_on_body(args: Args, monitor: CalibratedMonitor) -> Iterator[str]:
    """Yield notes on the gain from the body model, and the column of each joint."""
    if args.urdf is None:
        return
    model = monitor.model  # that predicts torques; a memory keeps it in its second monitor
    if isinstance(monitor, NeuralASM) and monitor.values_ is not None:
        model = monitor.values_.monitor.model
    if not isinstance(model, ValueAssociation):
        return
    gain = (
        f"with it the squared error of held-out torques is {model.left_by_body:.2f} "
        "of that without it"
    )
    joints = ", ".join(f"{label} for {joint}" for label, joint in model.joints)
    if model.body is None:
        yield (
            f"{args.urdf} is not used: {gain}; check its masses, and that it names joints as the "
            f"log does, which were taken so: {joints}"
        )
        return
    assigned = "by the best fit to the torques, as no column names a joint"
    if model.body.by_name:
        assigned = "by name"
    yield f"{args.urdf} is used: {gain}; angles are assigned {assigned}: {joints}"


def hours_of(episodes: list[Episode]) -> float:
    """Return their total length [h]."""
    return sum(len(e) * e.spec.dt for e in episodes) / 3600


def read_normal(args: Args) -> tuple[list[Episode], str]:
    """Return the normal episodes, and which others were left out; ValueError where there is none."""
    logs = read_logs(args.data, args.hints(args.action), args.given_schema())
    with stage("reading") as progress:
        episodes, counts = normal_episodes(logs, args.split is not None, progress)
    left_out = ", ".join(f"{count} {why}" for why, count in counts.items())
    if episodes:
        return episodes, left_out
    message = f"{args.data} holds no normal episode: {left_out or 'it is empty'}"
    if args.split is None:
        message += "; --split 5 learns from between the marked rows of a log"
    if counts["with a fault"]:
        message += "; --ignore a column that is wrongly taken for a label"
    raise ValueError(message)


def fit(args: Args, console: Console) -> int:
    """Read, learn, calibrate, save, and print a summary."""
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    is_live = live_source(str(args.data)) is not None
    writable(args.out)
    if is_live:
        args = record_live(args, say)
    start = time.perf_counter()

    with noted() as notes:
        episodes, left_out = read_normal(args)
    parts, notes_on_parts = parts_between_gaps(args, episodes)
    stretches = [[part] for part in parts]
    if args.split is not None:
        stretches = [pieces(part, args.split) for part in parts]
    stretches, repeats = training_selection.without_repeats(stretches)
    if repeats:
        notes_on_parts.append(f"Left out: {repeats} parts whose rows are those of another one.")
    fitting, calibration = divide(args, stretches, is_live)
    args = args.promising(len(calibration))

    spec = fitting[0].spec
    with stage("learning") as progress:
        monitor: Any = make_monitor(args.monitor, spec, **settings(args)).fit(fitting, progress)
        monitor.calibrate(calibration, **args.promise.named)
    monitor.save(args.out)

    on_columns = notes_on_columns(args, spec)
    on_body = notes_on_body(args, monitor)
    for note in chain(notes, on_columns, on_body, mute_channels(fitting)):
        say(f"Note: {note}.")
    rows = sum(map(len, fitting))
    say(
        f"Learned from {len(fitting)} episodes: {rows} rows of {spec.size} numbers, "
        f"{1 / spec.dt:g} a second."
    )
    if left_out:
        say(f"Left out: {left_out}.")
    for line in chain(notes_on_parts, summary_of_threshold(args, monitor, len(calibration))):
        say(line)
    if not args.quick:
        for line in summary_of_sight(monitor, calibration):
            say(line)
    seconds = time.perf_counter() - start
    say(f"Wrote {args.out} after {seconds:.0f} s. Next: asm-gym watch LOG --monitor {args.out}")
    return exit_code_of_reading(notes)


def summary_of_threshold(args: Args, monitor: Any, calibration_episodes: int) -> Iterator[str]:
    """Yield the threshold and its promise, and the false alarms to expect.

    Some of the ``calibration_episodes`` set the ceilings of the senses, and all others the threshold.
    """
    hours = monitor.blocks_.total
    used = len(monitor.maxima_)
    promise = f"at most {args.promise.rate:g} alarms an hour, from {hours:.3g} normal hours"
    if args.promise.per == EPISODE:
        promise = f"an alarm in at most {args.promise.rate:.1%} of normal ones"
    if monitor.promise.modelled:
        promise += ", by a model of the tail of their maxima, as they are few"
    if used < calibration_episodes:
        promise += f"; {calibration_episodes - used} more say how far each sense goes"
    yield f"Threshold {monitor.threshold:.4g}, from {used} other episodes: {promise}."

    if args.promise.per == EPISODE and args.promise.rate > FALSE_ALARM_RATE:
        usual = conformal_episodes(FALSE_ALARM_RATE) + 1
        yield (
            f"So few episodes promise at most one false alarm in {1 / args.promise.rate:.3g}; "
            f"{(usual - 1) / CALIBRATION_SHARE:g} promise one in {usual}."
        )

    in_incidents = hourly_promise(monitor.blocks_, monitor.threshold, used)
    expected, at_most = in_incidents.hourly(hours)
    line = (
        f"Expected false alarms for motion as in these {60 * hours:.2g} minutes: {expected:.3g} an "
        f"hour, at most {at_most:.3g} with 95 % confidence; other motion raises more."
    )
    if expected > 1.0:
        line += f" A promise of 1 an hour takes {1 / CALIBRATION_SHARE:g} hours of recordings."
    yield line


def summary_of_sight(monitor: CalibratedMonitor, calibration: list[Episode]) -> Iterator[str]:
    """Yield how large errors of torques and positions are seen at the threshold."""
    seen = []
    unseen = []
    for sight in sights(monitor, calibration):
        if sight.size < np.inf:
            unit = f" {sight.unit}" if sight.unit != "1" else ""
            seen.append(f"{sight.label} {sight.size:.2g}{unit} ({sight.share:.0%} of its range)")
        else:
            unseen.append(sight.label)
    if seen:
        yield (
            f"Sees, in {MOST:.0%} of places, an error that lasts {LASTS_S:g} s, "
            f"from this size on: {', '.join(seen)}."
        )
    if unseen:
        yield f"Does not see half of the range: {', '.join(unseen)}; record more motion."


main = partial(run, "fit", Args, fit)
