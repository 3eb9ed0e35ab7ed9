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
from rich.table import Table

from asm_gym.monitors import load_monitor
from asm_gym.monitors.limit_formats import FORMATS
from asm_gym.monitors.robot_limits import MARGIN, RobotLimits
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


def table_of(limits: RobotLimits) -> Table:
    """Return a row for each limit."""
    title = f"{limits.robot or 'This robot'}: healthy motion, and limits with a margin of {limits.margin:g}"
    table = Table(title=title)
    for column in ("limited", "number", "unit", "healthy", "limit", "rows near it"):
        table.add_column(column)
    for limit in limits.limits:
        near = "not kept"
        if limit.near is not None:
            near = f"{limit.near:.2%}"
        healthy = f"{limit.least:.3g} to {limit.most:.3g}"
        allowed = f"{limit.low:.3g} to {limit.high:.3g}"
        table.add_row(limit.kind, limit.label, limit.unit, healthy, allowed, near)
    return table


main: Callable[..., int] = partial(run, "limits", Args, print_limits)
