"""What a column is: told by its behaviour, said with the option that overrides it, and read so everywhere."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pandas as pd
import pytest

from asm_gym.data.column_behaviour import (
    counts,
    is_second_clock,
    missing_value_sentinel,
    wrap_period,
)
from asm_gym.data.column_match import ColumnMatch
from asm_gym.data.episode import Episode
from asm_gym.data.live_rows import RowReader
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import LogWarning, noted
from asm_gym.data.schema import LogSchema
from asm_gym.evaluation.recorded_alarms import alarms_of, sensed_peak
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.scripts.cli import main
from asm_gym.spec import StreamSpec
from tests.streams import arm_table

ROWS = 200
T = np.arange(ROWS) / 50.0
RNG = np.random.default_rng(0)
Q = np.sin(2 * T) + 1e-3 * RNG.normal(size=ROWS)
pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")


@pytest.mark.parametrize(
    ("values", "is_counter"),
    [
        (np.arange(ROWS), True),
        (30_000 + 12 * np.arange(ROWS), True),
        (np.arange(ROWS) % 64, True),  # wraps
        (np.delete(np.arange(ROWS + 5), [7, 8, 50, 120, 121]), True),  # rows were lost
        (np.arange(ROWS) // 25, True),  # an index of episodes
        (np.arange(ROWS)[::-1], False),
        (np.round(20 * np.sin(T)), False),
        (np.arange(ROWS) % 2, False),
        (np.where(T > 2, 1, 0), False),  # a gripper that closes
        (Q, False),
    ],
)
def test_a_counter_rises_by_a_constant_and_may_wrap_and_lose_rows(values, is_counter):
    assert counts(values) == is_counter


def test_a_second_clock_goes_on_as_the_first_does():
    assert is_second_clock(3600 + T / 3600, T)
    assert is_second_clock((T * 1e9).astype(np.int64) + RNG.integers(0, 1000, ROWS), T)
    assert not is_second_clock(Q, T)
    assert not is_second_clock(np.exp(T / 4), T)  # warms up
    assert not is_second_clock(np.zeros(ROWS), T)


@pytest.mark.parametrize("turn", [360.0, 2 * np.pi])
@pytest.mark.parametrize("low", [-0.5, 0.0])
def test_an_angle_that_turns_over_is_found(turn, low):
    angle = 0.7 * turn * np.sin(T) + 0.4 * turn
    over = (angle - low * turn) % turn + low * turn
    assert wrap_period(over, "") == pytest.approx(turn)
    assert wrap_period(angle, "") == 0
    assert wrap_period(np.where(T % 1 < 0.5, -turn / 2, turn / 2), "") == 0  # a switch
    assert wrap_period(Q, "rad") == 0


def test_numbers_that_stand_for_missing_data_are_isolated_extremes_that_repeat():
    for code in (-99999.0, 9999.0, -1e38, 6553.5):
        coded = Q.copy()
        coded[[5, 60, 61, 150]] = code
        assert missing_value_sentinel(coded) == code
    for code, rest in (
        (-1.0, 200 + Q),
        (0.0, 5 + 0.1 * Q),
        (9.99, 0.1 * Q),
    ):  # a small one stands in single rows
        coded = rest.copy()
        coded[7::15] = code
        assert missing_value_sentinel(coded) == code
        assert np.isnan(missing_value_sentinel(np.where(T > 2, code, rest)))
    assert np.isnan(missing_value_sentinel(Q))
    assert np.isnan(missing_value_sentinel(np.where(T > 3.5, 2.0, Q)))  # a stop
    assert np.isnan(
        missing_value_sentinel(np.where(np.arange(ROWS) == 9, 500.0, Q))
    )  # once: a glitch


HEALTHY = {"time": T, "q0": Q, "q1": np.cos(2 * T) + 1e-3 * RNG.normal(size=ROWS)}
ASIDE = {
    "sequence": (np.arange(ROWS), "counter"),
    "hours": (T / 3600, "counter"),
    "mode": (np.full(ROWS, 7), "constant"),
    "again": (Q, "copy"),
    "nothing": (np.full(ROWS, np.nan), "ignored"),
    "frame_id": (np.array(["base"] * ROWS, object), "ignored"),
    "y_true": (np.zeros(ROWS), "label"),
    "remaining": (5000 - np.arange(ROWS), "counter"),
    "time_left": (60 - T, "counter"),
    "packet": ((65_400 + 2 * np.arange(ROWS)) % 65_536, "counter"),
    "stamp_nsec": ((1e9 * T).astype(np.int64), "clock"),
}


@pytest.mark.parametrize("name", ASIDE)
def test_what_is_no_sense_is_set_aside_and_changes_nothing(name):
    """The same motion, read by a memory, whatever such a column does later."""
    values, role = ASIDE[name]
    table = HEALTHY | {name: values}
    schema = LogSchema.infer([table])
    columns = {c.name: c for c in schema.columns}
    assert columns[name].role == role
    found = schema.read(table)
    assert found.spec.labels == ("q[0]", "q[1]")
    later = table | {name: values + 30_000 if values.dtype.kind in "iuf" else values}
    np.testing.assert_array_equal(schema.read(later).stream, found.stream)
    if role in ("counter", "constant", "copy", "clock", "label"):
        assert "--channels" in columns[name].reason
        assert name in Episode.from_table(table, channels=["q*", name]).spec.labels


def test_a_label_that_is_constant_in_training_is_said_and_changes_nothing_when_it_marks_later():
    for name in ("y_true", "is_anomaly", "ground_truth", "fault_id"):
        healthy = HEALTHY | {name: np.zeros(ROWS)}
        with noted() as notes:
            spec = Episode.from_table(healthy).spec
        assert any(name in line and "--channels" in line for line in notes)
        marked = HEALTHY | {name: np.where(T > 2, 3.0, 0.0)}
        np.testing.assert_array_equal(
            Episode.from_table(marked, spec).stream,
            Episode.from_table(healthy, spec).stream,
        )
        assert Episode.from_table(marked).faults.sum() == (T > 2).sum()


def test_a_sense_that_is_called_as_a_label_is_is_read_and_one_of_whole_numbers_where_the_user_says_so():
    current = HEALTHY | {"fault_current": Q * Q}
    found = Episode.from_table(current)
    assert "fault_current" in found.spec.labels
    assert not found.faults.any()
    steps = HEALTHY | {"fault_current": np.rint(500 + 100 * Q)}
    assert Episode.from_table(steps).faults.all()
    assert not Episode.from_table(steps, ignore=("fault*",)).faults.any()
    asked = Episode.from_table(steps, channels=("q*", "fault_current"))
    assert "fault_current" in asked.spec.labels
    assert not asked.faults.any()
    assert Episode.from_table(current, labels=("fault*",)).faults.all()


def test_tables_of_one_robot_have_one_spec_though_a_column_stands_still_in_some():
    moves = HEALTHY | {"brake": (T > 2).astype(float)}
    stands = HEALTHY | {"brake": np.ones(ROWS)}
    for tables in ([stands, moves], [moves, stands]):
        one, other = Episode.from_tables(tables)
        assert one.spec == other.spec
        assert "brake" in one.spec.labels
    assert "brake" not in Episode.from_table(stands).spec.labels


def test_a_joint_that_stands_while_others_move_is_read_and_one_that_all_logs_leave_alone_is_not():
    table = HEALTHY | {"q2": np.zeros(ROWS), "brake": np.ones(ROWS)}
    assert Episode.from_table(table).spec.labels == ("q[0]", "q[1]", "q[2]")
    moves = HEALTHY | {"q2": np.zeros(ROWS), "brake": (T > 2).astype(float)}
    assert "brake" in LogSchema.infer([table, moves]).spec.labels


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_bias_of_an_angle_is_the_same_wherever_it_turns_over_in_files_and_live(unit):
    turn = {"deg": 360.0, "rad": 2 * np.pi}[unit]
    angle = 0.1 * turn * np.sin(2 * T) + 0.5 * turn
    over = (angle + turn / 2) % turn - turn / 2
    table = {"time": T, f"yaw [{unit}]": over, "q": Q}
    found = Episode.from_table(table)
    assert found.spec.labels == ("yaw[sin]", "yaw[cos]", "q")
    np.testing.assert_allclose(found.stream[:, 0], np.sin(2 * np.pi * angle / turn), atol=1e-6)
    saved = StreamSpec.from_json(found.spec.to_json())
    lines = [
        json.dumps({name: float(values[k]) for name, values in table.items()}) for k in range(20)
    ]
    live = np.array([row.numbers for row, _ in RowReader(LogSchema.of_spec(saved)).rows(lines)])
    np.testing.assert_allclose(live, found.stream[:20], atol=1e-6)


def test_codes_for_missing_data_are_kept_with_the_memory_and_missing_live_too():
    q = Q.copy()
    q[[9, 50, 90]] = -99999
    schema = LogSchema.infer([HEALTHY | {"q0": q}])
    match = ColumnMatch(LogSchema.from_json(json.loads(json.dumps(schema.to_json()))), ["q0", "q1"])
    np.testing.assert_array_equal(match.row({"q0": -99999, "q1": 1.0}), [np.nan, 1.0])


def test_clocks_that_disagree_are_said_and_the_user_chooses():
    table = HEALTHY | {"stamp": 2 * T}
    with pytest.warns(LogWarning, match="'time' and 'stamp' disagree, 50 and 25 rows a second"):
        assert Episode.from_table(table).spec.dt == pytest.approx(0.02)
    assert Episode.from_table(table, clock="stamp").spec.dt == pytest.approx(0.04)
    assert Episode.from_table(
        HEALTHY | {"tick": 40 * np.arange(ROWS)}, clock="tick [ms]"
    ).spec.dt == pytest.approx(0.04)
    with pytest.warns(LogWarning, match="by --rate 500 it is not read"):
        assert Episode.from_table(HEALTHY, rate=500).spec.dt == pytest.approx(0.002)
    with pytest.warns(LogWarning, match="'time' and 'stamp' disagree, 50 and 49"):
        Episode.from_table(HEALTHY | {"stamp": 1.02 * T + 7})
    with warnings.catch_warnings():
        # one of them jitters, as a clock of arrival does
        warnings.simplefilter("error", LogWarning)
        Episode.from_table(
            HEALTHY | {"recv_time": T + 0.004 * np.random.default_rng(1).random(ROWS)}
        )
    both = {"time_s": T, "time_us": 1e6 * T, "q": Q}  # no pair: each counts all the time
    assert Episode.from_table(both).spec.dt == pytest.approx(0.02)
    backwards = HEALTHY | {"time": T[::-1]}
    assert len(Episode.from_table(backwards, rate=50)) == ROWS


def rows_of(header: str, *columns: np.ndarray) -> str:
    return (
        "\n".join(
            filter(None, [header, *(",".join(map(str, row)) for row in zip(*columns, strict=True))])
        )
        + "\n"
    )


@pytest.mark.parametrize(
    ("lines", "message", "remedy"),
    [
        (
            rows_of("time,q,w", T, Q, np.where(np.arange(ROWS) == 3, "?", Q.astype(str))),
            "in row 4",
            ["--ignore", "w"],
        ),
        (rows_of("time,q,q", T, Q, -Q), "differs", ["--ignore", "q #2"]),
        (rows_of("q,p", Q, Q * Q), "--rate", ["--rate", "50"]),
        (
            rows_of("time,q,p", np.roll(T, 1) * (-1) ** np.arange(ROWS), Q, Q * Q),
            "--rate",
            ["--rate", "50"],
        ),
        (rows_of("", T, Q, Q * Q), "--columns x0 x1 x2", ["--columns", "t", "x1", "x2"]),
    ],
)
def test_every_refusal_names_what_gets_the_file_read_and_that_works_when_typed(
    lines, message, remedy, tmp_path, capsys
):
    path = tmp_path / "x.csv"
    path.write_text(lines)
    fast = ("--monitor", "kalman", "--split", "0.2", "--false-alarm-rate", "0.2")
    how = [str(path), "--out", str(tmp_path / "m.asm"), *fast]
    assert main(["fit", *how]) == 2
    assert message in capsys.readouterr().err
    assert main(["fit", *how, *remedy]) == 0
    assert main(["inspect", str(path), "--out", str(tmp_path / "i"), *remedy]) == 0
    to = ["--out", str(tmp_path / "w")]
    assert main(["watch", str(path), "--monitor", str(tmp_path / "m.asm"), *to, *remedy]) < 2


def test_numbers_of_a_short_log_that_others_hold_too_are_not_missing_data():
    short = np.array([7305.0, 7305.0, 7249.0, 7250.0])
    long = 7280.0 + 40.0 * Q
    coded = long.copy()
    coded[[5, 60, 61, 150]] = -25514.0
    tables = [{"voltage": values, "position": values} for values in (short, long)]
    for episode in Episode.from_tables(tables, rate=10.0):
        assert np.isfinite(episode.stream).all()
    tables = [{"voltage": coded, "position": long}, {"voltage": long, "position": long}]
    first, second = Episode.from_tables(tables, rate=10.0)
    assert np.isnan(first.stream).sum() == 4
    assert np.isfinite(second.stream).all()


def test_a_logger_that_was_started_twice_makes_two_logs(tmp_path):
    frame = pd.DataFrame(HEALTHY).to_csv(index=False)
    (tmp_path / "x.csv").write_text(frame + frame)
    with noted() as notes:
        assert [len(log.episode) for log in read_logs(tmp_path / "x.csv")] == [ROWS, ROWS]
    assert any("cut there" in line for line in notes)


def test_alarms_of_one_cause_are_one_and_missing_data_are_apart():
    surprise, stream = np.zeros(300), np.zeros((300, 1), np.float32)
    surprise[[50, 60, 70, 200]] = 2.0  # at 50 Hz: a push, and another one
    surprise[65], stream[65] = np.inf, np.nan
    trace = ScoredEpisode(
        "x", 0, 0.02, 1.0, surprise, attribution=stream, channels=("q",), stream=stream
    )
    found = [(alarm.why, round(alarm.start, 2)) for alarm in alarms_of(trace)]
    assert found == [("surprise", 1.02), ("missing data", 1.32)]
    assert sensed_peak(trace) == 2.0


def test_columns_that_the_first_log_lacks_are_said(tmp_path):
    pd.DataFrame(HEALTHY).to_csv(tmp_path / "0.csv", index=False)
    pd.DataFrame(HEALTHY | {"seventh": Q * Q}).to_csv(tmp_path / "1.csv", index=False)
    with noted() as notes:
        assert len({log.episode.spec for log in read_logs(tmp_path)}) == 1
    assert any("seventh" in line for line in notes)


def test_a_pointer_a_folder_of_two_robots_and_an_unwritable_output_are_refused_in_time(
    tmp_path, capsys
):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "x.parquet").write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
    )
    assert main(["fit", str(tmp_path / "a")]) == 2
    assert "git lfs pull" in capsys.readouterr().err
    (tmp_path / "b").mkdir()
    pd.DataFrame(arm_table(0)).to_csv(tmp_path / "b" / "0.csv", index=False)
    pd.DataFrame(HEALTHY).to_csv(tmp_path / "b" / "1.csv", index=False)
    assert main(["fit", str(tmp_path / "b")]) == 2
    said = capsys.readouterr().err
    assert "1.csv: the memory reads channels that are not there: torque" in said
    (tmp_path / "file").write_text("")
    assert main(["fit", str(tmp_path / "b"), "--out", str(tmp_path / "file" / "m.asm")]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
