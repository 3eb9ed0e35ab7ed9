"""What the studies share: arguments, robosuite demonstrations, and how findings are written down."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from threadpoolctl import threadpool_limits

import asm_gym
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.figures import save
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table, console_table, markdown
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import make_missing, tasks_in
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import RolloutConfig, record
from asm_gym.scripts.command import at_least, run

Record = dict[str, Any]
"""One measurement: what was varied, the seed, and what came out."""

SKILLS = ("Lift", "Stack", "PickPlaceCan")
"""The robosuite skills of one memory."""

SENSED = 75
"""Numbers that their streams hold beside the action."""


@dataclass(frozen=True)
class Common:
    """Arguments of every study."""

    seed: int = 0
    """The first seed; a study repeats itself with those that follow."""
    seeds: int = 3
    """How often it repeats itself."""
    workers: int = 2
    """Processes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/reproduce")
    """Folder of the results, and of the robosuite episodes, which are recorded once."""
    quick: bool = False
    """Little of everything: to see that it runs, not to judge the figures."""

    def __post_init__(self) -> None:
        at_least(1, self, "seeds", "workers")
        at_least(0, self, "seed")

    @property
    def repetitions(self) -> range:
        """The seeds."""
        return range(self.seed, self.seed + self.seeds)


class Findings(NamedTuple):
    """What a study found."""

    records: Sequence[Record]
    tables: Sequence[Table]
    figure: Figure
    facts: dict[str, Any]  # whatever else is worth keeping; JSON-serialisable


Args = TypeVar("Args", bound=Common)
Study = Callable[[Args, Console, dict[str, float]], Findings]
"""Handed the arguments, where to print, and where to note how long each stage took."""


def reproduce(name: str, study: Study[Args], kind: type[Args], description: str | None, argv: list[str] | None) -> int:
    """Runs a study, publishes what it found, and returns the exit code."""

    def conduct(args: Args, console: Console) -> None:
        seconds: dict[str, float] = {}
        args.out.mkdir(parents=True, exist_ok=True)  # refused before the study, not after it
        with threadpool_limits(1):  # products this small are slowed down by several threads
            found = study(args, console, seconds)
        publish(name, found, args, seconds)
        for table in found.tables:
            console.print(console_table(table))
        console.print(f"Wrote {args.out / name}.png, .svg, .csv, .md and .json")

    return run(f"reproduce {name}", kind, conduct, argv, description)


def publish(name: str, found: Findings, args: Common, seconds: dict[str, float]) -> None:
    """Writes the figure (PNG, SVG), every measurement (CSV), the tables (Markdown), and how it was made (JSON)."""
    args.out.mkdir(parents=True, exist_ok=True)
    save(found.figure, args.out / f"{name}.png")
    found.figure.savefig(args.out / f"{name}.svg", format="svg", metadata={"Date": None})
    columns = list(dict.fromkeys(key for r in found.records for key in r))
    with (args.out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(found.records)
    text = "\n\n".join(markdown(t) for t in found.tables)
    (args.out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    packages = ("numpy", "scipy", "torch", "mujoco", "robosuite", "matplotlib")
    details = {
        "arguments": json.loads(json.dumps(asdict(args), default=str)),
        "seed": args.seed,
        "versions": {"asm_gym": asm_gym.__version__, **{p: metadata.version(p) for p in packages}},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "seconds": seconds,
        **found.facts,
    }
    (args.out / f"{name}.json").write_text(json.dumps(details, indent=2) + "\n", encoding="utf-8")


def over_seeds(records: Sequence[Record], value: str, **where: Any) -> Spread:
    """Over the mean of each seed, of the records that are as ``where`` says; NaN where there are none."""
    chosen = [r for r in records if all(r.get(k) == v for k, v in where.items()) and r.get(value) is not None]
    each = [np.mean([r[value] for r in chosen if r["seed"] == s]) for s in dict.fromkeys(r["seed"] for r in chosen)]
    return Spread.of([float(mean) for mean in each]) if each else Spread(float("nan"), float("nan"))


def shown(records: Sequence[Record], value: str, digits: int = 2, **where: Any) -> str:
    """``mean ± spread`` over seeds, for a table; empty where there is nothing."""
    found = over_seeds(records, value, **where)
    return "" if np.isnan(found.mean) else found.text(digits=digits)


def tasks_recorded(run: Path) -> tuple[str, ...]:
    """Names of the tasks that an evaluation has recorded.

    Raises:
        ValueError: there are none.
    """
    tasks = tuple(tasks_in(run))
    if not tasks:
        raise ValueError(f"{run} holds no recordings: run asm-gym evaluate first")
    return tasks


def recorded(
    args: Common, labels: Sequence[EpisodeLabel], console: Console, seconds: dict[str, float]
) -> list[Episode]:
    """The episodes of these labels, recorded where they are not there yet; those that failed are among them."""
    with stage("recording robosuite episodes", console, seconds) as progress:
        make = partial(record, config=RolloutConfig(), folder=args.out.resolve())
        make_missing(make, labels, lambda label: args.out / label.path, args.workers, progress)
    return [load_episode(args.out / label.path) for label in labels]


def nominal_labels(tasks: Sequence[str], role: str, episodes: int) -> list[EpisodeLabel]:
    """The first so many nominal episodes of each task; the same for every seed of a study."""
    return [EpisodeLabel(task, role, seed=s) for task in tasks for s in role_seeds(0, task, role, episodes)]


def demonstrations(
    args: Common, tasks: Sequence[str], role: str, episodes: int, console: Console, seconds: dict[str, float]
) -> list[Episode]:
    """Nominal episodes of the scripted experts that succeeded."""
    return [e for e in recorded(args, nominal_labels(tasks, role, episodes), console, seconds) if e.success]


def wide_enough(hidden: int, channels: int) -> None:
    """Raises ValueError where a network has fewer hidden units than numbers to predict."""
    if hidden < channels:
        raise ValueError(f"hidden must be at least the number of channels, {channels}, got {hidden}")
