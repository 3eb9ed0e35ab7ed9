"""Read the recordings of real arms that the study ``real_arms`` uses, from a folder of the user.

A set holds runs in which the arm did nothing wrong, and perhaps runs with faults that were labelled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.io
from numpy.typing import NDArray

from asm_gym.data.bags import read_bag
from asm_gym.data.episode import Episode
from asm_gym.readings import spans
from asm_gym.rollouts.run_trials import collect

Columns = dict[str, NDArray[Any]]

SLIP_RAD = 0.05  # of an encoder [rad]
SERVO_UNITS = 1000  # highest position of a bus servo, that is 240°
# Readings of a bus servo that can be true; others are glitches.
SERVO_RANGES = {
    "position": (0.0, SERVO_UNITS),
    "temperature": (0.0, 100.0),  # [°C]
    "voltage": (4500.0, 9000.0),  # [mV]
}
GLITCH_ROWS = 50  # of a run before and after a glitch that are watched
UNMARKED_FAILURE = "20240325_155003"
HIRO_EVERY = 4  # rows of HIRO of which one is read: 50 of 200 a second
HIRO_REPEATED = slice(3, 19)  # good runs of HIRO, numbered from 2, that repeat one programme
SYNTHETIC_EPISODES = 1920  # of 4 s: 128 min, half of which are learned from
SYNTHETIC_EVERY = 4  # rows of the synthetic arm of which one is read: 25 of 100 a second


@dataclass(frozen=True)
class Runs:
    """Runs of an arm as tables of columns."""

    healthy: list[Columns]
    faulty: dict[str, list[Columns]] = field(default_factory=dict)
    """By kind; a column ``label`` marks the rows with the fault, otherwise all have it."""


@dataclass(frozen=True)
class RealArm:
    """A set of recordings of an arm."""

    robot: str
    place: str  # below the folder of all recordings
    source: str
    read: Callable[[Path], Runs]
    piece_s: float
    """Length of the pieces that are dealt out [s]; runs are no longer than ``inf``."""
    rate: float | None = None  # of the rows [Hz]; by default from their clock
    urdf: str = ""  # file in the folder ``urdf`` of that of all recordings; empty without
    efforts: tuple[str, ...] = (
        "effort",
    )  # channels of torques, or of force and torque at the wrist
    slip: float = SLIP_RAD  # of an encoder, in units of its position
    has_joint_torques: bool = True
    one_campaign: bool = True  # its runs with faults were recorded as the healthy ones were

    def episodes(self, folder: Path) -> tuple[list[Episode], dict[str, list[Episode]]]:
        """Return the healthy runs as episodes, and those with faults by their kind."""
        runs = self.read(folder / self.place)
        kinds = [kind for kind, tables in runs.faulty.items() for _ in tables]
        faulty = [table for tables in runs.faulty.values() for table in tables]
        tables = [*runs.healthy, *faulty]
        episodes = Episode.from_tables(tables, rate=self.rate, labels=("label",), success=True)
        count = len(runs.healthy)
        by_kind: dict[str, list[Episode]] = {kind: [] for kind in kinds}
        for kind, episode in zip(kinds, episodes[count:], strict=True):
            by_kind[kind].append(episode)
        return episodes[:count], by_kind


def read_joint_states(path: Path) -> Columns:
    """Return time, position [rad], velocity and effort of each joint of a ROS bag."""
    return {name.removeprefix("joint_states."): values for name, values in read_bag(path).items()}


def one_bag(path: Path) -> Runs:
    """Read one healthy run."""
    return Runs([read_joint_states(path)])


def numbered(**channels: NDArray[Any]) -> Columns:
    """Return a column for each number of channels (T, N), as ``position[0]``."""
    columns: Columns = {}
    for name, values in channels.items():
        columns |= {f"{name}[{n}]": column for n, column in enumerate(values.T)}
    return columns


def ur3_bags(folder: Path) -> Runs:
    """Read seven bags of a UR3, of which one repeats another: position, velocity and effort."""
    runs = []
    for path in sorted(folder.glob("*.bag")):
        if "21-04-09" in path.name:
            continue
        bag = read_bag(path)
        channels = {}
        for name in ("position", "velocity", "effort"):
            joints = [values for key, values in bag.items() if f".{name}[" in key]
            channels[name] = np.stack(joints, axis=1)
        runs.append(numbered(**channels))
    return Runs(runs)


def weigand_mats(folder: Path) -> Runs:
    """Read three runs of an industrial arm: angle and speed of the motors, and their torque."""
    runs = []
    for path in sorted(folder.glob("FF_*.mat")):
        loaded = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
        record = loaded["rec"]
        run = numbered(
            position=np.deg2rad(record.act_pos_mot_deg.T),
            velocity=np.deg2rad(record.act_vel_mot_deg_per_s.T),
            effort=record.act_torque_abs_nm.T,
        )
        runs.append(run)
    return Runs(runs)


def hiro_runs(folder: Path) -> Runs:
    """Read good and failed snap assemblies: angles, and force and torque at the wrist."""

    def runs(group: str) -> list[Columns]:
        return [hiro_run(path.parent) for path in sorted(folder.glob(f"{group}/*/R_Angles.dat"))]

    return Runs(runs("success"), {"failed": runs("error")})


def hiro_repetitions(folder: Path) -> Runs:
    """Read the good assemblies of one programme, runs 5 to 20, whose angles differ by less than 0.0003 rad."""
    runs = hiro_runs(folder)
    return Runs(runs.healthy[HIRO_REPEATED], runs.faulty)


def hiro_run(folder: Path) -> Columns:
    """Read one snap assembly."""
    angles = _numbers(folder / "R_Angles.dat")
    wrench = _numbers(folder / "R_Torques.dat")
    rows = slice(0, min(len(angles), len(wrench)), HIRO_EVERY)
    return numbered(position=angles[rows, 1:], force=wrench[rows, 1:4], torque=wrench[rows, 4:])


def _numbers(path: Path) -> NDArray[np.float64]:
    """Return the numbers (T, N) of a file without headings."""
    return pd.read_csv(path, sep=r"\s+", header=None).to_numpy(np.float64)


def armpi_runs(folder: Path) -> Runs:
    """Read runs of six bus servos; those with marked rows have a heated servo.

    Runs are cut where a reading is a glitch, and each glitch is a run of a few seconds. A run that its authors list as
    failing, and in which no row is marked, is left out.
    """
    runs = Runs([], {"heated": [], "glitch": []})
    for path in sorted(folder.glob("matlab_ros_2024/*")):
        if path.name == UNMARKED_FAILURE:
            continue
        motors = [pd.read_csv(path / f"data_motor_{n}.csv") for n in range(1, 7)]
        run = numbered(**{name: _side_by_side(motors, name) for name in SERVO_RANGES})
        is_heated = np.asarray(_side_by_side(motors, "label").any(axis=1))
        is_glitch = np.zeros(len(is_heated), bool)
        for name, (low, high) in SERVO_RANGES.items():
            reading = _side_by_side(motors, name)
            is_outside = (reading < low) | (reading > high)
            is_glitch |= np.asarray(is_outside.any(axis=1))
        window = np.ones(2 * GLITCH_ROWS + 1)
        is_near = np.convolve(is_glitch, window, "same") > 0

        runs.faulty["glitch"].extend(_parts({**run, "label": is_glitch}, is_near))
        if not is_heated.any():
            runs.healthy.extend(_parts(run, ~is_near))
            continue
        parts = _parts({**run, "label": is_heated}, ~is_near)
        runs.faulty["heated"].extend(part for part in parts if part["label"].any())
    return runs


def _parts(run: Columns, is_kept: NDArray[np.bool_]) -> list[Columns]:
    """Return each stretch of rows (T,) that are kept."""
    return [
        {name: values[start:stop] for name, values in run.items()} for start, stop in spans(is_kept)
    ]


def _side_by_side(motors: Iterable[pd.DataFrame], name: str) -> NDArray[np.float64]:
    return np.stack([motor[name].to_numpy(np.float64) for motor in motors], axis=1)


@cache
def synthetic_runs(_: Path) -> Runs:
    """Simulate episodes of the synthetic arm, each through poses of its own, with a load of its own."""
    episodes = collect(
        "asm_gym/SyntheticArm-v0", "scripted", episodes=SYNTHETIC_EPISODES, seed=0, workers=1
    )
    runs = []
    for episode in episodes:
        rows = episode.stream[::SYNTHETIC_EVERY]
        position, velocity, effort, command = np.split(rows, 4, axis=1)
        run = numbered(position=position, velocity=velocity, effort=effort, command=command)
        runs.append(run)
    return Runs(runs)


SECONDS = "unisa-acg/inverse-dynamics-solver @ 41e196de (BSD-3-Clause)"
ARMS = {
    "panda": RealArm(
        robot="Franka Panda",
        place="unisa_acg/panda_exciting_trajectory.db3",
        source=SECONDS,
        read=one_bag,
        piece_s=1.0,
        urdf="panda.urdf",
    ),
    "ur10": RealArm(
        robot="UR10",
        place="unisa_acg/ur10_exciting_trajectory.db3",
        source=SECONDS,
        read=one_bag,
        piece_s=1.0,
        urdf="ur10_robot.urdf",
    ),
    "weigand": RealArm(
        robot="6-axis industrial arm",
        place="weigand_10s",
        source="JonasWeigand/Robot_Identification @ 9e403c07 (MIT)",
        read=weigand_mats,
        piece_s=1.0,
        rate=250.0,
    ),
    "ur3": RealArm(
        robot="UR3",
        place="ur3_aspectum",
        source="aspectum/ur3-force-estimation @ 36685d83 (MIT)",
        read=ur3_bags,
        piece_s=4.0,
        rate=125.0,
        urdf="ur3_robot.urdf",
    ),
    "hiro": RealArm(
        robot="Kawada HIRO",
        place="hiro_snap_assembly",
        source="HongminWu/HIRO_SA_DATA @ 5773e085 (ODbL 1.0)",
        read=hiro_runs,
        piece_s=np.inf,
        rate=50.0,
        efforts=("force", "torque"),
        has_joint_torques=False,
        one_campaign=False,
    ),
    "armpi": RealArm(
        robot="ArmPi FPV",
        place="armpi_fpv_faults",
        source="sonic160/digital_twin_robot @ 7074bd5f (MIT)",
        read=armpi_runs,
        piece_s=30.0,
        rate=10.0,
        efforts=(),
        slip=SLIP_RAD * SERVO_UNITS / np.deg2rad(240),
        has_joint_torques=False,
    ),
    "synthetic": RealArm(
        robot="Synthetic arm",
        place="",
        source="simulated",
        read=synthetic_runs,
        piece_s=np.inf,
        rate=25.0,
    ),
}
"""Sets by name; the first three are of seconds, the others of minutes, and ``synthetic`` is simulated."""
ARMS["hiro_repeated"] = replace(
    ARMS["hiro"], robot="Kawada HIRO, one programme", read=hiro_repetitions
)
REAL = tuple(name for name in ARMS if ARMS[name].place)
