"""Who notices what in public recordings of real robots: AUROC by kind of fault, on voraus-AD or AURSAD.

Download the file first; nothing of it is shipped, and no figure of it is in the documentation, for this has been run on
synthetic files of the same layout only. Learned from is what the official split says, less a share that sets the
threshold. An episode is as surprising as its worst row. AUROC is that of a kind's episodes against all normal ones of
the test; the mean over kinds is what papers report.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.public import Recorded, read_public
from asm_gym.data.selection import divided
from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import make_monitor, monitor_class
from asm_gym.monitors.registry import check_monitor
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.validation import check_number

AT_ONCE = 64
"""Episodes scored side by side."""


@dataclass(frozen=True)
class Config(kit.Config):
    """AUROC by kind of fault on a public dataset."""

    data: Path = option(Path("voraus-ad-dataset-100hz.parquet"), positional=True, metavar="FILE")
    """The downloaded file, of 100 or 500 Hz, or AURSAD.h5."""
    monitors: tuple[str, ...] = option(
        ("neural_asm", "association_linear+evidence", "kalman+evidence"), least=1, check=check_monitor
    )
    """Names of monitors."""
    false_alarm_rate: float = option(defaults.FALSE_ALARM_RATE, check=conformal_episodes)
    """Share of normal episodes that may raise an alarm."""
    calibration_share: float = option(0.3, check=partial(check_number, "calibration_share", above=0, below=1))
    """Share of the normal episodes of the training set that set the threshold, and are not learned from."""
    rate: float | None = option(None, check=partial(check_number, "rate", above=0), metavar="HZ")
    """Rows of the file a second [Hz], where its time does not say it."""
    every: int = option(1, least=1)
    """Keep one row of so many: AURSAD's own package takes 2."""
    seeds: int = fixed(1)
    """It is not repeated."""
    most: int | None = fixed(None, quick=40)
    """Episodes to learn from at most."""
    epochs: int | None = fixed(None, quick=2)
    """Passes over them, of monitors that learn in passes."""

    def read(self) -> Iterator[Recorded]:
        """The episodes, anew at each call."""
        return read_public(self.data, self.rate, self.every)


def is_finite(one: Recorded) -> bool:
    """No number of it was lost."""
    return bool(np.isfinite(one.episode.stream).all())


def fitted(config: Config, normal: list[Episode]) -> dict[str, Any]:
    """The monitors, each fitted and calibrated on the same episodes."""
    fitting, calibration = divided(normal, config.false_alarm_rate, config.calibration_share, config.seed)
    fitting = fitting[: config.most]
    made = {}
    for name in config.monitors:
        settings: dict[str, Any] = {"seed": config.seed}
        if config.epochs is not None and "epochs" in monitor_class(name).hyperparameters:
            settings["epochs"] = config.epochs
        with kit.stage(f"fitting {name}") as progress:
            monitor: Any = make_monitor(name, fitting[0].spec, **settings)
            made[name] = monitor.fit(fitting, progress).calibrate(calibration, config.false_alarm_rate)
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


def records(found: Mapping[str, Mapping[str, Sequence[float]]], seed: int) -> list[Record]:
    """How surprising each episode of the test was to each monitor."""
    return [
        {"monitor": name, "seed": seed, "kind": kind, "peak": peak}
        for name, mine in found.items()
        for kind, values in mine.items()
        for peak in values
    ]


def run(config: Config) -> Findings:
    """Learns, and tests."""
    with kit.stage("reading"):
        normal = [one.episode for one in config.read() if one.learned and not one.kind and is_finite(one)]
    if not normal:
        raise ValueError(f"{config.data} holds no normal episode to learn from")
    monitors = fitted(config, normal)
    with kit.stage("testing"):
        found, left_out = peaks(config.read(), monitors)
    caption = f"{config.data.name}: AUROC / found at a false-alarm rate of {100 * config.false_alarm_rate:g} %"
    if left_out:
        caption += f"; {left_out} episodes of the test with numbers that are not finite were left out"
    made = table(found, monitors, caption)
    return Findings(records(found, config.seed), [made], facts={"left_out": left_out})
