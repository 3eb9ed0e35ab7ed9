"""A memory of one policy watches another: as it is, re-calibrated, or fitted anew on the other's own episodes?

Reads the folders of two runs of ``asm-gym evaluate`` with the same tasks: one of the policy that the memory knows, one
of the policy that it is to watch.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro
from rich.console import Console

from asm_gym.episode import Episode
from asm_gym.evaluation.comparison import monitor_metrics, visible_kinds
from asm_gym.evaluation.metrics import DetectionMetrics, Kind, false_alarms
from asm_gym.evaluation.tables import Column, Table, console_table, count, markdown, percent_within, tabulate
from asm_gym.monitors import MONITORS
from asm_gym.rollouts.progress import stage
from asm_gym.rollouts.run_folder import recorded
from asm_gym.rollouts.scoring import detectability_of, result_of
from asm_gym.scripts.command import run
from asm_gym.scripts.reproduce.common import tasks_recorded
from asm_gym.validation import check_choice

Roles = Mapping[str, Sequence[Episode]]


@dataclass(frozen=True)
class Args:
    """One policy's memory on another policy's episodes."""

    known: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KNOWN")]
    """Folder of an evaluation of the policy that the memory knows."""
    watched: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WATCHED")]
    """Folder of one of the policy that it is to watch."""
    monitor: str = "neural_asm"
    """Name of the monitor."""
    false_alarm_rate: float = 0.05
    """Share of nominal episodes that may raise an alarm."""
    window: float = 1.0
    """How soon after its onset a fault must be noticed [s]."""
    seed: int = 0
    """Seed of the monitor."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/adopt")
    """Folder of the results."""

    def __post_init__(self) -> None:
        check_choice("monitor", self.monitor, MONITORS)


class Side(NamedTuple):
    """What was recorded of one policy."""

    folder: Path
    roles: Roles
    visible: dict[Kind, bool]  # kinds and severities that an ideal observer could see


def read_side(folder: Path, window_s: float) -> Side:
    """The recordings of an evaluation.

    Raises:
        ValueError: there are none.
    """
    roles, _, twins = recorded(folder.resolve(), tasks_recorded(folder))
    return Side(folder, roles, visible_kinds(detectability_of(twins, roles.get("faulty", []), window_s)))


def scores(args: Args) -> list[DetectionMetrics]:
    """One for each way, on the kinds of fault that can be seen under both policies."""
    known, watched = (read_side(folder, args.window) for folder in (args.known, args.watched))
    both = {k: seen and watched.visible.get(k, False) for k, seen in known.visible.items()}
    ways = {
        "known policy, its own memory": (known, known, known),
        "watched policy, that memory as it is": (known, known, watched),
        "re-calibrated on the watched": (known, watched, watched),
        "fitted anew on the watched": (watched, watched, watched),
    }
    found = []
    for name, (fit, calibration, tested) in ways.items():
        roles = {
            "fit": fit.roles["fit"],
            "calibration": calibration.roles["calibration"],
            "nominal": tested.roles["nominal"],
            "faulty": tested.roles.get("faulty", []),
        }
        result = result_of(args.monitor, fit.folder, roles, args.false_alarm_rate, args.seed)
        found.append(monitor_metrics(name, result, args.window, both))
    return found


COLUMNS: Sequence[Column[DetectionMetrics]] = (
    Column("", lambda m: m.name),
    Column("AUROC", lambda m: f"{m.auroc:.3f}"),
    Column("Found", lambda m: percent_within(m.detected)),
    Column("False alarms", lambda m: count(false_alarms(m.nominal))),
)


def table(found: Sequence[DetectionMetrics], args: Args) -> Table:
    """A row for each way."""
    return tabulate(
        f"{args.monitor}, faults found within {args.window:g} s and nominal episodes with an alarm, at a "
        f"threshold for {100 * args.false_alarm_rate:g} % of them; mean AUROC over kinds of fault; in brackets 95 % "
        "Wilson intervals.",
        COLUMNS,
        found,
    )


def compare_and_report(args: Args, console: Console) -> None:
    """Compares, writes the table and prints it."""
    with stage("fitting and judging", console, {}):
        found = scores(args)
    made = table(found, args)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "adopt.md").write_text(markdown(made) + "\n", encoding="utf-8")
    content = {"settings": asdict(args), "headings": made.headings, "rows": made.rows}
    (args.out / "adopt.json").write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")
    console.print(console_table(made))
    console.print(f"Wrote {args.out / 'adopt.md'} and {args.out / 'adopt.json'}")


def main(argv: list[str] | None = None) -> int:
    """Compares, and returns the exit code."""
    return run("reproduce adoption", Args, compare_and_report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
