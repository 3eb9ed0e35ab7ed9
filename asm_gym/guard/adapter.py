"""Connect a guard with its robots: what a wrapper, a pipeline or a live watch must do.

    sense_rows      robots ► rows (n, D)       read what the robots sensed
    send_command    command ► robots           do what the guard decided
    report_step     reports ► user             tell what became of the step

All else is the guard's: it judges the rows, and decides what is commanded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.robot_facts import NOTHING
from asm_gym.guard.step_info import RowReport


class SensedRows(NamedTuple):
    """One newest row of each of n robots, and what else is known of them."""

    rows: NDArray[np.float32]
    """(n, D) rows of the stream; NaN where a number is missing."""
    load: NDArray[np.float64] | None = None
    """(n, 2 + F) what the arms felt in physics substeps; None where nothing feels."""
    failures: Mapping[int, str] = NOTHING
    """What failed while the rows were sensed, by robot."""
    infos: Mapping[str, Any] = {}
    """What the environment said; empty where nothing."""


class Adapter(Protocol):
    """Sense, command and report: all that differs between one kind of robot and another."""

    def sense_rows(self, given: Any) -> SensedRows:
        """Read what the robots sensed.

        Args:
            given: the source's own record of the newest step.

        Returns:
            One row of each robot.
        """
        ...

    def send_command(self, command: Any) -> Any:
        """Do what the guard decided.

        Args:
            command: the actions to execute.

        Returns:
            What the robots' own interface returns for them.
        """
        ...

    def report_step(self, reports: Sequence[RowReport], target: Any) -> None:
        """Tell the user what became of a step.

        Args:
            reports: the guard's report of each row in the step, the newest last.
            target: the record of the step that the reports belong to.
        """
        ...
