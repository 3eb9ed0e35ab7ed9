"""From logs to a memory to alarms: inspect, fit and watch as commands, and which episodes are learned from."""

from __future__ import annotations

import html
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.inspection import Inspection, inspect_log
from asm_gym.data.logs import Log
from asm_gym.data.schema import LogSchema
from asm_gym.data.text_files import read_text
from asm_gym.data.training_selection import (
    normal_episodes,
    pieces,
    split_at_random,
    split_in_time,
)
from asm_gym.evaluation.recorded_alarms import alarms_of, traces_of
from asm_gym.guard.live_watch import follow
from asm_gym.monitors import load_monitor
from asm_gym.scripts.cli import main
from asm_gym.version import __version__
from tests.streams import arm_table as log

RATE, ROWS = 50.0, 80  # of ``arm_table``
pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


# ------------------------------------------------------------------ which episodes


def test_normal_episodes_are_cut_into_pieces_and_split_by_the_seed():
    normal = Episode.from_table(log(0), success=True)
    others = {
        "failed": Episode.from_table(log(1)),
        "with a fault": Episode.from_table(log(2), success=True, faults=np.arange(ROWS) > 9),
    }
    kept, left_out = normal_episodes(
        [Log("normal", normal), *(Log(why, episode) for why, episode in others.items())]
    )
    assert kept == [normal]
    assert left_out == dict.fromkeys(others, 1)
    cut = pieces(normal, 0.5)
    np.testing.assert_array_equal(np.vstack([p.stream for p in cut]), normal.stream[:75])
    episodes = [Episode.from_table(log(n)) for n in range(40)]
    fitting, calibration = split_at_random(episodes, 19, 0.5, seed=1)
    assert len(calibration) == 20
    assert sorted(map(id, fitting + calibration)) == sorted(map(id, episodes))
    assert split_at_random(episodes, 19, 0.5, seed=1)[1] == calibration
    assert split_at_random(episodes, 19, 0.5, seed=2)[1] != calibration


def test_the_head_of_a_log_is_learned_from_and_its_tail_calibrated_on():
    log = Episode.from_table({"q": np.arange(100.0)}, rate=10.0)
    fitting, calibration = split_in_time([pieces(log, 1.0)], 0.5)
    assert [int(e.stream[0, 0]) for e in fitting] == [0, 10, 20, 30, 40]
    assert [int(e.stream[0, 0]) for e in calibration] == [60, 70, 80, 90]
    with pytest.raises(ValueError, match="too few"):
        split_in_time([pieces(log, 10.0)], 0.5)


def test_noise_is_declared_by_all_logs_and_not_by_the_first():
    def log(noise: float, seed: int) -> dict[str, np.ndarray]:
        rows = np.random.default_rng(seed)
        return {"q": np.sin(np.arange(900) / 50) + noise * rows.normal(size=900)}

    logs = [log(0.0, 0), *(log(0.1, n) for n in range(1, 5))]
    (spec,) = {episode.spec for episode in Episode.from_tables(logs, rate=50.0)}
    assert spec.channels[0].noise == pytest.approx(0.1, rel=0.15)


# ------------------------------------------------------------------ inspect


def columns() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100 + rng.normal(0, 1e-3, 3000)
    q = np.sin(np.arange(3000) / 100)
    kept = np.r_[0:1000, 1200:3000]
    made = {
        "Time (s)": t,
        "Num": np.arange(3000),
        "q_1 [rad]": np.round(q / 0.002) * 0.002,
        "current_1 [A]": q + 0.05 * rng.normal(size=3000),
        "fan": np.full(3000, 3.0),
        "target_1": q,
        "anomaly": np.zeros(3000),
    }
    made["current_1 [A]"][50:60] = np.nan
    return {name: values[kept] for name, values in made.items()}


def inspected(table: dict[str, np.ndarray]) -> Inspection:
    return inspect_log("x", table, LogSchema.infer([table]))


def test_an_inspection_says_what_is_known_of_a_log():
    found = inspected(columns())
    facts = {row["channel"]: row for row in found.facts()}
    assert found.rate == pytest.approx(100, rel=1e-3)
    assert found.jitter == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    ((start, stop),) = found.gaps
    assert stop - start == pytest.approx(2.01, abs=0.02)
    assert {c.name: c.role for c in found.columns.values()} == {
        **{
            "Time": "clock",
            "Num": "counter",
            "q_1": "sense",
            "current_1": "sense",
            "fan": "constant",
        },
        **{"target_1": "command", "anomaly": "label"},
    }
    assert (facts["q_1"]["unit"], facts["q_1"]["resolution"]) == (
        "rad",
        pytest.approx(0.002, rel=1e-3),
    )
    assert facts["current_1"]["noise"] == pytest.approx(0.05, rel=0.1)
    assert (facts["current_1"]["resolution"], facts["current_1"]["missing"]) == (0.0, 10)
    assert "never moves" in facts["fan"]["what is done"]
    assert any("1 gaps in the clock, the longest 2.0" in line for line in found.remarks())
    assert any("--rate" in line for line in inspected({"q": np.arange(9.0)}).remarks())


def test_an_inspection_counts_the_rows_that_fit_loses():
    t = np.delete(np.arange(100), [40, 41, 60]) / 50
    assert np.diff(inspected({"time": t, "q": t}).gaps, axis=1).ravel() == pytest.approx(
        [0.06, 0.04]
    )


def test_the_command_prints_a_table_and_draws_a_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rows = zip(*columns().values(), strict=True)
    text = "\n".join([";".join(columns()), *(";".join(map(str, row)) for row in rows)])
    (tmp_path / "arm.csv").write_text(text + "\n")
    assert main(["inspect", str(tmp_path / "arm.csv"), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "commanded, by its name" in said
    assert "0.002" in said
    assert (tmp_path / "out" / "arm.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "bad.csv").write_text("t,q\n1,2\n0,3\n")
    assert main(["inspect", str(tmp_path / "bad.csv"), "--out", str(tmp_path / "out")]) == 1
    assert "cannot be read: time must increase" in capsys.readouterr().out


@pytest.mark.parametrize("rows", [0, 1, ROWS])
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz", ".jsonl"])
def test_what_holds_no_number_is_refused_by_inspect_as_by_fit(suffix, rows, tmp_path, capsys):
    table = pd.DataFrame({"time": np.arange(rows) / 50, "q_1": np.full(rows, np.nan)})
    path = tmp_path / f"x{suffix}"
    {
        ".csv": lambda: table.to_csv(path, index=False),
        ".parquet": lambda: table.to_parquet(path),
        ".npz": lambda: np.savez(path, **{name: table[name].to_numpy() for name in table}),
        ".jsonl": lambda: table.to_json(path, orient="records", lines=True),
    }[suffix]()
    assert main(["inspect", str(path), "--out", str(tmp_path / "out")]) != 0
    assert main(["fit", str(path), "--out", str(tmp_path / "m.asm")]) == 2
    assert "x" in capsys.readouterr().err
    assert not (tmp_path / "m.asm").exists()


def test_logs_of_one_name_in_several_folders_are_drawn_each(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_csv(tmp_path / name / "run.csv", log(0))
    assert main(["inspect", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_logs_of_different_columns_are_one_line_each(tmp_path, capsys):
    for n, name in enumerate(("q_2", "q_3")):
        rows = np.random.default_rng(n).normal(size=(600, 2)).cumsum(axis=0)
        table = np.column_stack([np.arange(600) / 100, rows])
        np.savetxt(
            tmp_path / f"{n}.csv", table, "%.5f", ",", header=f"time,q_1,{name}", comments=""
        )
    # for fit refuses them
    assert main(["inspect", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().out
    assert "channels that are not there: q[2]" in said
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "m.asm")]) == 2
    said = capsys.readouterr()
    assert "1.csv: the memory reads channels that are not there: q[2]" in said.out + said.err
    assert not (tmp_path / "m.asm").exists()


# ------------------------------------------------------------------ fit and watch


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder of normal logs."""
    folder = tmp_path_factory.mktemp("logs")
    for n in range(40):
        write_csv(folder / f"run{n:02}.csv", log(n))
    return folder


FIT = ["--monitor", "kalman", "--action", "cmd*", "--seed", "1"]


@pytest.fixture(scope="module")
def memory(logs):
    """What is fitted to them."""
    file = logs / "memory.asm"
    assert main(["fit", str(logs), "--out", str(file), *FIT]) == 0
    return file


def test_few_logs_promise_what_they_can(logs, tmp_path, capsys):
    few = tmp_path / "few"
    few.mkdir()
    for n in range(20):
        shutil.copy(logs / f"run{n:02}.csv", few)
    out = tmp_path / "few.asm"
    assert main(["fit", str(few), "--out", str(out), *FIT]) == 0
    assert "at most one false alarm in 11; 38 promise one in 20" in capsys.readouterr().out
    monitor = load_monitor(out)
    assert len(monitor.maxima_) == 10
    assert monitor.promise.rate == pytest.approx(1 / 11)
    for n in range(7, 20):  # too few for any promise
        (few / f"run{n:02}.csv").unlink()
    assert main(["fit", str(few), "--out", str(out), *FIT]) == 2


def test_too_few_episodes_are_refused_with_how_many_are_needed(logs, tmp_path, capsys):
    out = tmp_path / "x.asm"
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarm-rate", "0.01"]) == 2
    assert (
        "this false-alarm rate needs 198 normal episodes, 99 of them to calibrate on, got 40"
        in (capsys.readouterr().err)
    )
    assert not out.exists()
    # 40 logs of 80 rows at 50 Hz: 7 pieces of 0.2 s each.
    assert (
        main(
            [
                "fit",
                str(logs),
                "--out",
                str(out),
                *FIT,
                "--false-alarm-rate",
                "0.01",
                "--split",
                "0.2",
            ]
        )
        == 0
    )


def test_a_promise_by_the_hour_takes_the_hours_and_says_so(logs, tmp_path, capsys):
    out = tmp_path / "m.asm"
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarms-per-hour", "0.5"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "0.5 false alarms an hour need at least 2 hours of nominal episodes" in said
    assert not out.exists()
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarms-per-hour", "5000"]) == 0
    assert "at most 5000 alarms an hour" in " ".join(capsys.readouterr().out.split())
    assert load_monitor(out).promise.per == "hour"


def test_a_fitted_memory_alarms_for_a_stuck_joint_and_not_for_a_normal_log(
    memory, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("sys.argv", ["asm-gym", "watch", "a log.csv", "--bridge", "0.1"])
    write_csv(tmp_path / "good.csv", log(100))
    stuck = log(101)
    stuck["q_1"][40:] = stuck["q_1"][40]
    write_csv(tmp_path / "stuck.csv", stuck)
    how = ["--monitor", str(memory), "--out", str(tmp_path / "out")]
    assert main(["watch", str(tmp_path / "good.csv"), *how]) == 0
    assert "0 alarms in 0 of 1 episodes" in capsys.readouterr().out
    assert main(["watch", str(tmp_path / "stuck.csv"), *how]) == 1
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        *("alarms.csv", "incidents", "report.html", "surprise.png", "stream.png"),
    }
    alarms = read_text(tmp_path / "out" / "alarms.csv")
    assert 40 / RATE < alarms["from [s]"][0] < 60 / RATE
    assert alarms["thresholds"].min() > 1
    report = html.unescape((tmp_path / "out" / "report.html").read_text())
    for said in ("stuck.csv", "asm-gym watch 'a log.csv' --bridge 0.1", f"asm-gym {__version__}"):
        assert said in report
    assert re.search(r"date</dt><dd>\d{4}-\d\d-\d\dT\d\d:", report)


def streamed(monitor, columns, form=lambda row: json.dumps(row.tolist())):
    """What following these rows prints, and its exit code."""
    rows = Episode.from_table(columns, channels=monitor.spec).stream
    said = io.StringIO()
    code = int(
        follow([form(row) for row in rows], monitor, lambda line: print(line, file=said)) > 0
    )
    return code, said.getvalue()


def test_rows_as_they_come_raise_the_alarms_of_the_recording(memory, tmp_path):
    monitor = load_monitor(memory)
    stuck = log(101)
    stuck["q_1"][40:] = stuck["q_1"][40]
    episode = Episode.from_table(stuck, channels=monitor.spec)
    (trace,) = traces_of([Log("stuck", episode)], monitor)
    code, said = streamed(monitor, stuck)
    assert code == 1
    *alarms, summary = said.strip().splitlines()
    found = alarms_of(trace)
    assert [float(line.split()[0]) for line in alarms] == [
        # Rows without stamps count from the first, and end with their step.
        pytest.approx(alarm.start + 1 / RATE)
        for alarm in found
    ]
    assert summary.startswith(f"{ROWS} rows, {len(found)} alarm")
    assert len(found) < len(trace.alarms)  # close ones are one
    assert streamed(monitor, log(100))[0] == 0

    def by_channel(row):
        return json.dumps(
            {
                "q": row[:2].tolist(),
                "torque": float(row[2]),
                "cmd_0": float(row[3]),
                "cmd[1]": float(row[4]),
            }
        )

    assert [
        line.split("thresholds")[0]
        for line in streamed(monitor, stuck, by_channel)[1].splitlines()[:-1]
    ] == [line.split("thresholds")[0] for line in alarms]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "nowhere"], "nowhere does not exist"),
        (["fit", "nowhere", "--monitor", "asm"], "unknown monitor 'asm'"),
        (["fit", "nowhere", "--split", "0"], "split must be"),
        (["fit", "nowhere", "--rate", "-1"], "rate must be"),
        (["fit", "nowhere", "--out", "."], "is a folder"),
        (["watch", "nowhere", "--monitor", "none.asm"], "none.asm"),
        (["watch", "nowhere", "--monitor", "x.asm", "--wait", "-1"], "wait must be"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.strip().splitlines()) == 1


LOST = [40, 41, 42]


def test_what_lost_rows_is_learned_in_parts_and_a_lost_row_is_an_alarm(tmp_path, capsys):
    (tmp_path / "logs").mkdir()
    for n in range(24):
        columns = {
            name: np.delete(values, LOST) if n % 2 else values for name, values in log(n).items()
        }
        write_csv(tmp_path / "logs" / f"{n}.csv", columns)
    out = ["--out", str(tmp_path / "x.asm"), *FIT, "--false-alarm-rate", "0.1"]
    assert main(["fit", str(tmp_path / "logs"), *out]) == 0
    printed = capsys.readouterr().out
    assert "Rows were lost: 12 of 24 episodes were cut there, into 24 parts." in printed
    # Twice the two rows that are filled by default.
    assert f"--bridge {4 / RATE:g} fills gaps" in printed
    how = ["--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path / "out")]
    assert main(["watch", str(tmp_path / "logs" / "1.csv"), *how]) == 1
    alarms = read_text(tmp_path / "out" / "alarms.csv")
    assert alarms["from [s]"][0] == pytest.approx(42 / RATE)  # its stamp; two are bridged
    assert np.isinf(alarms["thresholds"][0])


def test_one_or_two_lost_rows_are_bridged_and_what_was_sensed_comes_before_what_was_not(
    tmp_path, capsys
):
    (tmp_path / "logs").mkdir()
    for n in range(24):
        columns = {name: np.delete(values, [20, 40, 41]) for name, values in log(n).items()}
        if n == 3:
            columns["torque"][60:63] += 3.0  # a collision
        write_csv(tmp_path / "logs" / f"{n:02}.csv", columns)
        write_csv(tmp_path / f"{n:02}.csv", log(n + 24))
    out = ["--out", str(tmp_path / "x.asm"), *FIT, "--false-alarm-rate", "0.1"]
    assert main(["fit", str(tmp_path), *out, "--ignore", "nothing"]) == 0
    assert "72 rows" in capsys.readouterr().out
    how = ["--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path / "out")]
    assert main(["watch", str(tmp_path / "logs"), *how]) == 1
    said = capsys.readouterr().out
    assert "missing data" not in said
    assert "03.csv" in said.split("thresholds", 1)[1].splitlines()[1]  # the collision stands first
    assert main(["watch", str(tmp_path / "logs"), *how, "--bridge", "0"]) == 1
    first, *_, last = capsys.readouterr().out.split("log\n", 1)[1].splitlines()[:20]
    assert "surprise" in first
    assert "missing data" in last


@pytest.mark.parametrize("lost", [1, 2, 3, 30])
def test_up_to_two_lost_rows_are_bridged_and_more_are_an_alarm_behind_every_surprise(
    memory, lost, tmp_path, capsys
):
    columns = log(100)
    columns["torque"][70:73] += 5.0  # a collision
    write_csv(
        tmp_path / "x.csv",
        {name: np.delete(values, slice(30, 30 + lost)) for name, values in columns.items()},
    )
    assert (
        main(
            [
                "watch",
                str(tmp_path / "x.csv"),
                "--monitor",
                str(memory),
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 1
    )
    first, *others = capsys.readouterr().out.split("log\n", 1)[1].splitlines()[:-1]
    assert "surprise" in first
    assert any("missing data" in line for line in others) == (lost > 2)


def test_a_file_that_cannot_be_read_is_named_and_the_others_of_its_folder_are_read(
    memory, tmp_path, capsys
):
    (tmp_path / "logs").mkdir()
    for n in range(24):
        write_csv(tmp_path / "logs" / f"{n:02}.csv", log(n))
    (tmp_path / "logs" / "07.csv").write_bytes(b"\x00 no table")
    (tmp_path / "logs" / "08.parquet").write_bytes(b"cut off")
    to = ["--out", str(tmp_path / "x.asm"), *FIT, "--false-alarm-rate", "0.1"]
    how = ["--monitor", str(memory), "--out", str(tmp_path / "out")]
    for command in (["fit", *to], ["watch", *how], ["inspect", "--out", str(tmp_path / "out")]):
        assert main([command[0], str(tmp_path / "logs"), *command[1:]]) == 2
        said = capsys.readouterr().out
        assert "07.csv: it is no text" in said
        assert "08.parquet: " in said
    assert load_monitor(tmp_path / "x.asm").threshold > 0
    assert main(["fit", str(tmp_path / "logs" / "07.csv"), *to]) == 2
    assert "07.csv: it is no text" in capsys.readouterr().err


def test_a_bridge_never_makes_fit_refuse_what_it_accepts_without(tmp_path, capsys):
    for n in range(12):
        write_csv(
            tmp_path / f"{n:02}.csv",
            {name: np.delete(values, [40]) for name, values in log(n).items()},
        )
    out = ["--out", str(tmp_path / "x.asm"), *FIT, "--false-alarm-rate", "0.1"]
    assert main(["fit", str(tmp_path), *out, "--bridge", "0"]) == 0
    assert main(["fit", str(tmp_path), *out, "--bridge", "0.05"]) == 0


def test_why_no_row_is_whole_reaches_the_error_with_what_mends_it(tmp_path, capsys):
    for n in range(24):
        seldom = np.where(np.arange(ROWS) < 20, np.sin(np.arange(ROWS) + n), np.nan)
        write_csv(tmp_path / f"{n:02}.csv", log(n) | {"scale": seldom})
    out = ["--out", str(tmp_path / "x.asm"), *FIT, "--false-alarm-rate", "0.1"]
    assert main(["fit", str(tmp_path), *out]) == 2
    assert re.search(
        r"rows that lack a number are scale in \d+% of all; --ignore", capsys.readouterr().err
    )
    assert main(["fit", str(tmp_path), *out, "--ignore", "scale"]) == 0


def test_a_memory_is_fitted_from_a_pipe(tmp_path, monkeypatch, capsys):
    rows = pd.DataFrame(log(0, 3000)).to_json(orient="records", lines=True)
    monkeypatch.setattr("sys.stdin", io.StringIO(rows))
    out = tmp_path / "arm.asm"
    assert (
        main(["fit", "-", "--out", str(out), *FIT, "--false-alarm-rate", "0.1", "--split", "1"])
        == 0
    )
    said = capsys.readouterr().out
    assert "the source ended: 3000 rows" in said
    assert "Learned from 30 episodes: 1500 rows" in said
    assert out.exists()
    assert len(out.with_suffix(".jsonl").read_text().splitlines()) == 3000


# ------------------------------------------------------------------ few and long logs


def test_a_long_log_is_learned_from_between_its_marked_rows(tmp_path, capsys):
    write_csv(tmp_path / "log.csv", log(0, 6000))
    rows = (tmp_path / "log.csv").read_text().splitlines()
    marked = [f"{row},{'fault' if n == 0 else int(2500 <= n < 2550)}" for n, row in enumerate(rows)]
    (tmp_path / "log.csv").write_text("\n".join(marked))
    fit = [
        "fit",
        str(tmp_path / "log.csv"),
        "--out",
        str(tmp_path / "m.asm"),
        "--monitor",
        "kalman",
    ]
    fit += ["--false-alarm-rate", "0.1"]
    assert main(fit) == 2
    assert "1 with a fault; --split 5 learns from between" in " ".join(
        capsys.readouterr().err.split()
    )
    assert main([*fit, "--split", "1"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    # half of 44 pieces before the mark, 64 after it
    assert "Learned from 54 episodes: 2700 rows" in said
    assert "with a fault" not in said
