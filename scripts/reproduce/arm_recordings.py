"""Recordings of real arms that others have published, as streams of position, speed and torque or current.

None is shipped. A folder holds them under the names below; a missing one is named, with where it is published.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.body_model import read_urdf
from asm_gym.data.bags import read_bag
from asm_gym.data.text import read_text
from asm_gym.episode import Episode

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class RealArm:
    """A recording of an arm that did nothing wrong.

    Attributes:
        robot: its name.
        place: file or folder below that of all recordings.
        source: where it is published: repository at a commit, path, licence.
        read: function from its place to columns: time, position [rad], velocity, effort (T, J) each.
        urdf: file of its body model, in the folder ``urdf`` of that of all recordings.
    """

    robot: str
    place: str
    source: str
    read: Callable[[Path], Columns]
    urdf: str = ""

    def body(self, folder: Path) -> str:
        """Return the text of its body model."""
        path = folder / "urdf" / self.urdf
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing: it is in example-robot-data 6.0.0 (PyPI)")
        return read_urdf(path)

    def episode(self, folder: Path) -> Episode:
        """Return the recording."""
        return Episode.from_table(self.read(there(folder / self.place, self.source)), success=True)


def there(path: Path, source: str) -> Path:
    """Return a path that exists.

    Raises:
        FileNotFoundError: it does not; the message says where it is published.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: it is {source}")
    return path


def _bag(path: Path) -> Columns:
    """Read a ROS 2 bag of joint states."""
    columns = read_bag(path)
    made: Columns = {"time": columns["time"]}
    for kind in ("position", "velocity", "effort"):
        made[kind] = np.column_stack([v for n, v in columns.items() if re.fullmatch(rf".*\.{kind}\[.*\]", n)])
    return made


def _three_files(path: Path) -> Columns:
    """Read one file each of positions, velocities and efforts, interpolated at the times of the first one."""
    tables = [read_text(file) for file in sorted(path.glob("*.csv"))]
    times = [table.pop("t") for table in tables]
    due = times[0][(times[0] >= max(t[0] for t in times)) & (times[0] <= min(t[-1] for t in times))]
    whole = {name: np.interp(due, t, v) for t, table in zip(times, tables, strict=True) for name, v in table.items()}
    kinds = ("position", "velocity", "effort")
    return {"time": due} | {kind: np.column_stack([v for n, v in whole.items() if n.endswith(kind)]) for kind in kinds}


UNISA = "unisa-acg/inverse-dynamics-solver @ 41e196de (BSD-3-Clause)"
FIGAROH = "thanhndv212/figaroh-examples @ c0b5c7f0 (Apache-2.0 by reference)"
ARMS = {
    "panda": RealArm("Franka Panda", "unisa_acg/panda_exciting_trajectory.db3", UNISA, _bag, "panda.urdf"),
    "ur10": RealArm("UR10", "unisa_acg/ur10_exciting_trajectory.db3", UNISA, _bag, "ur10_robot.urdf"),
    "tiago": RealArm("PAL TIAGo", "tiago_figaroh", FIGAROH, _three_files, "tiago.urdf"),
}

COBOT = "ur3_cobotops/dataset_02052023.csv"
COBOT_SOURCE = "UCI 963, doi 10.24432/C5J891 (CC BY 4.0)"
COBOT_EVENTS = ("Robot_ProtectiveStop", "grip_lost")
COBOT_LEFT_OUT = re.compile("Num|cycle|Temperature_.*")
"""Columns that only say how long it has been running: it warmed up by ten degrees."""


def read_cobot(folder: Path) -> tuple[Columns, dict[str, NDArray[np.bool_]]]:
    """Return the columns of the UR3 of CobotOps, its time among them, and the rows of each of its events (T,)."""
    columns = read_text(there(folder / COBOT, COBOT_SOURCE))
    events = {name: np.nan_to_num(columns.pop(name)) > 0 for name in COBOT_EVENTS}
    return {n: v for n, v in columns.items() if not COBOT_LEFT_OUT.fullmatch(n)}, events
