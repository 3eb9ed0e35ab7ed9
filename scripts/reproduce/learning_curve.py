"""How many episodes it takes: monitors that learned from few and from many, all calibrated and tested on the same.

Reads the recordings of ``asm-gym evaluate``. The episodes to learn from are taken from all tasks in turn, so that the
few are among the many; each repetition begins elsewhere, and seeds the monitors anew.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.detection import conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation.comparison import Detectability, MonitorResult, monitor_metrics, visible_kinds
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.metrics import false_alarms
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import MONITORS
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import recorded
from asm_gym.rollouts.scoring import detectability_of, result_of
from asm_gym.scripts.reproduce.common import Common, Findings, Record, reproduce, tasks_recorded
from asm_gym.validation import check_choice

QUICK = 40
"""With ``--quick``, nothing learns from more episodes than these."""


@dataclass(frozen=True)
class Args(Common):
    """Detection by the number of episodes that were learned from."""

    seeds: int = 1
    """How often it repeats itself."""
    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/evaluate")
    """Folder of an evaluation, whose recordings are learned from and judged."""
    monitors: tuple[str, ...] = (
        "neural_asm",
        "association_linear+evidence",
        "association_mlp+evidence",
        "window_pca+evidence",
        "gru+evidence",
        "kalman+evidence",
    )
    """Names of monitors."""
    episodes: tuple[int, ...] = (10, 20, 40, 80, 160, 320, 640, 1000)
    """How many episodes are learned from, of all tasks together; those that the run does not have are left out."""
    false_alarm_rate: float = 0.05
    """Share of nominal episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.monitors:
            check_choice("monitor", name, MONITORS)
        conformal_episodes(self.false_alarm_rate)  # refuses a rate that is none
        if not self.monitors or not self.episodes or min(self.episodes) < 1:
            raise ValueError("there must be at least one monitor, and one episode to learn from")

    @property
    def tasks(self) -> tuple[str, ...]:
        """What the run has recorded; ValueError where there is nothing."""
        return tasks_recorded(self.run)


class Job(NamedTuple):
    """One monitor to be fitted on some episodes and asked."""

    monitor: str
    episodes: int
    seed: int


def in_turn(episodes: Sequence[Episode], seed: int) -> list[Episode]:
    """All of them, one of each task after another, beginning elsewhere for each seed."""
    tasks: dict[str, list[Episode]] = {}
    for episode in episodes:
        tasks.setdefault(episode.labelled.task, []).append(episode)
    rng = np.random.default_rng(seed)
    shuffled = [[own[i] for i in rng.permutation(len(own))] for own in tasks.values()]
    return [e for turn in zip_longest(*shuffled) for e in turn if e is not None]


def score(job: Job, args: Args) -> Record:
    """What one monitor finds after that many episodes."""
    recordings, _, twins = recorded(args.run, args.tasks)
    faulty = recordings.get("faulty", [])
    learned = in_turn(recordings["fit"], job.seed)[: job.episodes]
    by_role = {**recordings, "fit": learned, "harmless": []}
    result = result_of(job.monitor, args.out / "learning_curve", by_role, args.false_alarm_rate, job.seed)
    return job._asdict() | measured(result, detectability_of(twins, faulty, args.window), args, job.monitor)


def measured(result: MonitorResult, seen: Sequence[Detectability], args: Args, name: str) -> Record:
    """AUROC, faults found, and nominal episodes with an alarm, over the kinds that can be seen."""
    metrics = monitor_metrics(name, result, args.window, visible_kinds(seen))
    found, alarms = metrics.found[args.false_alarm_rate].value, false_alarms(metrics.nominal).value
    return {"auroc": metrics.auroc, "whole": metrics.unmatched_auroc, "found": found, "false_alarms": alarms}


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Fits and asks every monitor at every size."""
    available = len(recorded(args.run, args.tasks).roles["fit"])
    most = min(available, QUICK) if args.quick else available
    sizes = sorted({min(n, most) for n in args.episodes})
    jobs = [Job(m, n, s) for n in sizes for m in args.monitors for s in args.repetitions]
    with stage("fitting and judging", console, seconds) as progress:
        records = parallel_map(partial(score, args=args), jobs, args.workers, progress)
    facts = {"tasks": args.tasks, "episodes": available}
    return Findings(records, [table(records, args, sizes)], curve(records, args, sizes), facts)


def table(records: Sequence[Record], args: Args, sizes: Sequence[int]) -> Table:
    """A row a monitor, a column a size: AUROC, faults found, and false alarms."""

    def cell(name: str, size: int) -> str:
        own = [r for r in records if (r["monitor"], r["episodes"]) == (name, size)]
        auroc, found, alarms = (Spread.of([r[key] for r in own]) for key in ("auroc", "found", "false_alarms"))
        return f"{auroc.text()} / {found.text(100, 0)} / {alarms.text(100, 0)}"

    rows = [(name, *(cell(name, n) for n in sizes)) for name in args.monitors]
    return Table(
        f"AUROC over the same steps / faults found at {100 * args.false_alarm_rate:g} % [%] / nominal test episodes "
        "with an alarm [%], by the number of episodes learned from, of all tasks together. All are calibrated on the "
        "same other episodes.",
        ("Monitor", *map(str, sizes)),
        rows,
    )


def curve(records: Sequence[Record], args: Args, sizes: Sequence[int]) -> Figure:
    """AUROC and faults found over the number of episodes."""
    with figure(height=4.0, width=9.0) as fig:
        for ax, (key, scale, label) in zip(
            fig.subplots(1, 2),
            (("auroc", 1, "AUROC"), ("found", 100, f"faults found at {100 * args.false_alarm_rate:g} % [%]")),
            strict=True,
        ):
            for i, name in enumerate(args.monitors):
                own = [[r[key] for r in records if (r["monitor"], r["episodes"]) == (name, n)] for n in sizes]
                colour, line, _ = look(i)
                values = [scale * float(np.mean(v)) for v in own]
                ax.plot(sizes, values, color=colour, linestyle=line, linewidth=1.8, marker="o", ms=3, label=name)
            ax.set(xscale="log", xlabel="episodes learned from", ylabel=label)
            ax.set_xticks(sizes, map(str, sizes))
            ax.minorticks_off()
            ax.grid(color="#dddddd", linewidth=0.6)
        handles, labels = ax.get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper center", ncols=3, handlelength=3.5)
    return fig


def main(argv: list[str] | None = None) -> int:
    """Compares, and returns the exit code."""
    return reproduce("learning_curve", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
