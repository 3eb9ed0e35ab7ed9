"""Logs of every format that is read, each written here: what comes back, what was lost, and what is damaged."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from asm_gym.data.lerobot import write_lerobot
from asm_gym.data.logs import LogLayout, read_logs
from asm_gym.data.row_times import regular
from asm_gym.data.tabular import as_array, read_parquet
from asm_gym.data.text import read_table
from asm_gym.episode import Episode
from asm_gym.readings import noise_of
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR
from tests.needs import needs

RATE, ROWS = 50.0, 80


def arm(seed: int, rows: int = ROWS) -> dict[str, np.ndarray]:
    """Two joints that follow a command."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / RATE
    command = np.sin(np.outer(t, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    return {"time": t, "q": command + 0.01 * rng.normal(size=command.shape), "cmd": command}


# ------------------------------------------------------------------ time


def test_rows_that_come_on_time_are_left_as_they_are():
    t = np.arange(50) * 0.02 + np.random.default_rng(0).uniform(-0.003, 0.003, 50)
    columns = {"x": np.arange(50.0)}
    assert regular(columns, t, 0.02)["x"] is columns["x"]


def test_rows_that_were_lost_are_marked_and_the_others_keep_their_place_and_values():
    kept = np.delete(np.arange(50), [10, 11, 30])
    out = regular({"x": kept.astype(float), "pose": np.stack([kept, -kept], axis=1)}, kept * 0.02, 0.02)
    assert len(out["x"]) == 50
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out["x"])), [10, 11, 30])
    np.testing.assert_array_equal(out["x"][kept], kept)
    np.testing.assert_array_equal(out["pose"][kept, 1], -kept)


def test_a_clock_that_runs_a_little_fast_moves_no_row():
    t = np.arange(5000) * 0.0201
    assert len(regular({"x": t}, t, 0.02)["x"]) == 5000


def test_rows_at_odd_times_are_interpolated_and_gaps_are_not():
    rng = np.random.default_rng(1)
    t = np.sort(np.concatenate([[0.0], rng.uniform(0, 1, 120), rng.uniform(2, 3, 120), [3.0]]))
    out = regular({"x": 3.0 * t}, t, float(np.median(np.diff(t))))
    due = np.arange(len(out["x"])) * np.median(np.diff(t))
    known = np.isfinite(out["x"])
    np.testing.assert_allclose(out["x"][known], 3.0 * due[known], atol=1e-9)
    assert not known[(due > 1.1) & (due < 1.9)].any()
    assert known[(due < 0.9)].mean() > 0.8


def test_time_that_jumps_or_runs_backwards_is_refused():
    t = np.concatenate([np.arange(50) * 0.02, 1e9 + np.arange(50) * 0.02])
    with pytest.raises(ValueError, match=r"time jumps by 1e\+09 s after 0.98 s: cut the log there"):
        Episode.from_table({"time": t, "x": t})
    with pytest.raises(ValueError, match="time must be a number in every row, got nan in row 3"):
        Episode.from_table({"time": np.where(np.arange(9) == 3, np.nan, np.arange(9)), "x": np.arange(9.0)})


def test_the_noise_of_a_sense_is_that_of_its_third_differences():
    t = np.linspace(0, 20, 4000)
    rng = np.random.default_rng(0)
    assert noise_of(np.sin(t) + 0.01 * rng.normal(size=t.size)) == pytest.approx(0.01, rel=0.1)
    assert noise_of(np.zeros(100)) == 0.0
    spec = Episode.from_table(arm(0, 2000), action=["cmd"]).spec
    assert spec.channels[0].noise == pytest.approx(0.01, rel=0.15)
    assert spec.channels[1].noise == 0.0


def test_units_stand_behind_names_and_must_be_those_of_the_memory():
    columns = {"time [s]": arm(0)["time"], "q_0 [rad]": arm(0)["q"][:, 0], "q_1 [rad]": arm(0)["q"][:, 1]}
    spec = Episode.from_table(columns).spec
    assert [(c.name, c.size, c.unit) for c in spec.channels] == [("q", 2, "rad")]
    in_degrees = {n.replace("rad", "deg"): np.rad2deg(v) if "rad" in n else v for n, v in columns.items()}
    np.testing.assert_allclose(
        Episode.from_table(in_degrees, channels=spec).stream, Episode.from_table(columns).stream, rtol=1e-6
    )
    in_volts = {name.replace("rad", "V"): values for name, values in columns.items()}
    with pytest.raises(ValueError, match="q_0 is in V, and the memory reads rad"):
        Episode.from_table(in_volts, channels=spec)
    with pytest.raises(ValueError, match="'q' is of several units: deg, rad"):
        Episode.from_table({**columns, "q_2 [deg]": arm(0)["time"]})
    with pytest.raises(ValueError, match="'q_0' twice"):
        Episode.from_table({**columns, "q_0": arm(0)["time"]})


# ------------------------------------------------------------------ tables


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def flat(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {"time": columns["time"]} | {f"{n}_{k}": columns[n][:, k] for n in ("q", "cmd") for k in range(2)}


def test_every_format_of_a_table_gives_the_same_rows(tmp_path):
    wanted = Episode.from_table(arm(0), action=["cmd"])
    write_csv(tmp_path / "a.csv", flat(arm(0)))
    pq.write_table(pa.table(flat(arm(0))), tmp_path / "b.parquet")
    lists = {n: pa.array(arm(0)[n].tolist()) for n in ("q", "cmd")} | {"time": pa.array(arm(0)["time"])}
    pq.write_table(pa.table(lists), tmp_path / "c.parquet")
    np.savez(tmp_path / "d.npz", **arm(0))
    found = {log.name: log.episode for log in read_logs(tmp_path, LogLayout(action=["cmd"]))}
    assert list(found) == ["a.csv", "b.parquet", "c.parquet", "d.npz"]
    for episode in found.values():
        np.testing.assert_allclose(episode.stream, wanted.stream, rtol=1e-6)
        assert episode.spec.labels == wanted.spec.labels
    np.save(tmp_path / "e.npy", wanted.stream)
    ((_, bare),) = read_logs(tmp_path / "e.npy", LogLayout(rate=RATE))
    np.testing.assert_array_equal(bare.stream, wanted.stream)


def test_pandas_and_polars_frames_are_tables():
    wanted = Episode.from_table(flat(arm(0)))
    for name in ("pandas", "polars"):
        made = Episode.from_table(needs(name).DataFrame(flat(arm(0))))
        assert made.spec == wanted.spec
        np.testing.assert_array_equal(made.stream, wanted.stream)


def test_the_text_of_a_csv_is_held_a_part_at_a_time(tmp_path):
    rows = 40_000
    path = tmp_path / "long.csv"
    with path.open("w") as file:
        file.write("a,b,c\n" + "0.123456789,0.123456789,0.123456789\n" * rows)
    tracemalloc.start()
    columns = read_table(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(c.nbytes for c in columns.values()) == 3 * 8 * rows
    assert most < 3 * 3 * 8 * rows + 4_000_000  # all of the text at once would take 10 MB


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[: len(raw) // 2], r"x\.parquet"),
        (lambda raw: b"", r"x\.parquet"),
        (lambda raw: b"PAR1" + raw[4:-8] + b"\xff\xff\xff\x7fPAR1", r"x\.parquet"),
    ],
)
def test_a_damaged_parquet_file_is_named(damage, message, tmp_path):
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table(flat(arm(0))), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=message):
        list(read_logs(path))


@pytest.mark.parametrize("name", ["x.csv", "x.parquet", "x.npz", "x.npy"])
def test_an_empty_file_is_named(name, tmp_path):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        list(read_logs(tmp_path / name))


def test_a_small_file_that_claims_a_gigabyte_is_refused_unread(tmp_path):
    path = tmp_path / "bomb.parquet"
    zeros = pa.array(np.zeros(2_000_000))
    pq.write_table(pa.table({f"x{k}": zeros for k in range(8)}), path, compression="zstd")
    assert path.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match=r"bomb.parquet declares \d+ bytes, and has \d+"):
        read_parquet(path)


def test_lists_of_several_lengths_are_no_column_of_numbers():
    assert as_array(pa.array([[1.0], [1.0, 2.0]])).dtype == object


# ------------------------------------------------------------------ LeRobot


def episodes(count: int = 3) -> list[Episode]:
    return [Episode.from_table(arm(n, 60 + n), action=["cmd"], success=True) for n in range(count)]


def test_episodes_go_to_lerobot_and_come_back(tmp_path):
    write_lerobot(tmp_path / "set", episodes(), "reach", "two joints")
    read = list(read_logs(tmp_path / "set"))
    assert [name for name, _ in read] == ["episode 0", "episode 1", "episode 2"]
    for (_, back), one in zip(read, episodes(), strict=True):
        np.testing.assert_array_equal(back.stream, one.stream)
        assert back.spec.dt == pytest.approx(one.spec.dt)
        assert len(back.spec.motor) == 2
        assert back.success
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    assert info["total_frames"] == 60 + 61 + 62
    assert info["features"]["observation.state"]["names"] == ["q[0]", "q[1]"]
    listed = [json.loads(line) for line in (tmp_path / "set" / "meta" / "episodes.jsonl").read_text().splitlines()]
    assert [e["length"] for e in listed] == [60, 61, 62]


def version_3(folder: Path, success: list[bool] | None = None) -> Path:
    """Many episodes in a file, as LeRobot's version 3 keeps them."""
    made = episodes()
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    names = {"motors": ["shoulder", "elbow"]}
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": names},
        "action": {"dtype": "float32", "shape": [2], "names": names},
        "observation.images.top": {"dtype": "video", "shape": [3, 4, 4], "names": None},
    }
    info = {"codebase_version": "v3.0", "fps": RATE, "features": features, "data_path": "data/chunk-{chunk_index}/x"}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    columns = {
        "observation.state": [row.tolist() for e in made for row in e.stream[:, :2]],
        "action": [row.tolist() for e in made for row in e.stream[:, 2:]],
        "episode_index": [n for n, e in enumerate(made) for _ in range(len(e))],
    }
    if success:
        columns["next.success"] = [success[n] for n in columns["episode_index"]]
    pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


def test_episodes_of_version_3_lie_in_one_file(tmp_path):
    read = [e for _, e in read_logs(version_3(tmp_path / "set", [True, False, True]))]
    assert read[0].spec.labels == (
        *("observation.state[shoulder]", "observation.state[elbow]"),
        *("action[shoulder]", "action[elbow]"),
    )
    assert [c.group for c in read[0].spec.channels][-1] == MOTOR
    for back, one in zip(read, episodes(), strict=True):
        np.testing.assert_array_equal(back.stream, one.stream)
    assert [e.success for e in read] == [True, False, True]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"codebase_version": "v1.6"}, "of LeRobot's v1.6, and v2 and v3 can be read"),
        ({"fps": "fast"}, r"info\.json is no LeRobot dataset's"),
        ({"features": {"action": {"dtype": "float32"}}}, "no feature that is sensed"),
        ({"features": {"observation.gps": {"dtype": "float32"}}}, r"lacks observation\.gps, which"),
    ],
)
def test_a_dataset_that_is_not_what_it_says_is_refused(change, message, tmp_path):
    folder = version_3(tmp_path / "set")
    info = json.loads((folder / "meta" / "info.json").read_text()) | change
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=message):
        list(read_logs(folder))


def test_a_folder_that_holds_something_is_not_written_to(tmp_path):
    (tmp_path / "mine").write_text("x")
    with pytest.raises(ValueError, match="holds something already"):
        write_lerobot(tmp_path, episodes(), "reach")
    with pytest.raises(ValueError, match="needs actions"):
        write_lerobot(tmp_path / "set", [Episode.from_table({"q": np.zeros((3, 2))}, rate=10)], "reach")


# ------------------------------------------------------------------ ROS


def bag(folder: Path, plugin: str, lost: tuple[int, ...] = (), joints: bool = True) -> Path:
    """A wrist at twice the rate of two joints, and their commands."""
    rosbag2 = needs("rosbags.rosbag2")
    typesys = needs("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    stamp, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector = types["geometry_msgs/msg/Vector3"]

    def write(writer, connection, t, message):
        writer.write(connection, round(t * 1e9), store.serialize_cdr(message, connection.msgtype))

    def joint_state(t, position):
        kind = types["sensor_msgs/msg/JointState"]
        when = header(stamp(int(t), round(t % 1 * 1e9)), "base")
        numbers = np.array(position, float)
        return kind(when, ["j1", "j2"], numbers, 2 * numbers, np.zeros(0))

    storage = getattr(rosbag2.StoragePlugin, plugin)
    with rosbag2.Writer(folder, version=9, storage_plugin=storage) as writer:
        topics = {"/joint_states": "sensor_msgs/msg/JointState", "/wrist": "geometry_msgs/msg/WrenchStamped"}
        topics |= {"/target": "std_msgs/msg/Float64MultiArray"}
        made = {t: writer.add_connection(t, kind, typestore=store) for t, kind in topics.items()}
        for k in range(2 * ROWS):
            t = 100.0 + k / (2 * RATE)
            force = types["geometry_msgs/msg/Wrench"](vector(k, 0.0, 1.0), vector(0.0, 0.0, 0.0))
            kind = types["geometry_msgs/msg/WrenchStamped"]
            write(writer, made["/wrist"], t, kind(header(stamp(int(t), 0), "tool"), force))
            if k % 2 == 0 and k // 2 not in lost and joints:
                layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
                target = types["std_msgs/msg/Float64MultiArray"](layout, np.array([0.1 * k]))
                write(writer, made["/target"], t, target)
                write(writer, made["/joint_states"], t, joint_state(t, [k, -k]))
    return folder


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_bag_is_a_table_at_the_rate_of_its_joints(plugin, tmp_path):
    folder = bag(tmp_path / "bag", plugin)
    ((name, episode),) = read_logs(folder, LogLayout(action=["target*"]))
    assert Path(name).suffix == {"SQLITE3": ".db3", "MCAP": ".mcap"}[plugin]
    assert episode.spec.labels[:2] == ("wrist.force[x]", "wrist.force[y]")
    column = {label: episode.stream[:, k] for k, label in enumerate(episode.spec.labels)}
    np.testing.assert_array_equal(column["joint_states.position[j1]"], 2 * np.arange(ROWS))
    np.testing.assert_array_equal(column["joint_states.velocity[j2]"], -4 * np.arange(ROWS))
    np.testing.assert_array_equal(column["wrist.force[x]"], 2 * np.arange(ROWS))  # what it said last
    assert episode.spec.dt == pytest.approx(1 / RATE)
    assert len(episode.spec.motor) == 1


def test_joint_states_that_a_bag_lost_are_marked(tmp_path):
    ((_, episode),) = read_logs(bag(tmp_path / "bag", "MCAP", lost=(20, 21)))
    assert len(episode) == ROWS
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(episode.stream[:, 0])), [20, 21])


def test_a_bag_that_is_cut_off_or_has_no_joints_is_named(tmp_path):
    whole = next(bag(tmp_path / "whole", "MCAP").glob("*.mcap"))
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"cut\.mcap"):
        list(read_logs(tmp_path / "cut.mcap"))
    with pytest.raises(ValueError, match=r"no sensor_msgs/JointState; its topics: /joint_states.*/wrist"):
        list(read_logs(bag(tmp_path / "none", "MCAP", joints=False)))


def test_an_empty_bag_is_named(tmp_path):
    needs("rosbags")
    for name in ("x.mcap", "x.db3", "x.bag"):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            list(read_logs(tmp_path / name))


def test_a_small_mcap_file_that_claims_a_gigabyte_is_refused_unread(tmp_path):
    mcap = needs("mcap.writer")
    with (tmp_path / "bomb.mcap").open("wb") as file:
        writer = mcap.Writer(file, chunk_size=2**26)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        writer.add_message(channel, 0, bytes(30_000_000), 0)
        writer.finish()
    assert (tmp_path / "bomb.mcap").stat().st_size < 100_000
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"bomb\.mcap declares 30\d+ bytes, and has \d+"):
        list(read_logs(tmp_path / "bomb.mcap"))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5_000_000


# ------------------------------------------------------------------ commands


def test_what_lost_rows_is_learned_in_parts_and_a_lost_row_is_an_alarm(tmp_path, capsys):
    (tmp_path / "logs").mkdir()
    for n in range(24):
        columns = flat(arm(n))
        if n % 2:
            columns = {name: np.delete(values, [40, 41]) for name, values in columns.items()}
        write_csv(tmp_path / "logs" / f"{n}.csv", columns)
    out = ["--out", str(tmp_path / "x.asm"), "--monitor", "kalman", "--action", "cmd*", "--false-alarm-rate", "0.1"]
    assert main(["fit", str(tmp_path / "logs"), *out]) == 0
    assert "Rows were lost: 24 episodes were cut there, into 36 parts." in capsys.readouterr().out
    watch = ["--monitor", str(tmp_path / "x.asm"), "--out", str(tmp_path / "out")]
    assert main(["watch", str(tmp_path / "logs" / "1.csv"), *watch]) == 1
    alarms = read_table(tmp_path / "out" / "alarms.csv")
    assert alarms["from [s]"][0] == pytest.approx(41 / RATE)
    assert np.isinf(alarms["thresholds"][0])
