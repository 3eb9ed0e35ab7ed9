"""Run a study from its command line, repeat it over seeds, and write its results.

A study is a module with a frozen ``Config`` and a function ``run(config) -> Findings``.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias, TypeVar

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from threadpoolctl import threadpool_limits

from asm_gym.evaluation.figures import look, save
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.files import write_text
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage as stage  # for studies
from asm_gym.rollouts.run_folder import versions
from asm_gym.scripts import command
from asm_gym.scripts.command import Options, option
from asm_gym.version import __version__

Item = TypeVar("Item")
Result = TypeVar("Result")

Record = dict[str, Any]
"""One measurement: the conditions, the seed, and the values measured."""

Records: TypeAlias = Sequence[Record] | pd.DataFrame
"""Measurements, as a list or as a table with a column for each name."""


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


def main(name: str, study: ModuleType, argv: Sequence[str] | None = None) -> int:
    """Run a study from its command line, write and print its results, and return the exit code.

    Args:
        name: of the study; its files are named after it.
        study: module with ``Config`` and ``run``.
        argv: options; those of the process by default.
    """

    def work(config: Any, console: Console) -> None:
        config.out.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        with threadpool_limits(1):  # several threads slow products this small down
            findings = study.run(config)
        path = config.out / name
        suffixes = write(path, findings, config, time.perf_counter() - start)
        for table in findings.tables:
            console.print(table)
        console.print(f"Wrote {path}{', '.join(suffixes)}")

    return command.run(f"reproduce {name}", study.Config, work, argv)


def write(path: Path, findings: Findings, config: Any, seconds: float) -> list[str]:
    """Write the figure, records (CSV), tables (Markdown) and conditions (JSON).

    Returns:
        The suffixes of the files written.
    """
    suffixes = []
    if findings.figure is not None:
        save(findings.figure, path.with_suffix(".png"))
        suffixes = [".png"]
    details = {
        "arguments": asdict(config),
        "seed": config.seed,
        "versions": versions("scipy", "torch", "matplotlib"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seconds": round(seconds, 1),
    }
    texts = {
        ".csv": pd.DataFrame(findings.records).to_csv(index=False),
        ".md": "\n\n".join(map(markdown, findings.tables)) + "\n",
        ".json": json.dumps(details, indent=2, default=str) + "\n",
    }
    for suffix, text in texts.items():
        write_text(path.with_suffix(suffix), text)
    return [*suffixes, *texts]


# ------------------------------------------------------------------ measurement


def each(
    label: str, work: Callable[[Item], Result], items: Sequence[Item], config: Config
) -> list[Result]:
    """Return ``[work(item) for item in items]``, by the study's workers with a progress bar."""
    with stage(label) as report:
        return parallel_map(work, items, config.workers, report)


def resumed(
    label: str, work: Callable[[Item], Result], items: Sequence[Item], config: Config
) -> list[Result]:
    """Return ``[work(item) for item in items]`` as ``each`` does; go on where a run of this version was interrupted.

    Results are kept as JSON in the folder of the study, until all are there. Items are known by their repr.
    """
    path = config.out / f"{label} of {__version__}.jsonl"
    kept = _kept(path)
    missing = [item for item in items if repr(item) not in kept]
    config.out.mkdir(parents=True, exist_ok=True)
    each(label, partial(_work_and_keep, work, path), missing, config)
    kept = _kept(path)
    path.unlink(missing_ok=True)
    return [kept[repr(item)] for item in items]


def _kept(path: Path) -> dict[str, Any]:
    """Return the results that were kept, by the text of their items; a last line that is cut off is none."""
    if not path.exists():
        return {}
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    return dict(map(json.loads, lines))


def _work_and_keep(work: Callable[[Item], Result], path: Path, item: Item) -> None:
    """Do the work of an item, and append its result to a file."""
    line = json.dumps([repr(item), work(item)], default=float)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")


def records_of(
    label: str, work: Callable[[Item], list[Record]], items: Sequence[Item], config: Config
) -> list[Record]:
    """Return the records of all items, by the study's workers with a progress bar."""
    return [*chain.from_iterable(each(label, work, items, config))]


def where(records: Records, **values: Any) -> pd.DataFrame:
    """Return the records with these values; a tuple stands for any of its values."""
    frame = pd.DataFrame(records)
    for name, value in values.items():
        allowed = (value,)
        if isinstance(value, tuple):
            allowed = value
        frame = frame[frame[name].isin(allowed)]
    return frame


def by_seed(records: Records, value: str, **values: Any) -> pd.Series[float]:
    """Return the mean of a value in each seed, over the records with these values."""
    chosen = where(records, **values).dropna(subset=[value])
    return chosen.astype({value: float}).groupby("seed")[value].mean()


# ------------------------------------------------------------------ tables and figures


def table_of(caption: str, rows: Sequence[Mapping[str, object]]) -> Table:
    """Return a table of rows that hold their cells by heading; without headings for no rows."""
    headings = list(rows[0]) if rows else []
    return Table(caption, headings, [tuple(row.values()) for row in rows])


def grid(
    caption: str, records: Records, value: str, rows: str, columns: str, digits: int = 2
) -> Table:
    """Return a table of means over seeds, with their standard deviation.

    Args:
        caption: of the table.
        records: measurements.
        value: name of the value in the cells.
        rows: name of the value that differs between rows.
        columns: name of the value that differs between columns.
        digits: after the decimal point.
    """
    frame = pd.DataFrame(records).dropna(subset=[rows, columns, value])
    cells = []
    for label, own in frame.groupby(rows, sort=False):
        row = {"": label}
        for column in frame[columns].unique():
            means = by_seed(own, value, **{columns: column})
            row[str(column)] = ""
            if len(means):
                row[str(column)] = Spread.of(means.to_numpy()).text(digits)
        cells.append(row)
    return table_of(caption, cells)


def curves(
    ax: Axes,
    records: Records,
    value: str,
    x: str,
    lines: str,
    order: Sequence[str] | None = None,
) -> None:
    """Draw curves: means over seeds with a band of a SD.

    Args:
        ax: where to draw.
        records: measurements.
        value: name of the value on the vertical axis.
        x: name of the value on the horizontal axis.
        lines: name of the value that differs between curves.
        order: its values, each of which looks the same in all axes; those of the records by default.
    """
    frame = pd.DataFrame(records)
    by_label = dict(list(frame.groupby(lines, sort=False)))
    for i, label in enumerate(order or by_label):
        if label not in by_label:
            continue
        own = by_label[label]
        means = own.groupby([x, "seed"])[value].mean().unstack("seed")
        mean = means.mean(axis=1)
        spread = means.std(axis=1)
        low = mean - spread
        colour, style, marker = look(i)
        ax.plot(mean, marker, color=colour, linestyle=style, markersize=4, label=label)
        ax.fill_between(mean.index, low, mean + spread, color=colour, alpha=0.15, linewidth=0)
