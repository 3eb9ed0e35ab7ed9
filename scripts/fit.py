"""A memory of what is normal, learned from recordings: run folders, Minari datasets, or logs from elsewhere.

Part of the episodes are learned from, the others set the threshold. Episodes that failed or hold a fault are left out.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.body_model import read_urdf
from asm_gym.data.commands import feedback
from asm_gym.data.gaps import filled
from asm_gym.data.live import record
from asm_gym.data.logs import LogLayout, read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.selection import (
    SHORTEST_S,
    complete_parts,
    normal_episodes,
    pieces,
    split_at_random,
    split_in_time,
    with_shared_noise,
    without_marked_rows,
)
from asm_gym.data.sources import is_live, lines_from
from asm_gym.detection import conformal_episodes
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.detection.hourly import least_per_hour
from asm_gym.episode import Episode
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE
from asm_gym.monitors import MONITORS, make_monitor, monitor_class
from asm_gym.monitors.arm_inputs import Derived
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.registry import check_monitor_name
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, fixed, option
from asm_gym.scripts.unlike_pieces import Part, about_pieces, left_out
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import check_number

SILENCE_S = 2.0
"""Without a row for so long a live source has died, and what it said till then is learned from [s]."""

PIECE_S, SPARE = 5.0, 4
"""Longest pieces of what was recorded live [s], and how many more there are than the promise needs."""

ANY_EPISODE = 0.5
"""A rate that one episode can promise: by the hour it is hours that count."""


@dataclass(frozen=True)
class Args:
    """A memory from recordings."""

    data: Path = option(positional=True, metavar="DATA")
    """A run folder of collect, import or evaluate, a Minari or LeRobot dataset, or logs (a file, or a folder): .csv,
    .tsv, .txt, .jsonl, .parquet, .npz, .npy, and .mcap, .db3 or .bag of ROS. Or a live source, as asm-gym watch takes
    it, of JSON objects: it is recorded beside FILE."""
    out: Path = option(Path("runs/fit/memory.asm"), metavar="FILE")
    """File to write the memory to."""
    monitor: str = option("neural_asm", check=check_monitor_name, listed=MONITORS)
    """Name of the monitor."""
    false_alarm_rate: float = option(FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of normal episodes that may raise an alarm."""
    false_alarms_per_hour: float | None = option(None, metavar="X")
    """Alarms in an hour of normal episodes; promised in place of a share of them."""
    action: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns of logs that were commanded and not sensed: names, or patterns such as 'cmd*'."""
    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows of logs a second; by default their column called time says it."""
    channels: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns of logs that are read: names, or patterns; by default all of numbers."""
    label: tuple[str, ...] = option((), metavar="COLUMN")
    """Columns that say what is wrong, beside those called so; rows that they mark are not learned from."""
    columns: tuple[str, ...] = option((), metavar="NAME")
    """Names of the columns of files without a header."""
    join: bool = False
    """The files of a folder are parts of one recording: join them by their clocks."""
    bridge: float = option(0.0, check=partial(check_number, "bridge", low=0.0), metavar="SECONDS")
    """Gaps up to so long are filled, on the line between their ends, such as 0.05; a log is cut at others."""
    urdf: Path | None = option(None, metavar="FILE")
    """Body model of the arm: what its links weigh then tells torques, and pushes are found by less."""
    split: float | None = option(None, check=partial(check_number, "split", above=0), metavar="SECONDS")
    """Length of the pieces that long logs are cut into; each then counts as an episode."""
    minutes: float = option(10.0, check=partial(check_number, "minutes", above=0))
    """For how long a live source is recorded at most."""
    seed: int = option(0, least=0)
    """Seed of the memory, and of which episodes it learns from."""
    leave_out: bool = False
    """Learn without each log, or each folder of them, in turn too, and say what alarms the one left out raises."""
    quick: bool = False
    """Learn little, from few episodes: to see that everything runs."""
    calibration_share: float = fixed(0.5, check=partial(check_number, "calibration_share", above=0, below=1))
    """Share of the episodes that set the threshold, and are not learned from."""
    most: int | None = fixed(None, quick=20)
    """Episodes to learn from at most."""
    in_time: bool = fixed(False)
    """The heads of logs are learned from, and their tails calibrated on."""
    epochs: int | None = fixed(None, quick=5)
    """Passes over them, of a monitor that learns in passes."""

    def __post_init__(self) -> None:
        check_options(self)
        _ = self.asked  # refuses a rate that is none
        if self.out.is_dir():
            raise ValueError(f"out must be a file, and {self.out} is a folder")

    @property
    def asked(self) -> AlarmRate:
        """The promise of the threshold."""
        hourly = self.false_alarms_per_hour
        return AlarmRate.of(self.false_alarm_rate if hourly is None else None, hourly)


def learned(
    args: Args, fitting: list[Episode], calibration: list[Episode], progress: Progress, parts: Sequence[Part] = ()
) -> Any:
    """The monitor, fitted and calibrated; where that is refused, the message says which of ``parts`` was odd."""
    settings: dict[str, Any] = {"seed": args.seed}
    if args.epochs is not None and "epochs" in monitor_class(args.monitor).hyperparameters:
        settings["epochs"] = args.epochs
    if fitting[0].spec.source == "table" and "values" in monitor_class(args.monitor).hyperparameters:
        settings["values"] = True  # an arm's log holds pushes that last, and torques
    if args.urdf is not None:
        if "urdf" not in monitor_class(args.monitor).hyperparameters:
            raise ValueError(f"{args.monitor} takes no body model: leave --urdf out")
        settings["urdf"] = read_urdf(args.urdf)
    monitor: Any = make_monitor(args.monitor, fitting[0].spec, **settings)
    monitor.fit(fitting, progress)
    try:
        return monitor.calibrate(calibration, **args.asked.named)
    except ValueError as error:
        maxima = np.array([score.value.max() for score in monitor.score_episodes(calibration)])
        odd = about_pieces(parts, maxima) if len(parts) else []
        raise ValueError("; ".join([str(error), *odd])) from error


def recorded(args: Args, say: Callable[[str], None]) -> Args:
    """Records a live source, and returns how to learn from that: cut into as many pieces as the promise needs."""
    to = args.out.with_suffix(".jsonl")
    seconds, ended = record(lines_from(str(args.data), sys.stdin, SILENCE_S), to, args.minutes)
    say(f"{ended}, kept in {to}")
    needed = (
        conformal_episodes(args.false_alarm_rate) / args.calibration_share + SPARE if args.asked.per == EPISODE else 0
    )
    split = args.split or min(PIECE_S, seconds / needed if needed else PIECE_S)
    return replace(args, data=to, split=max(split, SHORTEST_S), in_time=True)


def parted(args: Args, logs: list[list[Episode]]) -> tuple[list[Episode], list[Episode]]:
    """Those to learn from, and those to calibrate on. Raises ValueError where they are too few for the promise."""
    if args.in_time or (args.asked.per == HOUR and args.split is not None):
        fitting, calibration = split_in_time(logs, args.calibration_share)
        if args.asked.per == EPISODE and len(calibration) < (needed := conformal_episodes(args.false_alarm_rate)):
            raise ValueError(
                f"a false-alarm rate of {args.false_alarm_rate:g} needs {needed} pieces to calibrate on, got "
                f"{len(calibration)} of {args.split:g} s: record for longer, or take a higher --false-alarm-rate"
            )
    else:
        episodes = [part for log in logs for part in log]
        if args.asked.per == EPISODE:
            check_count(args, episodes)
            return split_at_random(episodes, args.false_alarm_rate, args.calibration_share, args.seed)
        fitting, calibration = split_at_random(episodes, ANY_EPISODE, args.calibration_share, args.seed)
    args.asked.check_hours(hours_of(calibration))
    return fitting, calibration


def check_count(args: Args, episodes: list[Episode]) -> None:
    """Raises ValueError where episodes are few, but long enough to be cut: the message says into what."""
    needed = math.ceil(conformal_episodes(args.false_alarm_rate) / args.calibration_share) + SPARE
    length = math.floor(100 * 3600 * hours_of(episodes) / needed) / 100
    if args.split is None and 2 * len(episodes) < needed and length >= SHORTEST_S:
        raise ValueError(
            f"a false-alarm rate of {args.false_alarm_rate:g} needs {needed} normal episodes, got {len(episodes)} that "
            f"are {3600 * hours_of(episodes):.4g} s long together: --split {min(length, PIECE_S):g} cuts them"
        )


def promised(args: Args, calibration: list[Episode]) -> str:
    """How often the threshold lets normal operation alarm, in words."""
    if args.asked.per == HOUR:
        return f"at most {args.asked.rate:g} alarms an hour of normal ones, from {hours_of(calibration):.3g} of them"
    hourly = args.false_alarm_rate * len(calibration) / hours_of(calibration)
    at_their_length = f"{hourly:.{0 if hourly >= 10 else 1}f} an hour at their length"
    return f"an alarm in at most {args.false_alarm_rate:.1%} of normal ones, {at_their_length}{too_little(calibration)}"


def too_little(calibration: list[Episode]) -> str:
    """How many alarms an hour could be promised at best, where that is more than one, and what one would take."""
    hours = hours_of(calibration)
    if hours >= 1.0:
        return ""
    return (
        f"; from {60 * hours:.3g} min nothing under {least_per_hour(hours):.3g} an hour can be promised, "
        f"and one an hour takes {60 * (1.0 - hours):.0f} min more"
    )


def about_commands(args: Args, episodes: list[Episode]) -> list[str]:
    """What is worth saying of the commands in logs, a line each."""
    spec = episodes[0].spec
    if spec.source != "table":
        return []
    names = ", ".join(dict.fromkeys(c.name for c in spec.channels if c.group == MOTOR))
    if not names:
        return [
            "no command is on record: what was asked of the arm is guessed from its motion, so that a fault is found "
            "later, and by linear monitors hardly (docs/guides/your_robot.md); --action names one"
        ]
    said = [] if args.action else [f"taken as commanded, by name: {names}"]
    return said + [
        f"{label} answers what is sensed (R² {share:.2f}): it is a controller's output, and holds a push already; "
        "leave it out by --channels, or take what the controller was asked for"
        for label, share in feedback(episodes).items()
    ]


def about_body(args: Args, spec: StreamSpec) -> list[str]:
    """Which joints of the body model the log's angles were taken for, a line; none without one."""
    if args.urdf is None:
        return []
    links = Derived.of(spec, friction=True, body=False, urdf=read_urdf(args.urdf)).links
    assert links is not None
    joints = ", ".join(links.names[i] for i in np.argsort(links.columns))
    return [f"the angles are taken for these joints of {args.urdf}, in this order: {joints}"]


def origins(logs: list[str], whole: list[list[Episode]]) -> dict[int, Part]:
    """Where each piece came from, by its identity: the log, and the seconds of it that were learned from before."""
    found: dict[int, Part] = {}
    seconds = dict.fromkeys(logs, 0.0)
    for log, parts in zip(logs, whole, strict=True):
        for episode in parts:
            found[id(episode)] = Part(log, seconds[log], episode)
            seconds[log] += len(episode) * episode.spec.dt
    return found


def left_out_kinds(args: Args, parts: list[list[Part]]) -> Mapping[str, str]:
    """What to expect of a kind of move that was not shown, by kind."""
    fitted, calibrated = parts
    return left_out(fitted, calibrated, lambda fitting, held: learned(args, fitting, held, lambda *_: None))


def hours_of(episodes: list[Episode]) -> float:
    """How long they are together [h]."""
    return sum(len(e) * e.spec.dt for e in episodes) / 3600


def fit(args: Args, console: Console) -> None:
    """Reads, learns, calibrates, saves, and says what came of it."""
    if is_live(str(args.data)):
        args = recorded(args, partial(console.print, soft_wrap=True, highlight=False, markup=False))
    start = time.perf_counter()
    with stage("reading", console, {}) as progress:
        layout = LogLayout(
            None, args.rate, args.action, args.channels, args.label, args.columns, args.join, by_name=True
        )
        with noted() as notes:
            logs = read_logs(args.data, layout)
            kept = normal_episodes(logs if args.split is None else without_marked_rows(logs), progress=progress)
    gone = ", ".join(f"{count} {why}" for why, count in kept.left_out.items())
    if not kept.episodes:
        hint = "; --keep-failures learns from those that failed" if "failed" in kept.left_out else ""
        hint = hint or ("; --split 5 learns from between the marked rows of a log" if args.split is None else "")
        raise ValueError(f"{args.data} holds no normal episode: {gone or 'it is empty'}{hint}")
    bridged = [replace(e, stream=filled(e.stream, e.spec.dt, args.bridge)) for e in with_shared_noise(kept.episodes)]
    named = [(name, part) for name, e in zip(kept.logs, bridged, strict=True) for part in complete_parts(e)]
    whole = [[e] if args.split is None else pieces(e, args.split) for _, e in named]
    fitting, calibration = parted(args, whole)
    fitting = fitting[: args.most]
    origin = origins([name for name, _ in named], whole)
    with stage("learning", console, {}) as progress:
        monitor = learned(args, fitting, calibration, progress, [origin[id(e)] for e in calibration])
    monitor.save(args.out)
    spec = fitting[0].spec
    rows = sum(map(len, fitting))
    say = partial(console.print, soft_wrap=True, highlight=False)
    odd = about_pieces([origin[id(e)] for e in calibration], monitor.maxima_)
    for line in [*notes, *about_commands(args, kept.episodes), *about_body(args, spec), *odd]:
        say(f"Note: {line}.", markup=False)
    say(f"Learned from {len(fitting)} episodes: {rows} rows of {spec.size} numbers, {1 / spec.dt:g} a second.")
    if gone:
        say(f"Left out: {gone}.")
    if len(named) != len(kept.episodes):
        say(
            f"Rows were lost: {len(kept.episodes)} episodes were cut there, into {len(named)} parts."
            + ("" if args.bridge else " --bridge 0.05 fills gaps up to 0.05 s.")
        )
    say(f"Threshold {monitor.threshold:.4g}, from {len(calibration)} other episodes: {promised(args, calibration)}.")
    if args.leave_out:
        for kind, found in left_out_kinds(args, [[origin[id(e)] for e in es] for es in (fitting, calibration)]).items():
            say(f"Learned without {kind}: {found}.", markup=False)
    seconds = time.perf_counter() - start
    say(f"Wrote {args.out} after {seconds:.0f} s. Watch with it: asm-gym watch LOG --monitor {args.out}")


def main(argv: list[str] | None = None) -> int:
    """Fits, and returns the exit code."""
    return run("fit", Args, fit, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
