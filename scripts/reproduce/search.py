"""The same search for every monitor: each of a few settings is fitted on the same episodes, and asked about the same.

Reads the recordings of ``asm-gym evaluate``. To choose by them, they should be of kinds and seeds that no table
reports: ``asm-gym evaluate --faults development --seed 1``. Each monitor has five settings: its own, and four that
differ from it in one number, twice lower or higher or so. Ridge regression has one, for each of its fits chooses among
eleven penalties for every sense.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation.comparison import monitor_metrics, visible_kinds
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import recorded
from asm_gym.rollouts.scoring import detectability_of, fitted, judged
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import Common, Findings, Record, reproduce, tasks_recorded
from asm_gym.scripts.reproduce.learning_curve import in_turn
from asm_gym.validation import check_choice

Setting = dict[str, Any]
"""Hyperparameters that differ from those that a monitor has by itself."""

SETTINGS: dict[str, tuple[Setting, ...]] = {
    "neural_asm": (
        {},
        {"association_size": 480},
        {"association_size": 960},
        {"learning_rate": 1e-3},
        {"hidden_size": 128},
    ),
    "association_linear+evidence": ({},),
    "association_mlp+evidence": (
        {},
        {"learning_rate": 1e-3},
        {"units": 480},
        {"learning_rate": 3e-3},
        {"units": 1920},
    ),
    "association_boosted+evidence": (
        {},
        {"leaves": 7},
        {"leaves": 31},
        {"learning_rate": 0.05},
        {"learning_rate": 0.2},
    ),
    "window_pca+evidence": ({}, {"rows": 3}, {"rows": 10}, {"kept": 0.95}, {"kept": 0.99}),
    "kalman+evidence": ({}, {"ridge": 1e-5}, {"ridge": 1e-4}, {"ridge": 1e-3}, {"ridge": 1e-2}),
    "gru+evidence": (
        {},
        {"learning_rate": 3e-3},
        {"hidden_size": 256},
        {"learning_rate": 3e-4},
        {"hidden_size": 512},
    ),
    "lstm_vae+evidence": (
        {},
        {"hidden_size": 256},
        {"latent_size": 16},
        {"hidden_size": 64},
        {"learning_rate": 3e-4},
    ),
    "logpzo+evidence": ({}, {"updates": 4000}, {"width": 256}, {"width": 128}, {"updates": 16000}),
    "rnd+evidence": ({}, {"updates": 4000}, {"width": 512}, {"width": 128}, {"updates": 16000}),
    "skill_library+evidence": ({}, {"bases": 20}, {"bases": 80}, {"stiffness": 12.5}, {"stiffness": 50.0}),
}


@dataclass(frozen=True)
class Args(Common):
    """Which settings of a monitor find most."""

    seeds: int = 1
    """How often it repeats itself."""
    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/development")
    """Folder of an evaluation, whose recordings are learned from and judged."""
    monitors: tuple[str, ...] = tuple(SETTINGS)
    """Names of monitors."""
    episodes: int = 60
    """How many episodes are learned from, of all tasks together."""
    settings: int = 5
    """How many settings of each are tried, at most: its own first."""
    false_alarm_rate: float = 0.05
    """Share of nominal episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.monitors:
            check_choice("monitor", name, SETTINGS)
        at_least(1, self, "episodes", "settings")
        conformal_episodes(self.false_alarm_rate)  # refuses a rate that is none
        if not self.monitors:
            raise ValueError("there must be at least one monitor")

    @property
    def tasks(self) -> tuple[str, ...]:
        """What the run has recorded; ValueError where there is nothing."""
        return tasks_recorded(self.run)


class Job(NamedTuple):
    """One monitor, as it is set."""

    monitor: str
    setting: int  # which of its settings
    seed: int


def in_brief(setting: Setting) -> str:
    """What is set otherwise."""
    return ", ".join(f"{name} {value:g}" for name, value in setting.items()) or "its own"


def score(job: Job, args: Args) -> Record:
    """What one monitor finds, as it is set."""
    recordings, _, twins = recorded(args.run, args.tasks)
    learned = in_turn(recordings["fit"], job.seed)[: args.episodes]
    setting = SETTINGS[job.monitor][job.setting]
    monitor = fitted(args.out / "search", job.monitor, learned, job.seed, setting)
    result = judged(job.monitor, monitor, {**recordings, "harmless": []}, args.false_alarm_rate)
    seen = visible_kinds(detectability_of(twins, recordings.get("faulty", []), args.window))
    metrics = monitor_metrics(job.monitor, result, args.window, seen)
    found = metrics.found[args.false_alarm_rate].value
    return {"monitor": job.monitor, "seed": job.seed, "setting": in_brief(setting)} | {
        "auroc": metrics.auroc,
        "found": found,
    }


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Fits and asks every monitor in every setting."""
    most = min(args.settings, 2) if args.quick else args.settings
    jobs = [Job(m, n, s) for m in args.monitors for n in range(len(SETTINGS[m][:most])) for s in args.repetitions]
    with stage("fitting and judging", console, seconds) as progress:
        records = parallel_map(partial(score, args=args), jobs, args.workers, progress)
    return Findings(records, [table(records, args)], scatter(records, args), {"tasks": args.tasks})


def table(records: Sequence[Record], args: Args) -> Table:
    """A row a setting."""
    rows = []
    for name in args.monitors:
        for setting in dict.fromkeys(r["setting"] for r in records if r["monitor"] == name):
            auroc, found = (
                Spread.of([r[key] for r in records if (r["monitor"], r["setting"]) == (name, setting)])
                for key in ("auroc", "found")
            )
            rows.append((name, setting, auroc.text(digits=3), f"{found.text(100, 0)} %"))
    return Table(
        f"AUROC over the same steps, and faults found at {100 * args.false_alarm_rate:g} % of nominal episodes, of "
        f"monitors that learned from {args.episodes} episodes of {', '.join(args.tasks)}. All are calibrated on the "
        "same other episodes.",
        ("Monitor", "Setting", "AUROC", "Found"),
        rows,
    )


def scatter(records: Sequence[Record], args: Args) -> Figure:
    """AUROC of every setting, a line a monitor."""
    with figure(height=3.5, width=7.0) as fig:
        ax = fig.subplots()
        for i, name in enumerate(args.monitors):
            own = [r["auroc"] for r in records if r["monitor"] == name]
            ax.plot(own, [-i] * len(own), "o", alpha=0.6)
        ax.set_yticks([-i for i in range(len(args.monitors))], args.monitors)
        ax.set_xlabel("AUROC")
        ax.grid(color="#dddddd", linewidth=0.6)
    return fig


def main(argv: list[str] | None = None) -> int:
    """Searches, and returns the exit code."""
    return reproduce("search", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
