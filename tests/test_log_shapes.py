"""What logs look like: of other countries, other clocks, without a header, cut off, in three files, damaged."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from asm_gym.data.channels import read_recorded
from asm_gym.data.clock_column import clock_among, is_clock
from asm_gym.data.lerobot import write_lerobot
from asm_gym.data.logs import LogLayout, read_logs
from asm_gym.data.reader_notes import LogWarning
from asm_gym.data.row_times import period
from asm_gym.data.selection import normal_episodes
from asm_gym.data.text import read_table
from asm_gym.data.units import ratio
from asm_gym.episode import Episode

REAL = Path(os.environ.get("ASM_GYM_REAL", "/nowhere"))
"""A folder of recordings of real arms, which are published elsewhere."""

real = pytest.mark.skipif(not REAL.is_dir(), reason="ASM_GYM_REAL names no folder of recordings of real arms")


def read(path: Path, **layout: object) -> Episode:
    ((_, episode),) = read_logs(path, LogLayout(**layout))  # type: ignore[arg-type]
    return episode


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


# ------------------------------------------------------------------ clocks


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(("time", None), ("t", None), ("Timestamp", None), ("__time", None), ("%time", None), ("header.stamp", None)),
        *(("Timestamp (s)", 1.0), ("Time [sec]", 1.0), ("time_s", 1.0), ("TIME (ms)", 1e-3), ("timestamp_us", 1e-6)),
    ],
)
def test_a_clock_is_known_by_its_name_whatever_the_case(name, unit):
    found = clock_among(["q", name])
    assert found is not None
    assert (found.column, found.unit) == (name, unit)


@pytest.mark.parametrize("name", ["T", "temperature", "torque_t", "target", "timestep_error", "wrist.t", "timeout"])
def test_what_senses_something_is_no_clock(name):
    assert not is_clock(name)


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("Timestamp (s)", np.arange(40) * 0.02),
        ("Time [ms]", np.arange(40) * 20.0),
        ("timestamp", 1_666_772_241_847 + 20 * np.arange(40)),
        ("stamp", 1_666_772_241_847_000_000 + 20_000_000 * np.arange(40)),
        ("time", 1.6667e9 + 0.02 * np.arange(40)),
    ],
)
def test_clocks_of_every_unit_tell_the_rate_and_are_no_sense(name, times):
    episode = Episode.from_table({name: times, "q": np.sin(np.arange(40))})
    assert episode.spec.labels == ("q",)
    assert episode.spec.dt == pytest.approx(0.02, rel=1e-4)
    assert len(episode) == 40


def test_a_clock_that_may_count_anything_is_asked_for_its_unit():
    with pytest.raises(ValueError, match=r"'t' goes on by 50 from row to row, and says no unit: call it 't \[ms\]'"):
        Episode.from_table({"t": np.arange(0, 2000, 50), "q": np.zeros(40)})


def test_the_period_is_the_mean_step_and_gaps_and_lost_rows_are_none_of_it():
    rng = np.random.default_rng(0)
    steady = np.arange(5000) / 100.331
    assert 1 / period(steady) == pytest.approx(100.331, rel=1e-5)
    assert 1 / period(np.delete(steady, rng.choice(4998, 300, replace=False) + 1)) == pytest.approx(100.331, rel=1e-5)
    # Most steps are of 10 ms and some of 12 to 15: the mean is what a row takes.
    jittering = np.cumsum(np.where(rng.random(4000) < 0.7, 0.01, rng.uniform(0.012, 0.015, 4000)))
    assert np.median(np.diff(jittering)) == pytest.approx(0.01)
    assert period(jittering) == pytest.approx(np.diff(jittering).mean(), rel=1e-5)
    with_a_gap = np.concatenate([jittering, 60 + jittering])
    assert period(with_a_gap) == pytest.approx(np.diff(jittering).mean(), rel=1e-3)


def test_rows_that_were_written_twice_are_left_out_and_that_is_said():
    times = np.sort(np.concatenate([np.arange(200) * 0.02, [1.0]]))
    with pytest.warns(LogWarning, match="1 rows have the same time"):
        episode = Episode.from_table({"time": times, "q": times})
    assert len(episode) == 200


def test_a_log_at_another_rate_is_read_by_its_clock(tmp_path):
    def column(rate: float) -> dict[str, np.ndarray]:
        t = np.arange(int(10 * rate)) / rate
        return {"time": t, "q": np.sin(t)}

    spec = Episode.from_table(column(99)).spec
    with pytest.warns(LogWarning, match="rows that come at 125 a second are read at 99, by their clock"):
        episode = Episode.from_table(column(125), channels=spec)
    np.testing.assert_allclose(episode.stream[:, 0], np.sin(np.arange(len(episode)) / 99), atol=1e-4)
    with pytest.raises(ValueError, match="the memory reads 99 rows a second, these come at 30"):
        Episode.from_table(column(30), channels=spec)


# ------------------------------------------------------------------ text


COBOT = """Num;Timestamp;Current_J0;Temperature_T0;cycle ;Robot_ProtectiveStop;grip_lost;;;
1;2022-10-26T08:17:21.847Z;0,109627604;27,875;1;False;False;;;
2;2022-10-26T08:17:22.847Z;-7,39E-30;27,875;1;False;True;;;
3;2022-10-26T08:17:23.847Z;-2,5;;1;False;False;;;
4;2022-10-26T08:17:24.847Z;1;28;1;;False;;;
"""
"""As a UR3 of CobotOps writes it: semicolons, decimal commas, ISO times, trailing empty columns, labels in words."""


def test_semicolons_decimal_commas_iso_times_and_labels(tmp_path):
    episode = read(written(tmp_path / "x.csv", COBOT))
    assert episode.spec.labels == ("Current_J0", "Temperature_T0", "cycle")
    assert episode.spec.dt == 1.0
    np.testing.assert_allclose(episode.stream[:, 0], [0.109627604, 0, -2.5, 1], atol=1e-8)
    assert np.isnan(episode.stream[2, 1])
    np.testing.assert_array_equal(episode.faults, [False, True, False, False])
    kept = normal_episodes(read_logs(tmp_path / "x.csv"))
    assert kept.left_out == {"with a fault": 1}


def test_labels_are_asked_for_by_name_and_words_of_them_are_read(tmp_path):
    path = written(tmp_path / "x.csv", "time,q,state\n0,1,ok\n1,2,crash\n2,3,ok\n3,4,normal\n")
    assert not read(path).faults.any()
    np.testing.assert_array_equal(read(path, labels=["state"]).faults, [False, True, False, False])


def test_labels_keep_their_rows_where_rows_are_put_right():
    t = np.delete(np.arange(50) * 0.02, [10, 11])
    wrong = (t > 0.5).astype(int)
    found = read_recorded({"time": t, "q": t, "anomaly": wrong})
    assert found.spec.labels == ("q",)
    np.testing.assert_array_equal(found.faults, np.arange(50) * 0.02 > 0.5)


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("0 0.5 1\n0.1 0.6 2\n0.2 0.7 3\n", ["t", "a", "b"]),
        ("# t a b\n0 0.5 1\n0.1 0.6 2\n0.2 0.7 3\n", []),
        ("t\ta\tb\n0\t0.5\t1\n0.1\t0.6\t2\n0.2\t0.7\t3\n", []),
        ("0,0.5,1\n0.1,0.6,2\n0.2,0.7,3", ["t", "a", "b"]),
        ("t;- a;- b\n0;0,5;1\n0,1;0,6;2\n0,2;0,7;3\n", []),
    ],
)
def test_tables_with_and_without_a_header(text, columns, tmp_path):
    episode = read(written(tmp_path / "x.txt", text), columns=columns)
    np.testing.assert_allclose(episode.stream, [[0.5, 1], [0.6, 2], [0.7, 3]], rtol=1e-6)
    assert episode.spec.labels == ("a", "b")
    assert episode.spec.dt == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("0,1\n1,2\n", [], "its first line is of 2 numbers and no header: name its columns with --columns"),
        ("0,1\n1,2\n", ["t"], "1 columns are named, and its first line has 2 cells"),
        ("a,b\n1,2\n3,4,5\n", [], "line 3 has 3 cells, its header 2"),
        ("a,b\n1,2\n3\n", [], "line 3 has 1 cells, its header 2"),
        ("a,b\n1," + "9" * 1_000_000 + "\n", [], "no table of text: field larger than field limit"),
        (",".join(f"x{k}" for k in range(100_000)) + "\n", [], "it has 100000 columns, and at most 8192"),
        ("a,b\n" + "1" * 5_000_000, [], "a line of 4194304 characters or more is no row"),
    ],
)
def test_text_that_is_no_table_is_refused_soon_and_in_one_line(text, columns, message, tmp_path):
    path = written(tmp_path / "x.csv", text)
    start = time.perf_counter()
    with pytest.raises(ValueError, match=message) as refused:
        read(path, columns=columns, rate=10.0)
    assert time.perf_counter() - start < 5
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("end", ["1.5,2", "1.5,2.5,x", "1.5,"])
def test_a_last_row_that_was_cut_off_is_left_out_and_that_is_said(end, tmp_path):
    path = written(tmp_path / "x.csv", "time,a,b\n0,1,2\n1,1,2\n" + end)
    with pytest.warns(LogWarning, match="its last line was cut off, and is left out"):
        columns = read_table(path)
    np.testing.assert_array_equal(columns["time"], [0, 1])
    whole = written(tmp_path / "y.csv", "time,a,b\n0,1,2\n1,1,2\n2,1,2")  # many write no last end of line
    assert len(read_table(whole)["time"]) == 3


def test_json_lines_are_rows(tmp_path):
    rows = [{"t": 0.1 * k, "q": [k, -k], "tool": {"force": None if k == 3 else 2.0 * k}} for k in range(8)]
    path = written(tmp_path / "x.jsonl", "".join(json.dumps(row) + "\n" for row in rows) + '{"t": 0.8, "q"')
    with pytest.warns(LogWarning, match="cut off"):
        episode = read(path)
    assert episode.spec.labels == ("q[0]", "q[1]", "tool.force")
    np.testing.assert_array_equal(episode.stream[:, 1], -np.arange(8))
    assert np.flatnonzero(np.isnan(episode.stream[:, 2])).tolist() == [3]
    lists = written(tmp_path / "y.jsonl", "[0, 1]\n[1, 2]\n[2, 5]\n")
    np.testing.assert_array_equal(read(lists, columns=["t", "q"]).stream[:, 0], [1, 2, 5])
    with pytest.raises(ValueError, match=r"y\.jsonl: line 1 is no row: it is a list of 2, and 0 columns are named"):
        read(lists)
    with pytest.raises(ValueError, match=r"z\.jsonl: line 2 is no row"):
        read(written(tmp_path / "z.jsonl", '{"t": 0}\n{"t": \n{"t": 1}\n'))


# ------------------------------------------------------------------ several files


def test_three_files_of_one_recording_are_joined_by_their_clocks(tmp_path):
    t = np.arange(100) * 0.01
    for name, start in (("position", 0), ("velocity", 0), ("effort", 5)):
        values = np.sin(t[start:]) + len(name)
        lines = [f"{a},{b}" for a, b in zip(t[start:], values, strict=True)]
        written(tmp_path / f"arm_{name}.csv", "\n".join([f"t,- joint_{name}", *lines]) + "\n")
    episode = read(tmp_path, join=True)
    assert episode.spec.labels == ("joint_effort", "joint_position", "joint_velocity")
    assert len(episode) == 95
    np.testing.assert_allclose(episode.stream, np.add(np.sin(t[5:, None]), [6, 8, 8]), atol=1e-6)
    with pytest.raises(ValueError, match="channels that are not there: joint_effort; --join reads files as parts"):
        list(read_logs(tmp_path))


def test_files_without_a_clock_are_joined_row_by_row(tmp_path):
    for name in ("current", "position"):
        written(tmp_path / f"{name}.csv", "J_1,J_2\n1,2\n3,4\n")
    assert read(tmp_path, join=True, rate=10.0).spec.labels == (
        *("current.J[1]", "current.J[2]"),
        *("position.J[1]", "position.J[2]"),
    )
    written(tmp_path / "position.csv", "J_1,J_2\n1,2\n")
    with pytest.raises(ValueError, match="without a clock must be of one length, got current: 2, position: 1"):
        read(tmp_path, join=True, rate=10.0)
    with pytest.raises(ValueError, match="--join takes a folder of the files of one recording, got 0 in"):
        read(tmp_path / "position.csv", join=True)


# ------------------------------------------------------------------ damage


def test_a_damaged_header_of_an_array_is_one_line(tmp_path):
    path = tmp_path / "x.npy"
    np.save(path, np.zeros((20, 3), np.float32))
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    said = []
    for _ in range(300):
        raw = bytearray(whole)
        raw[rng.integers(0, 128)] ^= 1 << rng.integers(0, 8)
        path.write_bytes(bytes(raw))
        try:
            read(path, rate=10.0)
        except ValueError as error:
            said.append(str(error))
    assert len(said) > 100
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in said)


def test_a_lerobot_export_that_was_changed_is_refused(tmp_path):
    def columns(seed: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(seed)
        return {"q": rng.normal(size=(30, 2)), "action": rng.normal(size=(30, 2))}

    folder = write_lerobot(tmp_path / "set", [Episode.from_table(columns(k), rate=10) for k in range(2)], "reach")
    assert len(list(read_logs(folder))) == 2
    files = sorted(folder.rglob("*.parquet"))
    whole, rng = files[0].read_bytes(), np.random.default_rng(0)
    for _ in range(20):
        raw = bytearray(whole)
        raw[rng.integers(0, len(raw))] ^= 1 << rng.integers(0, 8)
        files[0].write_bytes(bytes(raw))
        with pytest.raises(ValueError, match=r"episode_000000\.parquet is not as it was written"):
            list(read_logs(folder))


def test_units_say_the_same_thing_or_do_not():
    assert ratio("deg", "rad") == pytest.approx(np.pi / 180)
    assert ratio("mA", "A") == pytest.approx(1e-3)
    assert ratio("A", "rad") is None
    assert ratio("furlong", "furlong") == 1.0


# ------------------------------------------------------------------ real arms


@real
@pytest.mark.parametrize(
    ("place", "layout", "rate", "shape", "faults"),
    [
        ("ur3_cobotops/dataset_02052023.csv", {}, 0.9949, (26188, 20), 518),
        ("tiago_figaroh", {"join": True}, 99.999, (8022, 24), 0),
        ("staubli_tx40_figaroh", {"join": True, "rate": 5000.0}, 5000.0, (45000, 12), 0),
        ("unisa_acg/panda_exciting_trajectory.db3", {}, 29.9999, (727, 21), 0),
        ("unisa_acg/ur10_exciting_trajectory.db3", {}, 125.0, (3441, 18), 0),
    ],
)
def test_recordings_of_real_arms_are_read(place, layout, rate, shape, faults):
    if not (REAL / place).exists():
        pytest.skip(f"{place} is not there")
    episode = read(REAL / place, **layout)
    assert episode.stream.shape == shape
    assert 1 / episode.spec.dt == pytest.approx(rate, rel=1e-4)
    assert episode.faults.sum() == faults
    assert not any(is_clock(label) for label in episode.spec.labels)
