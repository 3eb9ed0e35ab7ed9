"""Recordings of real arms that others have published, as streams of position, speed and torque or current.

None is shipped. A folder holds them under the names below; what is missing is named, with where it is published.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.body_model import read_urdf
from asm_gym.data.bags import read_bag
from asm_gym.data.logs import joined
from asm_gym.data.text import read_text
from asm_gym.episode import Episode

BODIES = "urdf"
BODIES_SOURCE = "it is in example-robot-data 6.0.0 (PyPI)"

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class RealArm:
    """A recording of one arm.

    Attributes:
        robot: which.
        place: file or folder below that of all recordings.
        source: where it is published: repository at a commit, and path.
        licence: as found there.
        read: from its place to columns: time, position, velocity, effort (T, J) each, where they are there.
        rate: that it is read at [Hz]; None for its own.
        unit: of a position, 1 in radians.
        model: whose kinematics it has, its effort being in N m; empty where a push is a step in one joint.
        urdf: file of its body model, in the folder ``urdf`` of that of all recordings; empty where there is none.
    """

    robot: str
    place: str
    source: str
    licence: str
    read: Callable[[Path], Columns]
    rate: float | None = None
    unit: float = 1.0
    model: str = ""
    urdf: str = ""

    def body(self, folder: Path) -> str:
        """The text of its body model. Raises FileNotFoundError that says where it is published."""
        path = folder / BODIES / self.urdf
        if not self.urdf or not path.is_file():
            raise FileNotFoundError(f"{path} is missing: {BODIES_SOURCE}")
        return read_urdf(path)

    def episode(self, folder: Path) -> Episode:
        """The recording. Raises FileNotFoundError that says where it is published."""
        path = folder / self.place
        if not path.exists():
            raise FileNotFoundError(f"{path} is missing: it is {self.source}")
        return Episode.from_table(self.read(path), rate=self.rate, success=True)


def _bag(path: Path) -> Columns:
    columns = read_bag(path)
    made: Columns = {"time": columns["time"]}
    for kind in ("position", "velocity", "effort"):
        made[kind] = np.column_stack([v for n, v in columns.items() if re.fullmatch(rf".*\.{kind}\[.*\]", n)])
    return made


def _flattened(path: Path) -> Columns:
    """One number a line, a line a joint, seven lines a row."""
    found = {"time": read_text(path / "time.txt", ["time"])["time"]}
    for name, file in (("position", "positions"), ("velocity", "velocity"), ("effort", "torques")):
        numbers = read_text(path / f"{file}.txt", [name])[name]
        if len(numbers) % len(found["time"]):
            raise ValueError(f"{path / file}.txt holds {len(numbers)} numbers, for {len(found['time'])} times")
        found[name] = numbers.reshape(len(found["time"]), -1)
    return found


def _three_files(path: Path) -> Columns:
    whole = joined({file.stem: read_text(file) for file in sorted(path.glob("*.csv"))})
    kinds = ("position", "velocity", "effort")
    return {"time": whole["time"]} | {
        kind: np.column_stack([v for n, v in whole.items() if n.endswith(kind)]) for kind in kinds
    }


EVERY = 50
"""Of 5,000 rows a second of the TX40 every fiftieth is read: currents by the mean of those, positions as they are."""


def _two_files(path: Path) -> Columns:
    position, current = (
        np.column_stack(list(read_text(path / name).values())) for name in ("pos_read_data.csv", "curr_data.csv")
    )
    rows = len(position) // EVERY
    means = current[: rows * EVERY].reshape(rows, EVERY, -1).mean(axis=1)
    return {"position [deg]": position[EVERY - 1 : rows * EVERY : EVERY], "effort": means}


ARMS = {
    "panda": RealArm(
        "Franka Panda",
        "unisa_acg/panda_exciting_trajectory.db3",
        "unisa-acg/inverse-dynamics-solver @ 41e196de, franka_inria_inverse_dynamics_solver/bagfiles",
        "BSD-3-Clause",
        _bag,
        model="panda",
        urdf="panda.urdf",
    ),
    "ur10": RealArm(
        "UR10",
        "unisa_acg/ur10_exciting_trajectory.db3",
        "unisa-acg/inverse-dynamics-solver @ 41e196de, ur10_inverse_dynamics_solver/bagfiles",
        "BSD-3-Clause",
        _bag,
        model="ur10",
        urdf="ur10_robot.urdf",
    ),
    "panda_gaz2019": RealArm(
        "Franka Panda",
        "panda_gaz2019",
        "marcocognetti/FrankaEmikaPandaDynModel @ 24d85ce4, matlab/data/Exciting_Traj/Trajectory_1/rbt_log",
        "GPL-3.0",
        _flattened,
        rate=100.0,
        model="panda",
        urdf="panda.urdf",
    ),
    "tiago": RealArm(
        "PAL TIAGo",
        "tiago_figaroh",
        "thanhndv212/figaroh-examples @ c0b5c7f0",
        "Apache-2.0 by reference",
        _three_files,
        urdf="tiago.urdf",
    ),
    "tx40": RealArm(
        "Staubli TX40",
        "staubli_tx40_figaroh",
        "thanhndv212/figaroh-examples @ c0b5c7f0",
        "Apache-2.0 by reference",
        _two_files,
        rate=5000.0 / EVERY,
        unit=180 / np.pi,
    ),
}
"""Arms that did nothing wrong while they were recorded."""

COBOT = "ur3_cobotops/dataset_02052023.csv"
COBOT_SOURCE = "UCI 963, doi 10.24432/C5J891 (CC BY 4.0)"
COBOT_EVENTS = ("Robot_ProtectiveStop", "grip_lost")
COBOT_LEFT_OUT = re.compile("Num|cycle|Temperature_.*")
"""What only says how long it has been running: it warmed up by ten degrees."""

EXECUTIONS = "uci_robot_execution_failures"
EXECUTIONS_SOURCE = "HongminWu/UCI-RobotExecutionFaliuresDataSet @ 02d958ea (UCI, CC BY 4.0)"
EXECUTION_S, EXECUTION_ROWS = 0.315, 15


def read_cobot(folder: Path) -> tuple[Columns, dict[str, NDArray[np.bool_]]]:
    """Columns of the UR3 of CobotOps, its time among them, and where each of its events is marked."""
    path = folder / COBOT
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: it is {COBOT_SOURCE}")
    columns = read_text(path)
    events = {name: np.nan_to_num(columns.pop(name)) > 0 for name in COBOT_EVENTS}
    return {n: v for n, v in columns.items() if not COBOT_LEFT_OUT.fullmatch(n)}, events


def read_executions(folder: Path) -> Iterator[tuple[str, str, NDArray[np.float64]]]:
    """Problem, class, and force and torque (15, 6) of each execution of the failures of Camarinha-Matos and others.

    Raises:
        FileNotFoundError: there is no file of them.
        ValueError: an execution is not of fifteen rows of six numbers.
    """
    files = sorted((folder / EXECUTIONS).glob("lp*.data"))
    if not files:
        raise FileNotFoundError(f"{folder / EXECUTIONS} holds no lp1.data to lp5.data: they are {EXECUTIONS_SOURCE}")
    for file in files:
        for block in re.split(r"\n\s*\n", file.read_text(encoding="ascii").strip()):
            kind, *lines = [line.strip() for line in block.splitlines() if line.strip()]
            rows = np.array([[float(cell) for cell in line.split()] for line in lines])
            if rows.shape != (EXECUTION_ROWS, 6):
                raise ValueError(f"{file}: an execution must be of {EXECUTION_ROWS} rows of 6, got {rows.shape}")
            yield file.stem, kind, rows
