"""Print what healthy motion needs, as the robot's own settings.

The limits are those of the episodes that the memory was calibrated on, times a margin. They bound nothing for safety
by themselves: a robot's own rated limits stay in force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from rich.console import Console

from asm_gym.evaluation.tables import Table, tabulate
from asm_gym.monitors import load_monitor
from asm_gym.monitors.limit_formats import FORMATS
from asm_gym.monitors.robot_limits import MARGIN, TARGET_DISTANCE, Limit, RobotLimits
from asm_gym.monitors.shipped import pretrained, pretrained_file
from asm_gym.scripts.command import Checked, option, run

Format = Literal["table", "franka", "ur", "lerobot", "moveit", "yaml", "json"]


@dataclass(frozen=True)
class Args(Checked):
    """What is asked for."""

    memory: str = option(positional=True, metavar="MEMORY")
    """File of a memory, or the name of a shipped one, such as panda."""
    format: Format = option("table")
    """franka: collision thresholds of libfranka and franka_ros2; ur: PolyScope's safety configuration; lerobot:
    max_relative_target and stall currents; moveit: joint_limits.yaml and the scales of Servo."""
    margin: float = option(MARGIN, least=1)
    """Limit over the greatest healthy value."""


def print_limits(args: Args, console: Console) -> None:
    """Print the limits of a memory."""
    file = args.memory
    if file in pretrained():
        file = str(pretrained_file(file))
    limits = load_monitor(file).limits(args.margin)
    if args.format == "table":
        console.print(table_of(limits))
    else:
        print(FORMATS[args.format](limits))


COLUMNS: dict[str, Callable[[Limit], str]] = {
    "number": lambda limit: (
        f"target of {limit.label}" if limit.kind == TARGET_DISTANCE else limit.label
    ),
    "healthy": lambda limit: f"{limit.least:.3g} to {limit.most:.3g}",
    "limit": lambda limit: f"{limit.low:.3g} to {limit.high:.3g}",
    "unit": lambda limit: limit.unit,
    "near it": lambda limit: "" if limit.near is None else f"{limit.near:.2%}",
}
"""Cells of a limit; *near it* is a share of healthy rows."""


def table_of(limits: RobotLimits) -> Table:
    """Return a row for each limit."""
    robot = limits.robot or "This robot"
    caption = f"{robot}: healthy motion, and limits with a margin of {limits.margin:g}"
    return tabulate(caption, COLUMNS, limits.limits)


main: Callable[..., int] = partial(run, "limits", Args, print_limits)
