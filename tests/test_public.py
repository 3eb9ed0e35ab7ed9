"""Public recordings of real robots: read by their official splits, from synthetic files of their schema, and judged."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sklearn.model_selection import train_test_split

from asm_gym.data.public import AURSAD_META, VORAUS_META, read_public
from asm_gym.scripts.cli import main

ROWS = 40
AXIS = (
    *("target_position", "target_velocity", "target_acceleration", "target_torque", "computed_inertia"),
    *("computed_torque", "motor_position", "motor_velocity", "joint_position", "joint_velocity", "motor_torque"),
    *("torque_sensor_a", "torque_sensor_b", "motor_iq", "motor_id", "power_motor_el", "power_motor_mech"),
    *("power_load_mech", "motor_voltage", "supply_voltage", "brake_voltage"),
)
ROBOT = ("robot_voltage", "robot_current", "io_current", "system_current")
VORAUS = (*ROBOT, *(f"{name}_{k}" for k in range(1, 7) for name in AXIS))
NORMAL, COLLISION, WOBBLING = 12, 2, 11


def signals(names: tuple[str, ...], seed: int, broken: bool) -> dict[str, np.ndarray]:
    """(ROWS,) each: senses follow the targets; in a broken episode some are 0 at its end while targets shift."""
    rng = np.random.default_rng(seed)
    t, phase = 0.01 * np.arange(ROWS), rng.uniform(0, 6)
    made = {}
    for n, name in enumerate(names):
        noise = 0.0 if name.startswith("target") else 0.01
        made[name] = np.sin((5 + n % 6) * t + phase) + noise * rng.normal(size=ROWS)
        if broken and not noise and n % 6 == 2:
            made[name][ROWS // 2 :] += 2.0
        if broken and noise and n % 6 == 2:
            made[name][ROWS // 2 :] = 0.0
    return made


def voraus(path: Path, samples: list[tuple[int, int, bool]], rate: float = 100.0) -> Path:
    """Of (category, setting, broken) each, as their file lays them out."""
    parts: dict[str, list[np.ndarray]] = {}
    for n, (category, setting, broken) in enumerate(samples):
        about = {"sample": n, "category": category, "setting": setting, "action": 3, "active": True}
        columns = {name: np.full(ROWS, value) for name, value in about.items()}
        columns |= {"time": np.arange(ROWS) / rate, "anomaly": np.full(ROWS, category != NORMAL)}
        for name, values in (columns | signals(VORAUS, n, broken)).items():
            parts.setdefault(name, []).append(values)
    pq.write_table(pa.table({name: np.concatenate(p) for name, p in parts.items()}), path, row_group_size=70)
    return path


def everything() -> list[tuple[int, int, bool]]:
    """Learned from, tested on, a kind that shows, and one that does not."""
    return [
        *[(NORMAL, 72, False)] * 30,
        *[(NORMAL, 74, False)] * 6,
        *[(COLLISION, 32, True)] * 4,
        *[(WOBBLING, 69, False)] * 6,
    ]


def test_voraus_is_read_by_its_official_split_and_nothing_that_says_what_is_wrong_is_a_signal(tmp_path):
    read = list(read_public(voraus(tmp_path / "v.parquet", everything())))
    assert [one.learned for one in read] == [True] * 30 + [False] * 16
    assert [one.kind for one in read][30:] == [*[""] * 6, *["collision foam"] * 4, *["wobbling station"] * 6]
    spec = read[0].episode.spec
    assert spec.size == len(VORAUS) == 130
    assert spec.dt == 0.01
    assert not set(VORAUS_META) & {c.name for c in spec.channels}
    assert {spec.labels[i].split("[")[0] for i in spec.motor} == {name for name in AXIS if name.startswith("target")}
    order = [spec.labels.index(f"joint_position[{k}]") for k in range(1, 7)]
    wanted = np.stack([signals(VORAUS, 33, False)[f"joint_position_{k}"] for k in range(1, 7)], axis=1)
    np.testing.assert_allclose(read[33].episode.stream[:, order], wanted, rtol=1e-6)


def test_the_file_of_500_hz_is_known_by_its_time_and_rows_can_be_skipped(tmp_path):
    path = voraus(tmp_path / "v.parquet", everything()[:2], 500.0)
    assert next(read_public(path)).episode.spec.dt == 0.002
    episode = next(read_public(path, every=5)).episode
    assert (len(episode), episode.spec.dt) == (ROWS // 5, 0.01)
    odd = voraus(tmp_path / "odd.parquet", everything()[:2], 33.0)
    with pytest.raises(ValueError, match=r"how many rows come a second\?.*give --rate"):
        next(read_public(odd))
    assert next(read_public(odd, 50.0)).episode.spec.dt == 0.02


JOINTS = (
    *("target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd"),
    *("actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force"),
    *("target_TCP_pose", "target_TCP_speed", "joint_temperatures", "joint_mode", "actual_joint_voltage"),
)
AURSAD = (
    *(f"{name}_{k}" for name in JOINTS for k in range(6)),
    *(f"{name}_{k}" for name in ("actual_tool_accelerometer", "elbow_position", "elbow_velocity") for k in range(3)),
    *(f"output_double_register_{k}" for k in (24, 25, 26, 27)),
    *("actual_execution_time", "robot_mode", "safety_mode", "speed_scaling", "target_speed_fraction"),
    *("actual_momentum", "actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "runtime_state"),
)


def aursad(path: Path, labels: list[int]) -> Path:
    """A frame of pandas in its format "fixed", a sample each."""
    numbers: dict[str, list[np.ndarray]] = {}
    for n, label in enumerate(labels):
        columns = signals(AURSAD, n, label in (1, 2))
        columns |= {name: np.full(ROWS, label) for name in AURSAD_META}  # each of them would give the label away
        columns |= {"sample_nr": np.full(ROWS, n + 1), "timestamp": np.arange(ROWS) * 0.01}
        for name, values in columns.items():
            numbers.setdefault(name, []).append(values)
    whole = {name: np.concatenate(parts) for name, parts in numbers.items()}
    ints = ("label", "sample_nr", "output_int_register_25", "output_int_register_26")
    blocks = {
        0: {n: v for n, v in whole.items() if n not in ints and "bit" not in n},
        1: {n: whole[n].astype(np.int64) for n in ints},
        2: {n: v > 0 for n, v in whole.items() if "bit" in n},
    }
    with h5py.File(path, "w") as file:
        frame = file.create_group("complete_data")
        frame["axis0"] = np.array(list(whole), "S")
        frame["axis1"] = np.arange(len(labels) * ROWS)
        for k, block in blocks.items():
            frame[f"block{k}_items"] = np.array(list(block), "S")
            frame[f"block{k}_values"] = np.stack(list(block.values()), axis=1)
    return path


LABELS = [*[0] * 40, *[1] * 10, *[2] * 10, *[3] * 10, *[4] * 3, *[5] * 20]


def test_aursad_is_split_as_its_package_does_and_125_columns_are_signals(tmp_path):
    read = list(read_public(aursad(tmp_path / "AURSAD.h5", LABELS)))
    assert read[0].episode.spec.size == len(AURSAD) == 125
    assert not set(AURSAD_META) & {c.name for c in read[0].episode.spec.channels}
    kept = [n for n, label in enumerate(LABELS) if label != 4]
    labels = [LABELS[n] for n in kept]
    ours, theirs = train_test_split(kept, train_size=0.7, random_state=42, stratify=labels)
    assert sum(one.learned for one in read) == sum(LABELS[n] == 0 for n in ours)
    kinds = ("", "damaged screw", "extra assembly component", "missing screw")
    tested = [kinds[LABELS[n]] for n in sorted(theirs) if LABELS[n] < 4]
    assert [one.kind for one in read if not one.learned] == tested
    assert not any(one.kind for one in read if one.learned)
    assert read[0].episode.spec.dt == 0.01


def table_of(said: str) -> dict[str, list[str]]:
    """The cells of each row by its first one."""
    rows = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in said.splitlines() if "│" in line]
    return {row[0]: row[1:] for row in rows}


def out(folder: Path) -> list[str]:
    return ["--out", str(folder / "out")]


HOW = ["--monitors", "window_pca+evidence", "--false-alarm-rate", "0.2", "--calibration-share", "0.5"]


def test_a_kind_that_shows_is_told_from_normal_and_one_that_does_not_is_not(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["reproduce", "public", str(voraus(tmp_path / "v.parquet", everything())), *HOW, *out(tmp_path)]) == 0
    rows = table_of(capsys.readouterr().out)
    assert rows["collision foam"] == ["4", "1.000 / 100 %"]
    hidden = float(rows["wobbling station"][1].split(" / ")[0])
    assert 0.1 < hidden < 0.9
    assert float(rows["mean over kinds"][1]) == pytest.approx((1 + hidden) / 2, abs=1e-3)
    assert rows["normal"][0] == "6"
    assert main(["reproduce", "public", str(aursad(tmp_path / "AURSAD.h5", LABELS)), *HOW, *out(tmp_path)]) == 0
    rows = table_of(capsys.readouterr().out)
    assert rows["damaged screw"] == ["3", "1.000 / 100 %"]
    assert float(rows["missing screw"][1].split(" / ")[0]) < 1.0


def lacking(path: Path) -> Path:
    table = pq.read_table(voraus(path, everything()[:2])).drop_columns(["category"])
    pq.write_table(table, path)
    return path


def scattered(path: Path) -> Path:
    table = pq.read_table(voraus(path, everything()[:3]))
    order = np.concatenate([np.arange(20), np.arange(40, 80), np.arange(20, 40)])
    pq.write_table(table.take(order), path)
    return path


def cut(path: Path) -> Path:
    whole = (voraus if path.suffix == ".parquet" else aursad)(
        path, everything()[:3] if path.suffix == ".parquet" else LABELS
    )
    path.write_bytes(whole.read_bytes()[:5000])
    return path


@pytest.mark.parametrize(
    ("make", "name", "message"),
    [
        (lacking, "v.parquet", "lacks the columns category"),
        (scattered, "v.parquet", "the rows of sample 0 stand in two places"),
        (cut, "v.parquet", "v.parquet is damaged"),
        (cut, "AURSAD.h5", "AURSAD.h5 is damaged"),
        (lambda path: voraus(path, [(13, 72, False)]), "v.parquet", "category must be 0 to 12, got 13"),
        (lambda path: voraus(path, everything()[36:]), "v.parquet", "holds no normal episode to learn from"),
        (lambda path: aursad(path, [0, 0, 1, 2]), "AURSAD.h5", "too few samples to split"),
        (lambda path: path, "v.csv", "voraus-AD, which ends in .parquet, and AURSAD"),
        (lambda path: path, "none.parquet", "none.parquet"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_is_refused_in_a_line(make, name, message, tmp_path, capsys):
    assert main(["reproduce", "public", str(make(tmp_path / name)), *HOW, *out(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.strip().splitlines()) == 1
