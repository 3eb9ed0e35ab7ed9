"""Who notices what in public recordings of real robots: AUROC by kind of fault, on voraus-AD or AURSAD.

Download the file first; nothing of it is shipped, and no figure of it is in the documentation, for this has been run on
synthetic files of the same layout only. Learned from is what the official split says, less a share that sets the
threshold. An episode is as surprising as its worst row. AUROC is that of a kind's episodes against all normal ones of
the test; the mean over kinds is what papers report.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from asm_gym.data.public import Recorded, read_public
from asm_gym.data.selection import divided
from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table, console_table
from asm_gym.monitors import MONITORS, make_monitor, monitor_class
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import run
from asm_gym.validation import check_choice, check_number

AT_ONCE = 64
"""Episodes scored side by side."""

QUICK_EPOCHS, QUICK_EPISODES = 2, 40


@dataclass(frozen=True)
class Args:
    """AUROC by kind of fault on a public dataset."""

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The downloaded file: voraus-ad-dataset-100hz.parquet, voraus-ad-dataset-500hz.parquet, or AURSAD.h5."""
    monitors: tuple[str, ...] = ("neural_asm", "association_linear+evidence", "kalman+evidence")
    """Names of monitors."""
    false_alarm_rate: float = 0.05
    """Share of normal episodes that may raise an alarm."""
    calibration_share: float = 0.3
    """Share of the normal episodes of the training set that set the threshold, and are not learned from."""
    rate: float | None = None
    """Rows of the file a second [Hz], where its time does not say it."""
    every: int = 1
    """Keep one row of so many: AURSAD's own package takes 2."""
    seed: int = 0
    """Seed of the monitors, and of which episodes they learn from."""
    quick: bool = False
    """Learn little, from few episodes: to see that everything runs."""

    def __post_init__(self) -> None:
        for name in self.monitors:
            check_choice("monitor", name, MONITORS)
        conformal_episodes(self.false_alarm_rate)  # refuses a rate that is none
        check_number("calibration_share", self.calibration_share, above=0, below=1)
        check_number("every", self.every, low=1, whole=True)
        if self.rate is not None:
            check_number("rate", self.rate, above=0)

    def read(self) -> Iterator[Recorded]:
        """The episodes, anew at each call."""
        return read_public(self.data, self.rate, self.every)


def is_finite(one: Recorded) -> bool:
    """No number of it was lost."""
    return bool(np.isfinite(one.episode.stream).all())


def fitted(args: Args, normal: list[Episode], console: Console) -> dict[str, Any]:
    """The monitors, each fitted and calibrated on the same episodes."""
    fitting, calibration = divided(normal, args.false_alarm_rate, args.calibration_share, args.seed)
    fitting = fitting[:QUICK_EPISODES] if args.quick else fitting
    made = {}
    for name in args.monitors:
        settings: dict[str, Any] = {"seed": args.seed}
        if args.quick and "epochs" in monitor_class(name).hyperparameters:
            settings["epochs"] = QUICK_EPOCHS
        with stage(f"fitting {name}", console, {}) as progress:
            monitor: Any = make_monitor(name, fitting[0].spec, **settings)
            made[name] = monitor.fit(fitting, progress).calibrate(calibration, args.false_alarm_rate)
    return made


def peaks(recorded: Iterable[Recorded], monitors: Mapping[str, Any]) -> tuple[dict[str, dict[str, list[float]]], int]:
    """How surprising the worst row of each episode of the test is, by monitor and kind; and how many were left out."""
    found: dict[str, dict[str, list[float]]] = {name: {} for name in monitors}
    held: list[Recorded] = []
    left_out = 0

    def score() -> None:
        for name, monitor in monitors.items():
            for one, surprise in zip(held, monitor.score_episodes([r.episode for r in held]), strict=True):
                found[name].setdefault(one.kind, []).append(float(surprise.value.max()))
        held.clear()

    for one in recorded:
        if not one.learned and is_finite(one):
            held.append(one)
        left_out += not one.learned and not is_finite(one)
        if len(held) == AT_ONCE:
            score()
    score()
    return found, left_out


def table(found: Mapping[str, Mapping[str, Sequence[float]]], monitors: Mapping[str, Any], caption: str) -> Table:
    """A row for each kind, their mean, and how often normal episodes alarm."""
    first = next(iter(found.values()))
    if not first.get("") or len(first) < 2:
        raise ValueError("the test set needs normal episodes and faulty ones, got " + (", ".join(first) or "none"))
    kinds = sorted(kind for kind in first if kind)
    areas = {name: [auroc(mine[kind], mine[""]) for kind in kinds] for name, mine in found.items()}
    over = {
        name: {k: np.mean(np.array(v) > monitors[name].threshold) for k, v in found[name].items()} for name in found
    }
    rows: list[tuple[object, ...]] = [
        (kind, len(first[kind]), *(f"{areas[m][k]:.3f} / {100 * over[m][kind]:.0f} %" for m in found))
        for k, kind in enumerate(kinds)
    ]
    rows.append(("mean over kinds", "", *(f"{np.mean(areas[m]):.3f}" for m in found)))
    rows.append(("normal", len(first[""]), *(f"{100 * over[m]['']:.0f} %" for m in found)))
    return Table(caption, ("kind", "episodes", *found), rows)


def examine(args: Args, console: Console) -> None:
    """Learns, tests, and prints the table."""
    with stage("reading", console, {}):
        normal = [one.episode for one in args.read() if one.learned and not one.kind and is_finite(one)]
    if not normal:
        raise ValueError(f"{args.data} holds no normal episode to learn from")
    monitors = fitted(args, normal, console)
    with stage("testing", console, {}):
        found, left_out = peaks(args.read(), monitors)
    caption = f"{args.data.name}: AUROC / found at a false-alarm rate of {100 * args.false_alarm_rate:g} %"
    console.print(console_table(table(found, monitors, caption)))
    if left_out:
        console.print(f"{left_out} episodes of the test with numbers that are not finite were left out.")


def main(argv: list[str] | None = None) -> int:
    """Prints the table, and returns the exit code."""
    return run("public", Args, examine, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
