"""Logs of every format and shape: which channels, rate and rows are read, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from asm_gym.data.clock_inference import clocks_among
from asm_gym.data.column_names import is_command
from asm_gym.data.episode import Episode, EpisodeLabel, save_episode
from asm_gym.data.logs import FILES, read_logs
from asm_gym.data.reader_notes import LogWarning, noted
from asm_gym.data.schema_inference import SchemaHints
from asm_gym.data.text_files import read_text
from asm_gym.data.timing import evenly, period
from asm_gym.data.training_selection import normal_episodes
from asm_gym.readings import noise_of, resolution
from asm_gym.spec import MOTOR
from tests.needs import needs
from tests.streams import arm_table as log

RATE, ROWS = 50.0, 80
pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")


def read(path: Path, **layout: Any) -> Episode:
    ((_, episode),) = read_logs(path, SchemaHints(**layout))
    return episode


def written(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_text(text, encoding=encoding)
    return path


# ------------------------------------------------------------------ tables


def test_columns_become_channels_by_name():
    episode = Episode.from_table(log(0), action=["cmd*"])
    rows, spec = episode.stream, episode.spec
    assert spec.labels == ("q[0]", "q[1]", "torque", "cmd[0]", "cmd[1]")
    assert spec.dt == pytest.approx(1 / RATE)
    assert [c.group for c in spec.channels] == ["q", "torque", MOTOR]
    np.testing.assert_allclose(rows[:, 2], log(0)["torque"], rtol=1e-6)
    np.testing.assert_allclose(rows[:, 4], log(0)["cmd_1"], rtol=1e-6)


@pytest.mark.parametrize(
    "frame", [pd.DataFrame, pa.table, lambda columns: needs("polars").DataFrame(columns)]
)
def test_a_frame_an_arrow_table_and_a_dictionary_say_the_same(frame):
    made, wanted = Episode.from_table(frame(log(3))), Episode.from_table(log(3))
    assert made.spec == wanted.spec
    np.testing.assert_array_equal(made.stream, wanted.stream)


def test_a_memory_reads_its_channels_whatever_else_there_is_and_in_whatever_order():
    episode = Episode.from_table(log(0), action=["cmd*"])
    shuffled = dict(sorted(log(0).items(), reverse=True)) | {
        "more": np.zeros(ROWS),
        "note": np.array(["x"] * ROWS),
    }
    np.testing.assert_array_equal(
        Episode.from_table(shuffled, channels=episode.spec).stream, episode.stream
    )


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (
            {"time": np.arange(ROWS)[::-1] / RATE},
            {},
            "time must increase from row to row, got 1.58 s before 1.56 s",
        ),
        ({"time": None}, {}, "how many rows come a second"),
        ({"torque": np.zeros(3)}, {}, "one length, got .*torque: 3"),
        (
            {},
            {"action": ["motor*"]},
            r"no column of these channels is called 'motor\*'; there are: q_0",
        ),
        ({}, {"channels": ["effort"]}, "no column of these channels is called 'effort'"),
        ({}, {"action": ["cmd_0"]}, "channel 'cmd' is commanded in part: cmd_0, cmd_1"),
        ({}, {"rate": 0.0}, "rate must be a number of at least 1e-06, got 0.0"),
        ({}, {"action": ["*"]}, "at least one channel that is not an action"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused(change, arguments, message):
    columns = {name: values for name, values in {**log(0), **change}.items() if values is not None}
    with pytest.raises(ValueError, match=message):
        Episode.from_table(columns, **arguments)


def test_commands_go_by_their_names():
    assert all(map(is_command, ("target_q_0", "Desired Torque", "cmd", "motor_reference_3")))
    assert not any(map(is_command, ("actual_q", "preference", "distance_to_goalkeeper")))


def test_a_memory_says_what_a_log_lacks():
    spec = Episode.from_table(log(0)).spec
    lacking = {name: values for name, values in log(0).items() if name != "q_1"}
    with pytest.raises(ValueError, match=r"channels that are not there: q\[1\]"):
        Episode.from_table(lacking, channels=spec)
    with pytest.raises(ValueError, match="reads 50 rows a second, these come at 100"):
        Episode.from_table(log(0), channels=spec, rate=100)


def test_units_stand_behind_names_and_must_be_those_of_the_memory():
    q = np.stack([log(0)["q_0"], log(0)["q_1"]])
    columns = {"time [s]": log(0)["time"], "q_0 [rad]": q[0], "q_1 [rad]": q[1]}
    episode = Episode.from_table(columns)
    assert [(c.name, c.size, c.unit) for c in episode.spec.channels] == [("q", 2, "rad")]
    in_degrees = {
        n.replace("rad", "deg"): np.rad2deg(v) if "rad" in n else v for n, v in columns.items()
    }
    np.testing.assert_allclose(
        Episode.from_table(in_degrees, episode.spec).stream, episode.stream, rtol=1e-6
    )
    in_volts = {name.replace("rad", "V"): values for name, values in columns.items()}
    with pytest.raises(ValueError, match="q_0 is in V, and the memory reads rad"):
        Episode.from_table(in_volts, channels=episode.spec)
    with pytest.raises(ValueError, match="'q' is of several units: deg, rad"):
        Episode.from_table({**columns, "q_2 [deg]": 2 * q[0]})
    with pytest.raises(ValueError, match="'q_0' twice"):
        Episode.from_table({**columns, "q_0": 2 * q[0]})


def test_the_noise_and_the_step_of_a_sense_are_found():
    t, rng = np.linspace(0, 20, 4000), np.random.default_rng(0)
    assert noise_of(np.sin(t) + 0.01 * rng.normal(size=t.size)) == pytest.approx(0.01, rel=0.1)
    assert noise_of(np.zeros(100)) == 0.0
    spec = Episode.from_table(log(0, 2000), action=["cmd*"]).spec
    assert spec.channels[0].noise == pytest.approx(0.01, rel=0.15)
    assert spec.channels[2].noise == 0.0
    for step in (0.001, 0.0625, 1.0):
        smooth = np.sin(np.arange(5000) / 200) * 20 * step + rng.normal(0, step, 5000)
        for kind in (np.float64, np.float32):
            assert resolution((np.round(smooth / step) * step).astype(kind)) == pytest.approx(
                step, rel=0.02
            )
        assert resolution(smooth) == 0.0


# ------------------------------------------------------------------ clocks


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(
            ("time", None),
            ("t", None),
            ("Timestamp", None),
            ("__time", None),
            ("%time", None),
            ("header.stamp", None),
        ),
        *(
            ("Timestamp (s)", 1.0),
            ("Time [sec]", 1.0),
            ("time_s", 1.0),
            ("TIME (ms)", 1e-3),
            ("timestamp_us", 1e-6),
        ),
    ],
)
def test_a_clock_is_known_by_its_name_whatever_the_case(name, unit):
    assert not clocks_among(
        ["T", "temperature", "torque_t", "target", "timestep_error", "wrist.t", "timeout"]
    )
    (found,) = clocks_among(["q", name])
    assert found == ((name,), (unit,))


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


@pytest.mark.parametrize(
    "how", ["%m/%d/%Y %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S.%f", "%d.%m.%y %H:%M:%S.%f"]
)
@pytest.mark.parametrize(
    "date", ["2026-11-05 23:59:59", "2026-11-24 10:00:00", "2026-12-31 23:59:59"]
)
def test_dates_that_begin_with_the_day_or_the_month_are_read_over_midnight(date, how):
    moments = pd.to_datetime(date) + pd.to_timedelta(np.arange(200) / 100, unit="s")
    episode = Episode.from_table(
        {"time": moments.strftime(how).to_numpy(object), "q": np.sin(np.arange(200) / 30)}
    )
    assert (len(episode), episode.spec.dt) == (200, pytest.approx(0.01))


def test_a_clock_without_a_unit_is_read_by_plausible_rates_by_the_memory_and_by_velocities_and_that_is_said():
    t = np.arange(0, 2000, 50)
    with pytest.warns(
        LogWarning, match="'t' goes on by 50 from row to row and says no unit: read in ms"
    ):
        episode = Episode.from_table({"t": t, "q": np.sin(t)})
    assert episode.spec.dt == pytest.approx(0.05)
    fast = {"t": np.arange(400), "q": np.sin(0.02 * np.arange(400))}
    spec = Episode.from_table(fast, rate=1000.0).spec
    with pytest.warns(LogWarning, match="read in ms"):
        assert Episode.from_table(fast, spec).spec.dt == pytest.approx(1e-3)
    moving = {
        "t": np.arange(400),
        "q_0": np.sin(0.02 * np.arange(400)),
        "v_0": 20 * np.cos(0.02 * np.arange(400)),
    }
    with pytest.warns(LogWarning, match="read in ms"):
        assert Episode.from_table(moving).spec.dt == pytest.approx(1e-3)
    assert Episode.from_table({"t": t, "q": np.sin(t)}, clock="t [s]").spec.dt == 50


@pytest.mark.parametrize(
    ("name", "unit"), [("time [min]", 60.0), ("time [h]", 3600.0), ("t", 86400.0)]
)
def test_clocks_in_minutes_hours_and_days_tell_the_rate(name, unit):
    start = 45_000.5 if name == "t" else 0.0  # a date of Excel
    table = {name: start + np.arange(ROWS) / RATE / unit, "q": log(0)["q_0"]}
    assert Episode.from_table(table, clock=name).spec.dt == pytest.approx(1 / RATE, rel=1e-3)
    assert Episode.from_table(table).spec.dt == pytest.approx(1 / RATE, rel=1e-3)
    with pytest.raises(ValueError, match="a clock counts in one of"):
        Episode.from_table(table, clock=f"{name.split()[0]} [week]")


def test_the_period_is_the_mean_step_and_gaps_and_lost_rows_are_none_of_it():
    rng = np.random.default_rng(0)
    steady = np.arange(5000) / 100.331
    assert 1 / period(steady) == pytest.approx(100.331, rel=1e-5)
    assert 1 / period(np.delete(steady, rng.choice(4998, 300, replace=False) + 1)) == pytest.approx(
        100.331, rel=1e-5
    )
    # Most steps are of 10 ms and some of 12 to 15: the mean is what a row takes.
    jittering = np.cumsum(np.where(rng.random(4000) < 0.7, 0.01, rng.uniform(0.012, 0.015, 4000)))
    assert np.median(np.diff(jittering)) == pytest.approx(0.01)
    assert period(jittering) == pytest.approx(np.diff(jittering).mean(), rel=1e-5)
    with_a_gap = np.concatenate([jittering, 60 + jittering])
    assert period(with_a_gap) == pytest.approx(np.diff(jittering).mean(), rel=1e-3)


def test_rows_that_were_lost_are_marked_and_the_others_keep_their_place_and_values():
    kept = np.delete(np.arange(50), [10, 11, 30])
    out = evenly(np.stack([kept, -kept], axis=1).astype(float), kept * 0.02, 0.02)
    assert len(out) == 50
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out[:, 0])), [10, 11, 30])
    np.testing.assert_array_equal(out[kept], np.stack([kept, -kept], axis=1))


def test_rows_at_odd_times_are_interpolated_and_gaps_are_not():
    rng = np.random.default_rng(1)
    t = np.sort(np.concatenate([[0.0], rng.uniform(0, 1, 120), rng.uniform(2, 3, 120), [3.0]]))
    out = evenly(3.0 * t[:, None], t, float(np.median(np.diff(t))))[:, 0]
    due = np.arange(len(out)) * np.median(np.diff(t))
    known = np.isfinite(out)
    np.testing.assert_allclose(out[known], 3.0 * due[known], atol=1e-9)
    assert not known[(due > 1.1) & (due < 1.9)].any()
    assert known[(due < 0.9)].mean() > 0.8


def test_time_that_jumps_or_runs_backwards_is_refused():
    t = np.concatenate([np.arange(50) * 0.02, 1e9 + np.arange(50) * 0.02])
    with pytest.raises(ValueError, match=r"time jumps by 1e\+09 s after 0.98 s: cut the log there"):
        Episode.from_table({"time": t, "x": t})
    with pytest.raises(ValueError, match="time must be a number in every row, got nan in row 3"):
        Episode.from_table(
            {"time": np.where(np.arange(9) == 3, np.nan, np.arange(9)), "x": np.arange(9.0)}
        )


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
    with pytest.warns(
        LogWarning, match="rows that come at 125 a second are read at 99, by their clock"
    ):
        episode = Episode.from_table(column(125), channels=spec)
    np.testing.assert_allclose(
        episode.stream[:, 0], np.sin(np.arange(len(episode)) / 99), atol=1e-4
    )
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
    assert episode.spec.labels == ("Current_J0", "Temperature_T0")  # cycle never moves
    assert episode.spec.dt == 1.0
    np.testing.assert_allclose(episode.stream[:, 0], [0.109627604, 0, -2.5, 1], atol=1e-8)
    assert np.isnan(episode.stream[2, 1])
    np.testing.assert_array_equal(episode.faults, [False, True, False, False])
    with noted():
        _, left_out = normal_episodes(read_logs(tmp_path / "x.csv"))
    assert left_out == {"with a fault": 1}


def test_labels_are_asked_for_by_name_and_words_of_them_are_read(tmp_path):
    path = written(tmp_path / "x.csv", "time,q,state\n0,1,ok\n1,2,crash\n2,3,ok\n3,4,normal\n")
    assert not read(path).faults.any()
    np.testing.assert_array_equal(read(path, labels=["state"]).faults, [False, True, False, False])


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
        ("", [], "a header and at least one row, got 0 lines"),
        ("a,b\n", [], "a header and at least one row, got 1 lines"),
        (
            "a,a\n1,2\n",
            [],
            "a #2 differs from another column of the name 'a'; --ignore 'a #2' leaves it out",
        ),
        (
            "a,b\n1,2\n3,oops\n4,5\n",
            [],
            "b must hold numbers, got 'oops' in row 2; --ignore 'b' leaves it out",
        ),
        ("a,b\n1,2\n3,4,5\n", [], "line 3 has 3 cells, its header 2"),
        ("a,b\n1,2\n3\n", [], "line 3 has 1 cells, its header 2"),
        (
            "0,1\n1,2\n",
            [],
            "its first line is of 2 numbers and no header: name its 2 columns, --columns x0 x1",
        ),
        ("0,1\n1,2\n", ["t"], "1 columns are named, and its first line has 2 cells"),
        (
            "a,b\n1," + "9" * 1_000_000 + "\n",
            [],
            "line 2 has 1000002 characters: at most 8192 columns",
        ),
        (
            ",".join(f"x{k}" for k in range(10_000)) + "\n",
            [],
            "it has 10000 columns, and at most 8192",
        ),
        ("a,b\n1,2\n2,3\nb,a\n4,5\n", [], "line 4 is another header"),
    ],
)
def test_text_that_is_no_table_is_refused_in_one_line(text, columns, message, tmp_path):
    path = written(tmp_path / "x.csv", text)
    with pytest.raises(ValueError, match=message) as refused:
        read(path, columns=columns, rate=10.0)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("end", ["1.5,2", "1.5,2.5,x", "1.5,"])
def test_a_last_row_that_was_cut_off_is_left_out_and_that_is_said(end, tmp_path):
    path = written(tmp_path / "x.csv", "time,a,b\n0,1,2\n1,1,2\n" + end)
    with pytest.warns(LogWarning, match="its last line was cut off, and is left out"):
        columns = read_text(path)
    np.testing.assert_array_equal(columns["time"], [0, 1])
    # many write no last end of line
    whole = written(tmp_path / "y.csv", "time,a,b\n0,1,2\n1,1,2\n2,1,2")
    assert len(read_text(whole)["time"]) == 3


@pytest.mark.parametrize(
    ("encoding", "end"), [("utf-8", b"\x00" * 900), ("utf-16", b"3"), ("utf-16", b"\x00" * 900)]
)
def test_what_a_loss_of_power_leaves_at_the_end_costs_no_row(encoding, end, tmp_path):
    rows = "".join(f"{k},{k * k}\n" for k in range(60))
    (tmp_path / "x.csv").write_bytes(("time,a\n" + rows).encode(encoding) + end)
    with pytest.warns(LogWarning):
        np.testing.assert_array_equal(read_text(tmp_path / "x.csv")["a"], np.arange(60) ** 2)


def test_too_many_columns_are_refused_in_every_format(tmp_path):
    wide = np.zeros((3, 10_000))
    np.save(tmp_path / "x.npy", wide)
    np.savez(tmp_path / "x.npz", t=np.arange(3), q=wide)
    for name in ("x.npy", "x.npz"):
        with pytest.raises(ValueError, match=rf"{name}: it has 1000\d columns, and at most"):
            read(tmp_path / name, rate=10.0)


def test_mixed_encodings_notes_between_rows_and_marks_for_nothing_are_read(tmp_path):
    head, rows = (
        "time,temperature [°C],q\n".encode(),
        b"0,20,1\n0.1,-,2\n# at 21 \xb0C\n0.2,22,4\n0.3,23,3\n",
    )
    (tmp_path / "x.csv").write_bytes(head + rows)
    with noted() as notes:
        episode = read(tmp_path / "x.csv")
    assert [c.unit for c in episode.spec.channels] == ["°C", "1"]
    np.testing.assert_array_equal(episode.stream[:, 0], [20, np.nan, 22, 23])
    assert len(notes) == 2


def test_json_lines_are_rows(tmp_path):
    rows = [
        {"t": 0.1 * k, "q": [k, -k], "tool": {"force": None if k == 3 else 2.0 * k}}
        for k in range(8)
    ]
    path = written(
        tmp_path / "x.jsonl", "".join(json.dumps(row) + "\n" for row in rows) + '{"t": 0.8, "q"'
    )
    with pytest.warns(LogWarning, match="cut off"):
        episode = read(path)
    assert episode.spec.labels == ("q[0]", "q[1]", "tool.force")
    np.testing.assert_array_equal(episode.stream[:, 1], -np.arange(8))
    assert np.flatnonzero(np.isnan(episode.stream[:, 2])).tolist() == [3]
    lists = written(tmp_path / "y.jsonl", "[0, 1]\n[1, 2]\n[2, 5]\n")
    np.testing.assert_array_equal(read(lists, columns=["t", "q"]).stream[:, 0], [1, 2, 5])
    with pytest.raises(
        ValueError, match=r"y\.jsonl: line 1 is no row: it is a list of 2, and 0 columns are named"
    ):
        read(lists)
    with pytest.raises(ValueError, match=r"z\.jsonl: line 2 is no row"):
        read(written(tmp_path / "z.jsonl", '{"t": 0}\n{"t": \n{"t": 1}\n'))


# ------------------------------------------------------------------ files and folders


def test_a_run_folder_a_file_and_arrays_are_read(tmp_path):
    episode = Episode.from_table(
        log(0), success=True, label=EpisodeLabel("Lift", "fit", seed=3), seed=3
    )
    save_episode(tmp_path / "run" / episode.labelled.path, episode)
    save_episode(tmp_path / "run" / "episodes" / ".half.npz", episode)  # unfinished
    ((name, read),) = read_logs(tmp_path / "run")
    assert name == "Lift/fit/3.npz"
    np.testing.assert_array_equal(read.stream, episode.stream)
    np.savez(tmp_path / "raw.npz", **log(0))
    ((name, read),) = read_logs(tmp_path / "raw.npz", SchemaHints(action=()))
    assert name == "raw.npz"
    np.testing.assert_array_equal(read.stream, episode.stream)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda p: None, FileNotFoundError, "does not exist"),
        (
            lambda p: p.mkdir(),
            FileNotFoundError,
            "no episodes: no .npz, .npy, .parquet.*no LeRobot or Minari",
        ),
        (
            lambda p: p.write_bytes(b"PK"),
            ValueError,
            "files that can be read end in .npz, .npy, .parquet",
        ),
    ],
)
def test_what_holds_no_log_is_refused(make, error, message, tmp_path):
    make(tmp_path / "thing")
    with pytest.raises(error, match=message):
        list(read_logs(tmp_path / "thing"))


def test_every_format_of_a_table_gives_the_same_rows(tmp_path):
    columns = log(0)
    wanted = Episode.from_table(columns, action=["cmd*"])
    arrays = {"time": columns["time"]} | {
        n: np.stack([columns[f"{n}_{k}"] for k in (0, 1)], 1) for n in ("q", "cmd")
    }
    arrays["torque"] = columns["torque"]
    pd.DataFrame(columns).to_csv(tmp_path / "a.csv", index=False)
    pq.write_table(pa.table(columns), tmp_path / "b.parquet")
    pq.write_table(
        pa.table({n: pa.array(v.tolist()) for n, v in arrays.items()}), tmp_path / "c.parquet"
    )
    np.savez(tmp_path / "d.npz", **arrays)
    pd.DataFrame(columns).to_json(
        tmp_path / "f.jsonl", orient="records", lines=True, double_precision=15
    )
    found = {name: episode for name, episode in read_logs(tmp_path, SchemaHints(action=["cmd*"]))}
    assert list(found) == ["a.csv", "b.parquet", "c.parquet", "d.npz", "f.jsonl"]
    for episode in found.values():
        np.testing.assert_allclose(episode.stream, wanted.stream, rtol=1e-6)
        assert episode.spec.labels == wanted.spec.labels
    np.save(tmp_path / "bare.npy", wanted.stream)
    np.testing.assert_array_equal(read(tmp_path / "bare.npy", rate=RATE).stream, wanted.stream)


# ------------------------------------------------------------------ damage


@pytest.mark.parametrize(
    "content", [b"", b"\x00\xff no file of this kind \x00", b"version https://git-lfs.github.com"]
)
@pytest.mark.parametrize("suffix", FILES)
def test_a_file_of_any_kind_that_is_none_is_named(suffix, content, tmp_path):
    (tmp_path / f"no{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=rf"no\{suffix}: ."):
        read(tmp_path / f"no{suffix}")
