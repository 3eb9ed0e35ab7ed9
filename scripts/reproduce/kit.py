"""The kit of the studies: everything around a study that is not the study.

A study is a module with a frozen ``Config`` and ``run(config) -> Findings``:

    @dataclass(frozen=True)
    class Config(kit.Config):
        '''What it asks.'''

        letters: int = option(8, quick=2, least=1)
        '''How many letters.'''

    def run(config: Config) -> Findings:
        records = kit.each("learning letters", partial(one_seed, config=config), config.repetitions, config)
        return Findings(records, tables(records, config), drawn(records, config))

The kit reads the command line, says how far it has come, repeats over seeds, and writes what was found.
"""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from scipy.stats import t as student
from threadpoolctl import threadpool_limits

from asm_gym.evaluation.figures import save
from asm_gym.evaluation.film import write_gif
from asm_gym.evaluation.statistics import Estimate, Spread
from asm_gym.evaluation.tables import ConsoleTable, Table, markdown
from asm_gym.rollouts import progress
from asm_gym.rollouts.parallel import Progress, parallel_map
from asm_gym.rollouts.run_folder import versions
from asm_gym.scripts import command
from asm_gym.scripts.options import check_options, option

Item = TypeVar("Item")
Result = TypeVar("Result")

Record = dict[str, Any]
"""One measurement: what was varied, the seed, and what came out."""


@dataclass(frozen=True)
class Config:
    """Options of every study."""

    seed: int = option(0, least=0)
    """The first seed; a study repeats itself with those that follow."""
    seeds: int = option(3, quick=2, least=1)
    """How often it repeats itself."""
    workers: int = option(2, least=1)
    """Processes."""
    out: Path = option(Path("runs/reproduce"), metavar="FOLDER")
    """Folder of the results, and of the robosuite episodes, which are recorded once."""
    quick: bool = False
    """Little of everything: to see that it runs, not to judge the figures."""

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def repetitions(self) -> range:
        """The seeds."""
        return range(self.seed, self.seed + self.seeds)


class Findings(NamedTuple):
    """What a study found."""

    records: Sequence[Record]
    tables: Sequence[Table]
    figure: Figure | None = None
    facts: Mapping[str, Any] = {}  # whatever else is worth keeping; JSON-serialisable
    film: Sequence[NDArray[np.uint8]] = ()  # frames (H, W, 3), 20 a second


@dataclass
class Sitting:
    """Where a study prints that runs now, and how long its stages took."""

    console: Console = field(default_factory=lambda: Console(stderr=True))
    seconds: dict[str, float] = field(default_factory=dict)


_NOW: ContextVar[Sitting] = ContextVar("sitting")


def now() -> Sitting:
    """The sitting of the study that runs; one of its own for a study that is called by itself."""
    return _NOW.get(None) or Sitting()


@contextmanager
def stage(what: str) -> Iterator[Progress]:
    """Shows how far ``what`` has come, and notes how long it took; yields what is called as (done, total)."""
    with progress.stage(what, now().console, now().seconds) as tell:
        yield tell


def each(what: str, work: Callable[[Item], Result], items: Sequence[Item], config: Config) -> list[Result]:
    """``[work(item) for item in items]`` by the workers of a study, as a stage of its own."""
    with stage(what) as tell:
        return parallel_map(work, items, config.workers, tell)


def together(found: Sequence[Sequence[Record]]) -> list[Record]:
    """The records of all repetitions."""
    return [record for own in found for record in own]


def main(study: ModuleType, argv: Sequence[str] | None = None) -> int:
    """Runs a study by its command line, publishes what it found, and returns the exit code."""
    name = study.__name__.rpartition(".")[2]

    def work(config: Any, console: Console) -> None:
        conduct(name, study.run, config, console)

    return command.run(f"reproduce {name}", study.Config, work, argv, study.__doc__)


def conduct(name: str, study: Callable[[Any], Findings], config: Any, console: Console) -> None:
    """Runs a study, writes what it found into its folder, and prints it."""
    _ = getattr(config, "tasks", ())  # of a run: refused where there is none, before anything is written
    config.out.mkdir(parents=True, exist_ok=True)  # refused before the study, not after it
    sitting = Sitting(console)
    token = _NOW.set(sitting)
    try:
        with threadpool_limits(1):  # products this small are slowed down by several threads
            found = study(config)
    finally:
        _NOW.reset(token)
    publish(name, found, config, sitting.seconds)
    for table in found.tables:
        console.print(ConsoleTable(table))
    kinds = (".png, .svg, " if found.figure else "") + (".gif, " if found.film else "") + ".csv"
    console.print(f"Wrote {config.out / name}{kinds}, .md and .json")


def publish(name: str, found: Findings, config: Any, seconds: Mapping[str, float]) -> None:
    """Writes figure (PNG, SVG), film (GIF), every measurement (CSV), tables (Markdown), and how it was made (JSON)."""
    folder: Path = config.out
    folder.mkdir(parents=True, exist_ok=True)
    if found.figure is not None:
        save(found.figure, folder / f"{name}.png")
        found.figure.savefig(folder / f"{name}.svg", format="svg", metadata={"Date": None})
    if found.film:
        write_gif(folder / f"{name}.gif", found.film, fps=20)
    columns = list(dict.fromkeys(key for r in found.records for key in r))
    with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(found.records)
    text = "\n\n".join(markdown(t) for t in found.tables)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    details = {
        "arguments": json.loads(json.dumps(asdict(config), default=str)),
        "seed": config.seed,
        "versions": versions("scipy", "torch", "matplotlib"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seconds": dict(seconds),
        **found.facts,
    }
    (folder / f"{name}.json").write_text(json.dumps(details, indent=2) + "\n", encoding="utf-8")


def over_seeds(records: Sequence[Record], value: str, **where: Any) -> Spread:
    """Over the mean of each seed, of the records that are as ``where`` says; NaN where there are none."""
    chosen = [r for r in records if all(r.get(k) == v for k, v in where.items()) and r.get(value) is not None]
    means = [np.mean([r[value] for r in chosen if r["seed"] == s]) for s in dict.fromkeys(r["seed"] for r in chosen)]
    return Spread.of([float(mean) for mean in means]) if means else Spread(float("nan"), float("nan"))


def paired(records: Sequence[Record], value: str, one: Record, other: Record, **where: Any) -> Estimate:
    """How much larger a value is of ``one`` than of ``other``, seed by seed, with Student's 95 % interval."""

    def of(chosen: Record) -> dict[int, float]:
        own = {r["seed"] for r in records if all(r.get(k) == v for k, v in (where | chosen).items())}
        return {seed: over_seeds(records, value, seed=seed, **where | chosen).mean for seed in own}

    first, second = of(one), of(other)
    apart = np.array([first[seed] - second[seed] for seed in sorted(first.keys() & second.keys())])
    if len(apart) < 2:
        return Estimate(float(apart.mean()) if len(apart) else float("nan"), float("-inf"), float("inf"))
    half = float(student.ppf(0.975, len(apart) - 1) * apart.std(ddof=1) / np.sqrt(len(apart)))
    return Estimate(float(apart.mean()), float(apart.mean()) - half, float(apart.mean()) + half)


def by(name: str, values: Iterable[Any]) -> dict[str, Record]:
    """What each row or column of a table is of: ``{"5": {"step": 5}, …}``."""
    return {str(value): {name: value} for value in values}


def grid(
    caption: str,
    records: Sequence[Record],
    value: str,
    rows: Mapping[str, Record],
    columns: Mapping[str, Record],
    digits: int = 2,
    **where: Any,
) -> Table:
    """Means over seeds with their spread: a cell is of the records that are as its row and its column say."""

    def cells(row: Record) -> Iterator[str]:
        return (shown(records, value, digits, **where | row | column) for column in columns.values())

    return Table(caption, ("", *columns), [(label, *cells(row)) for label, row in rows.items()])


def shown(records: Sequence[Record], value: str, digits: int = 2, **where: Any) -> str:
    """``mean ± spread`` over seeds, for a table; empty where there is nothing."""
    found = over_seeds(records, value, **where)
    return "" if np.isnan(found.mean) else found.text(digits=digits)
