"""How many episodes it takes: monitors that learned from few and from many, all calibrated and tested on the same.

Reads the recordings of ``asm-gym evaluate``. The episodes to learn from are taken from all tasks in turn, so that the
few are among the many; each repetition begins elsewhere, and seeds the monitors anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.comparison import Detectability, MonitorResult, visible_kinds
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.metrics import false_alarms
from asm_gym.evaluation.scoring import fitted, judged
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table
from asm_gym.monitors.registry import check_monitor
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import RunConfig, in_turn
from asm_gym.validation import check_number


@dataclass(frozen=True)
class Config(RunConfig):
    """Detection by the number of episodes that were learned from."""

    seeds: int = option(1, least=1)
    """How often it repeats itself."""
    monitors: tuple[str, ...] = option(
        (
            "neural_asm",
            "association_linear+evidence",
            "window_pca+evidence",
            "gru+evidence",
            "kalman+evidence",
        ),
        least=1,
        check=check_monitor,
    )
    """Names of monitors."""
    episodes: tuple[int, ...] = option(
        (10, 20, 40, 80, 160, 320, 640, 1000),
        quick=(10, 20, 40),
        least=1,
        check=partial(check_number, "episodes", low=1, whole=True),
    )
    """How many episodes are learned from, of all tasks together; those that the run does not have are left out."""


class Job(NamedTuple):
    """One monitor to be fitted on some episodes and asked."""

    monitor: str
    episodes: int
    seed: int


def score(job: Job, config: Config) -> Record:
    """What one monitor finds after that many episodes."""
    recordings = config.roles
    learned = in_turn(recordings["fit"], job.seed)[: job.episodes]
    by_role = {**recordings, "fit": learned, "harmless": []}
    monitor = fitted(config.out / "learning_curve", job.monitor, learned, job.seed)
    result = judged(job.monitor, monitor, by_role, config.false_alarm_rate)
    return job._asdict() | measured(result, config.detectable(recordings.get("faulty", [])), config, job.monitor)


def measured(result: MonitorResult, seen: Sequence[Detectability], config: Config, name: str) -> Record:
    """AUROC, faults found, and nominal episodes with an alarm, over the kinds that can be seen."""
    metrics = result.metrics(name, config.window, visible_kinds(seen))
    found, alarms = metrics.found[config.false_alarm_rate].value, false_alarms(metrics.nominal).value
    return {"auroc": metrics.auroc, "whole": metrics.unmatched_auroc, "found": found, "false_alarms": alarms}


def run(config: Config) -> Findings:
    """Fits and asks every monitor at every size."""
    available = len(config.roles["fit"])
    sizes = sorted({min(n, available) for n in config.episodes})
    jobs = [Job(m, n, s) for n in sizes for m in config.monitors for s in config.repetitions]
    records = kit.each("fitting and judging", partial(score, config=config), jobs, config)
    facts = {"tasks": config.tasks, "episodes": available}
    return Findings(records, [table(records, config, sizes)], curve(records, config, sizes), facts)


def table(records: Sequence[Record], config: Config, sizes: Sequence[int]) -> Table:
    """A row a monitor, a column a size: AUROC, faults found, and false alarms."""

    def cell(name: str, size: int) -> str:
        own = [r for r in records if (r["monitor"], r["episodes"]) == (name, size)]
        auroc, found, alarms = (Spread.of([r[key] for r in own]) for key in ("auroc", "found", "false_alarms"))
        return f"{auroc.text()} / {found.text(100, 0)} / {alarms.text(100, 0)}"

    rows = [(name, *(cell(name, n) for n in sizes)) for name in config.monitors]
    return Table(
        f"AUROC over the same steps / faults found at {100 * config.false_alarm_rate:g} % [%] / nominal test episodes "
        "with an alarm [%], by the number of episodes learned from, of all tasks together. All are calibrated on the "
        "same other episodes.",
        ("Monitor", *map(str, sizes)),
        rows,
    )


def curve(records: Sequence[Record], config: Config, sizes: Sequence[int]) -> Figure:
    """AUROC and faults found over the number of episodes."""
    with figure(height=4.0, width=9.0) as fig:
        for ax, (key, scale, label) in zip(
            fig.subplots(1, 2),
            (("auroc", 1, "AUROC"), ("found", 100, f"faults found at {100 * config.false_alarm_rate:g} % [%]")),
            strict=True,
        ):
            for i, name in enumerate(config.monitors):
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
