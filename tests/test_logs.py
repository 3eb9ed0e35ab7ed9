"""From logs to a memory to alarms: tables, readers, and the commands fit and watch."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console

from asm_gym.data.channels import read_table, stream_of
from asm_gym.data.logs import READERS, Log, LogLayout, read_logs
from asm_gym.data.selection import divided, normal_episodes, pieces
from asm_gym.episode import Episode, EpisodeLabel, save_episode
from asm_gym.evaluation.alarms import traces_of
from asm_gym.monitors import load_monitor, make_monitor
from asm_gym.scripts import watch
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR

RATE = 50.0
ROWS = 80


def log(seed: int, rows: int = ROWS) -> dict[str, np.ndarray]:
    """Two joints that follow a command, and the torque that takes."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / RATE
    command = np.sin(np.outer(t, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    joints = command + 0.01 * rng.normal(size=command.shape)
    return {
        "time": t,
        **{f"q_{k}": joints[:, k] for k in range(2)},
        **{f"cmd_{k}": command[:, k] for k in range(2)},
        "torque": joints.sum(axis=1) + 0.01 * rng.normal(size=rows),
    }


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


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


def test_columns_become_channels_by_name():
    rows, spec = stream_of(log(0), action=["cmd*"])
    assert spec.labels == ("q[0]", "q[1]", "torque", "cmd[0]", "cmd[1]")
    assert spec.dt == pytest.approx(1 / RATE)
    assert [c.group for c in spec.channels] == ["q", "torque", MOTOR]
    np.testing.assert_allclose(rows[:, 2], log(0)["torque"], rtol=1e-6)
    np.testing.assert_allclose(rows[:, 4], log(0)["cmd_1"], rtol=1e-6)


def test_a_frame_an_arrow_table_and_a_dictionary_say_the_same():
    class Frame(dict):  # as pandas and Polars: no mapping to them, but columns
        columns = property(lambda self: list(self.keys()))

    class Series:
        def __init__(self, values):
            self.values = values

        def __array__(self, dtype=None, copy=None):
            return np.asarray(self.values, dtype)

    class DataFrame:
        def __init__(self, data):
            self.data, self.columns = data, list(data)

        def __getitem__(self, name):
            return Series(self.data[name])

    wanted = Episode.from_table(log(3))
    for frame in (pa.table(log(3)), DataFrame(log(3)), Frame(log(3))):
        made = Episode.from_table(frame)
        assert made.spec == wanted.spec
        np.testing.assert_array_equal(made.stream, wanted.stream)


def test_channels_can_be_chosen_and_named():
    picked = Episode.from_table(log(0), channels={"arm": "q*", "effort": ["torque"], "order": "cmd*"}, action=["order"])
    assert picked.spec.labels == ("arm[q_0]", "arm[q_1]", "effort", "order[cmd_0]", "order[cmd_1]")
    assert list(picked.spec.motor) == [3, 4]
    assert Episode.from_table(log(0), channels=["torque", "q_1"]).spec.labels == ("q[1]", "torque")


def test_a_memory_reads_its_channels_whatever_else_there_is_and_in_whatever_order():
    episode = Episode.from_table(log(0), action=["cmd*"])
    shuffled = dict(sorted(log(0).items(), reverse=True)) | {"more": np.zeros(ROWS), "note": np.array(["x"] * ROWS)}
    np.testing.assert_array_equal(Episode.from_table(shuffled, channels=episode.spec).stream, episode.stream)


def test_two_dimensional_arrays_are_channels_of_several_numbers():
    episode = Episode.from_table({"pose": np.zeros((4, 3)), "action": np.zeros((4, 2))}, rate=10)
    assert episode.spec.labels == ("pose[0]", "pose[1]", "pose[2]", "action[0]", "action[1]")
    assert list(episode.spec.motor) == [3, 4]


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        ({"time": np.arange(ROWS)[::-1] / RATE}, {}, "time must increase from row to row, got 1.58 s before 1.56 s"),
        ({"time": None}, {}, "how many rows come a second"),
        ({"torque": np.zeros(3)}, {}, "one length, got .*torque: 3"),
        ({}, {"action": ["motor*"]}, r"no column of these channels is called 'motor\*'; there are: q_0"),
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


def test_a_memory_says_what_a_log_lacks():
    spec = Episode.from_table(log(0)).spec
    lacking = {name: values for name, values in log(0).items() if name != "q_1"}
    with pytest.raises(ValueError, match=r"channels that are not there: q\[1\]"):
        Episode.from_table(lacking, channels=spec)
    with pytest.raises(ValueError, match="reads 50 rows a second, these come at 100"):
        Episode.from_table(log(0), channels=spec, rate=100)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a header and at least one row, got 0 lines"),
        ("a,b\n", "a header and at least one row, got 1 lines"),
        ("a,a\n1,2\n", "columns of the same name: 'a'"),
        ("a,b\n1,2\n3\n", "line 3 has 1 cells, its header 2"),
        ("a,b\n1,2\n3,oops\n", "b, line 3 must be a number, got 'oops'"),
    ],
)
def test_a_damaged_csv_is_refused_with_the_line(text, message, tmp_path):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "x.csv")


def test_an_empty_cell_is_a_lost_number_and_a_column_of_words_is_left_out(tmp_path):
    (tmp_path / "x.csv").write_text("a,word\n1,go\n,\n3,stop\n")
    (columns,) = [read_table(tmp_path / "x.csv")]
    assert list(columns) == ["a"]
    np.testing.assert_array_equal(columns["a"], [1, np.nan, 3])


def test_a_run_folder_a_file_and_arrays_are_read(tmp_path):
    episode = Episode.from_table(log(0), success=True, label=EpisodeLabel("Lift", "fit", seed=3), seed=3)
    save_episode(tmp_path / "run" / episode.labelled.path, episode)
    save_episode(tmp_path / "run" / "episodes" / ".half.npz", episode)  # unfinished
    ((name, read),) = read_logs(tmp_path / "run")
    assert name == "Lift/fit/3.npz"
    np.testing.assert_array_equal(read.stream, episode.stream)
    np.savez(tmp_path / "raw.npz", **log(0))
    ((name, read),) = read_logs(tmp_path / "raw.npz", LogLayout(action=()))
    assert name == "raw.npz"
    np.testing.assert_array_equal(read.stream, episode.stream)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda p: None, FileNotFoundError, "there is no"),
        (
            lambda p: p.mkdir(),
            FileNotFoundError,
            "no episodes: no .npz, .npy, .csv, .parquet.*no LeRobot or Minari",
        ),
        (lambda p: p.write_bytes(b"PK"), ValueError, "files that can be read end in .npz, .npy, .csv"),
    ],
)
def test_what_holds_no_log_is_refused(make, error, message, tmp_path):
    make(tmp_path / "thing")
    with pytest.raises(error, match=message):
        list(read_logs(tmp_path / "thing"))


def test_a_damaged_file_among_logs_is_named(tmp_path):
    write_csv(tmp_path / "a.csv", log(0))
    (tmp_path / "b.npz").write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"b\.npz: it is damaged"):
        list(read_logs(tmp_path))


@pytest.mark.parametrize("suffix", READERS)
def test_a_file_of_any_kind_that_is_none_is_named(suffix, tmp_path):
    (tmp_path / f"no{suffix}").write_bytes(b"\x00\xff no file of this kind \x00")
    with pytest.raises(ValueError, match=rf"no\{suffix}: ."):
        list(read_logs(tmp_path / f"no{suffix}"))


def test_only_normal_episodes_are_learned_from():
    normal = Episode.from_table(log(0), success=True)
    episodes = {
        "normal": normal,
        "failed": Episode.from_table(log(1)),
        "fault": Episode.from_table(log(2), success=True, faults=np.arange(ROWS) > 9),
        "faulty": Episode.from_table(log(3), success=True, label=EpisodeLabel("Lift", "faulty", "push")),
        "harmless": Episode.from_table(log(4), success=True, label=EpisodeLabel("Lift", "harmless", "slower")),
    }
    found = [Log(name, episode) for name, episode in episodes.items()]
    kept = normal_episodes(found)
    assert kept.episodes == [normal]
    assert kept.left_out == {"failed": 1, "with a fault": 2, "under a harmless variation": 1}


def test_long_logs_are_cut_into_pieces_of_one_length():
    cut = pieces(Episode.from_table(log(0)), 0.5)
    assert [len(piece) for piece in cut] == [25, 25, 25]
    np.testing.assert_array_equal(np.vstack([p.stream for p in cut]), Episode.from_table(log(0)).stream[:75])


def test_episodes_that_calibrate_are_not_learned_from_and_both_are_drawn_by_the_seed():
    episodes = [Episode.from_table(log(n)) for n in range(40)]
    fitting, calibration = divided(episodes, 0.05, 0.5, seed=1)
    assert len(calibration) == 20
    assert sorted(map(id, fitting + calibration)) == sorted(map(id, episodes))
    assert divided(episodes, 0.05, 0.5, seed=1)[1] == calibration
    assert divided(episodes, 0.05, 0.5, seed=2)[1] != calibration


def test_too_few_episodes_are_refused_with_how_many_are_needed(logs, tmp_path, capsys):
    out = tmp_path / "x.asm"
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarm-rate", "0.01"]) == 2
    assert "a false-alarm rate of 0.01 needs 198 normal episodes, 99 of them to calibrate on, got 40" in (
        capsys.readouterr().err
    )
    assert not out.exists()
    # 40 logs of 80 rows at 50 Hz: 7 pieces of 0.2 s each.
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarm-rate", "0.01", "--split", "0.2"]) == 0


def test_a_promise_by_the_hour_takes_the_hours_and_says_so(logs, tmp_path, capsys):
    out = tmp_path / "m.asm"
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarms-per-hour", "0.5"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "0.5 false alarms an hour need at least 2 hours of nominal episodes" in said
    assert not out.exists()
    assert main(["fit", str(logs), "--out", str(out), *FIT, "--false-alarms-per-hour", "5000"]) == 0
    assert "at most 5000 alarms an hour of normal ones" in " ".join(capsys.readouterr().out.split())
    assert load_monitor(out).promise.per == "hour"


def test_a_fitted_memory_alarms_for_a_stuck_joint_and_not_for_a_normal_log(memory, tmp_path, capsys):
    write_csv(tmp_path / "good.csv", log(100))
    stuck = log(101)
    stuck["q_1"][40:] = stuck["q_1"][40]
    write_csv(tmp_path / "stuck.csv", stuck)
    how = ["--monitor", str(memory), "--out", str(tmp_path / "out")]
    assert main(["watch", str(tmp_path / "good.csv"), *how]) == 0
    assert "0 alarms in 0 of 1 episodes" in capsys.readouterr().out
    assert not (tmp_path / "out" / "moments.png").exists()
    assert main(["watch", str(tmp_path / "stuck.csv"), *how]) == 1
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        *("alarms.csv", "report.html", "surprise.png", "attribution.png", "stream.png", "moments.png"),
    }
    alarms = read_table(tmp_path / "out" / "alarms.csv")
    assert 40 / RATE < alarms["from [s]"][0] < 60 / RATE
    assert alarms["thresholds"].min() > 1
    assert "stuck.csv" in (tmp_path / "out" / "report.html").read_text()


def test_a_memory_of_the_same_seed_is_the_same(logs, memory, tmp_path):
    assert main(["fit", str(logs), "--out", str(tmp_path / "again.asm"), *FIT]) == 0
    first, again = load_monitor(memory), load_monitor(tmp_path / "again.asm")
    assert first.threshold == again.threshold
    for name, array in first.learned_.items():
        np.testing.assert_array_equal(array, again.learned_[name])


def streamed(monitor, columns, form=lambda row: json.dumps(row.tolist())):
    """What following these rows prints, and its exit code."""
    rows = Episode.from_table(columns, channels=monitor.spec).stream
    said = io.StringIO()
    code = watch.follow([form(row) for row in rows], monitor, Console(file=said))
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
    assert [float(line.split()[0]) for line in alarms] == [pytest.approx((t + 1) / RATE) for t in trace.alarms]
    assert summary.startswith(f"{ROWS} rows, {len(trace.alarms)} alarm")
    assert streamed(monitor, log(100))[0] == 0

    def by_channel(row):
        return json.dumps(
            {"q": row[:2].tolist(), "torque": float(row[2]), "cmd_0": float(row[3]), "cmd[1]": float(row[4])}
        )

    assert [line.split("thresholds")[0] for line in streamed(monitor, stuck, by_channel)[1].splitlines()[:-1]] == [
        line.split("thresholds")[0] for line in alarms
    ]


def test_a_number_that_is_lost_is_an_alarm(memory):
    monitor = load_monitor(memory)
    rows = Episode.from_table(log(100), channels=monitor.spec).stream.astype(float)
    lines = [json.dumps(dict(zip(monitor.spec.labels, row.tolist(), strict=True))) for row in rows[:10]]
    lost = json.loads(lines[5])
    del lost["torque"]
    for line in (json.dumps(lost), json.dumps({**lost, "torque": None})):
        said = io.StringIO()
        assert watch.follow([*lines[:5], line], monitor, Console(file=said)) == 1
        assert "torque  inf thresholds" in said.getvalue()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "no row came"),
        (["\n"], "no row came"),
        (["[1, 2]"], r"line 1 must hold 5 numbers, got the shape \(2,\)"),
        (["{"], "line 1 is no row of numbers"),
        (['["a", 1, 2, 3, 4]'], "line 1 is no row of numbers"),
        (['{"q": [1, 2]}'], "line 1 is no row of numbers: it lacks torque, cmd"),
        (['{"q": [1, 2, 3], "torque": 1, "cmd": [1, 2]}'], "line 1 must hold 5 numbers"),
    ],
)
def test_a_line_that_is_no_row_is_refused_with_its_number(lines, message, memory):
    with pytest.raises(ValueError, match=message):
        watch.follow(lines, load_monitor(memory), Console(file=io.StringIO()))


def test_standard_input_is_watched_as_a_command(memory, monkeypatch, capsys):
    rows = Episode.from_table(log(100), channels=load_monitor(memory).spec).stream
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(json.dumps(row.tolist()) for row in rows)))
    assert main(["watch", "-", "--monitor", str(memory)]) == 0
    assert f"{ROWS} rows, 0 alarms" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit"], "DATA"),
        (["fit", "nowhere"], "there is no nowhere"),
        (["fit", "nowhere", "--monitor", "asm"], "unknown monitor 'asm'"),
        (["fit", "nowhere", "--split", "0"], "split must be"),
        (["fit", "nowhere", "--rate", "-1"], "rate must be"),
        (["fit", "nowhere", "--out", "."], "is a folder"),
        (["watch", "nowhere"], "--monitor"),
        (["watch", "nowhere", "--monitor", "none.asm"], "none.asm"),
        (["watch", "nowhere", "--monitor", "x.asm", "--silence", "0"], "silence must be"),
        (["watch", "-", "--monitor", "x.asm", "--rerun", "x.rrd"], "--rerun is for a recording, and - is live"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.strip().splitlines()) == 1


def test_a_memory_without_a_threshold_cannot_watch(tmp_path, capsys):
    episodes = [Episode.from_table(log(n)) for n in range(4)]
    make_monitor("kalman", episodes[0].spec).fit(episodes).save(tmp_path / "raw.asm")
    assert main(["watch", "-", "--monitor", str(tmp_path / "raw.asm")]) == 2
    assert "raw.asm has no threshold" in capsys.readouterr().err
