"""Run a study from its command line, repeat it over seeds, and write what it found.

A study is a module with a frozen ``Config`` and a function ``run(config) -> Findings``.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from threadpoolctl import threadpool_limits

from asm_gym.evaluation.figures import look, save
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.files import write_text, written_whole
from asm_gym.rollouts import progress
from asm_gym.rollouts.parallel import Progress, parallel_map
from asm_gym.rollouts.run_folder import versions
from asm_gym.scripts import command
from asm_gym.scripts.command import Options, option

Item = TypeVar("Item")
Result = TypeVar("Result")

Record = dict[str, Any]
"""One measurement: the conditions, the seed, and the values measured."""


@dataclass(frozen=True)
class Config(Options):
    """Options of every study."""

    seeds: int = option(3, quick=2, least=1)
    """Number of repetitions; they take the seeds that follow."""
    workers: int = option(2, least=1)
    """Processes."""
    out: Path = option(Path("runs/reproduce"), metavar="FOLDER")
    """Folder of the results."""

    @property
    def repetitions(self) -> range:
        """Seeds of the repetitions."""
        return range(self.seed, self.seed + self.seeds)


class Findings(NamedTuple):
    """Results of a study."""

    records: Sequence[Record]
    tables: Sequence[Table]
    figure: Figure | None = None


def main(study: ModuleType, argv: Sequence[str] | None = None) -> int:
    """Run a study from its command line, write and print its results, and return the exit code."""
    name = study.__name__.rpartition(".")[2]

    def work(config: Any, console: Console) -> None:
        config.out.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        with threadpool_limits(1):  # several threads slow products this small down
            found = study.run(config)
        written = write(config.out / name, found, config, time.perf_counter() - start)
        for table in found.tables:
            console.print(table)
        console.print(f"Wrote {config.out / name}{', '.join(written)}")

    return command.run(f"reproduce {name}", study.Config, work, argv)


def write(path: Path, found: Findings, config: Any, seconds: float) -> list[str]:
    """Write the figure, records (CSV), tables (Markdown) and conditions (JSON); return the suffixes."""
    written = [".csv", ".md", ".json"]
    if found.figure is not None:
        save(found.figure, path.with_suffix(".png"))
        with written_whole(path.with_suffix(".svg")) as file:
            found.figure.savefig(file, format="svg", metadata={"Date": None})
        written = [".png", ".svg", *written]
    write_text(path.with_suffix(".csv"), pd.DataFrame(found.records).to_csv(index=False))
    write_text(path.with_suffix(".md"), "\n\n".join(map(markdown, found.tables)) + "\n")
    details = {
        "arguments": json.loads(json.dumps(asdict(config), default=str)),
        "seed": config.seed,
        "versions": versions("scipy", "torch", "matplotlib"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seconds": round(seconds, 1),
    }
    write_text(path.with_suffix(".json"), json.dumps(details, indent=2) + "\n")
    return written


# ------------------------------------------------------------------ measurement


def stage(what: str) -> AbstractContextManager[Progress]:
    """Show the progress of ``what`` while the block runs; yields a function of (done, total)."""
    return progress.stage(what, Console(), {})


def each(
    what: str, work: Callable[[Item], Result], items: Sequence[Item], config: Config
) -> list[Result]:
    """Return ``[work(item) for item in items]``, computed by the study's workers with a progress bar."""
    with stage(what) as tell:
        return parallel_map(work, items, config.workers, tell)


def where(records: Sequence[Record], **values: Any) -> list[Record]:
    """Return the records that have these values."""
    return [r for r in records if all(r.get(name) == value for name, value in values.items())]


def by_seed(records: Sequence[Record], value: str, **values: Any) -> pd.Series[float]:
    """Return the mean of a value in each seed, over the records with these values."""
    chosen = pd.DataFrame(where(records, **values), columns=["seed", value]).dropna()
    return chosen.astype({value: float}).groupby("seed")[value].mean()


def over_seeds(records: Sequence[Record], value: str, **values: Any) -> Spread:
    """Return mean and spread of the means of each seed, over the records with these values; NaN without records."""
    means = by_seed(records, value, **values)
    return Spread(float(means.mean()), float(means.std()))


# ------------------------------------------------------------------ tables and figures


def by(name: str, values: Iterable[Any]) -> dict[str, Record]:
    """Return the rows or columns of a ``grid``: ``{"5": {"step": 5}, …}``."""
    return {str(value): {name: value} for value in values}


def grid(
    caption: str,
    records: Sequence[Record],
    value: str,
    rows: Mapping[str, Record],
    columns: Mapping[str, Record],
    digits: int = 2,
    **values: Any,
) -> Table:
    """Return a table of means over seeds; a cell is of the records with the values of its row and column."""
    cells = [
        (
            label,
            *(
                shown(records, value, digits, **values | row | column)
                for column in columns.values()
            ),
        )
        for label, row in rows.items()
    ]
    return Table(caption, ("", *columns), cells)


def shown(records: Sequence[Record], value: str, digits: int = 2, **values: Any) -> str:
    """Return ``mean ± spread`` over seeds, for a table; empty without records."""
    found = over_seeds(records, value, **values)
    return "" if np.isnan(found.mean) else found.text(digits=digits)


def curves(
    ax: Axes,
    records: Sequence[Record],
    value: str,
    x: tuple[str, Sequence[Any]],
    lines: Mapping[str, Record],
    **values: Any,
) -> None:
    """Draw a curve for each of ``lines``, over the values of what ``x`` names: means over seeds with a band of a SD."""
    name, places = x
    for i, (label, line) in enumerate(lines.items()):
        found = [over_seeds(records, value, **{**values, **line, name: place}) for place in places]
        mean, spread = np.array(found).T
        colour, style, marker = look(i)
        ax.plot(
            places, mean, color=colour, linestyle=style, marker=marker, markersize=4, label=label
        )
        ax.fill_between(places, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
