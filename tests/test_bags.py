"""ROS bags and LeRobot datasets as logs: what is read, what was lost, and what is damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from asm_gym.data.logs import read_logs
from asm_gym.data.schema_inference import SchemaHints
from asm_gym.spec import MOTOR
from tests.needs import needs

RATE, ROWS = 50.0, 80
pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")


def bag(
    folder: Path, plugin: str, lost: tuple[int, ...] = (), joints: bool = True, finger: bool = False
) -> Path:
    """A wrist at twice the rate of two joints, and their commands; perhaps a finger at three times that."""
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
        topics = {
            "/joint_states": "sensor_msgs/msg/JointState",
            "/wrist": "geometry_msgs/msg/WrenchStamped",
        }
        topics |= {"/target": "std_msgs/msg/Float64MultiArray"}
        made = {t: writer.add_connection(t, kind, typestore=store) for t, kind in topics.items()}
        for k in range(2 * ROWS):
            t = 100.0 + k / (2 * RATE)
            force = types["geometry_msgs/msg/Wrench"](
                vector(3 * k, 0.0, 1.0), vector(0.0, 0.0, 0.0)
            )
            kind = types["geometry_msgs/msg/WrenchStamped"]
            write(writer, made["/wrist"], t, kind(header(stamp(int(t), 0), "tool"), force))
            for part in range(3 if finger else 0):
                state, numbers = (
                    types["sensor_msgs/msg/JointState"],
                    (np.array([1.0]), np.zeros(3), np.zeros(0)),
                )
                message = state(header(stamp(int(t), 0), ""), ["finger"], *numbers)
                write(writer, made["/joint_states"], t + part / (6 * RATE) + 1e-4, message)
            if k % 2 == 0 and k // 2 not in lost and joints:
                layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
                target = types["std_msgs/msg/Float64MultiArray"](layout, np.array([0.1 * k]))
                write(writer, made["/target"], t, target)
                write(writer, made["/joint_states"], t, joint_state(t, [k, -k]))
    return folder


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_bag_is_a_table_at_the_rate_of_its_joints(plugin, tmp_path):
    folder = bag(tmp_path / "bag", plugin)
    ((name, episode),) = read_logs(folder, SchemaHints(action=["target*"]))
    assert Path(name).suffix == {"SQLITE3": ".db3", "MCAP": ".mcap"}[plugin]
    assert episode.spec.labels[:2] == ("wrist.force[x]", "wrist.force[y]")
    column = {label: episode.stream[:, k] for k, label in enumerate(episode.spec.labels)}
    np.testing.assert_array_equal(column["joint_states.position[j1]"], 2 * np.arange(ROWS))
    np.testing.assert_array_equal(column["joint_states.velocity[j2]"], -4 * np.arange(ROWS))
    # what it said last
    np.testing.assert_array_equal(column["wrist.force[x]"], 6 * np.arange(ROWS))
    assert episode.spec.dt == pytest.approx(1 / RATE)
    assert len(episode.spec.motor) == 1


def test_joint_states_that_a_bag_lost_are_marked(tmp_path):
    ((_, episode),) = read_logs(bag(tmp_path / "bag", "MCAP", lost=(20, 21)))
    assert len(episode) == ROWS
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(episode.stream[:, 0])), [20, 21])


def test_rows_are_those_of_the_arm_and_not_of_a_faster_finger_whose_velocities_fit_no_name(
    tmp_path,
):
    ((_, episode),) = read_logs(bag(tmp_path / "bag", "MCAP", finger=True))
    assert len(episode) == ROWS
    labels = episode.spec.labels
    assert {"joint_states.position[j1]", "joint_states.position[j2]"} < set(labels)
    assert "joint_states.velocity[finger]" not in labels


def test_a_bag_that_is_cut_off_or_has_no_joints_is_named(tmp_path):
    whole = next(bag(tmp_path / "whole", "MCAP").glob("*.mcap"))
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"cut\.mcap"):
        list(read_logs(tmp_path / "cut.mcap"))
    with pytest.raises(
        ValueError, match=r"no sensor_msgs/JointState; its topics: /joint_states.*/wrist"
    ):
        list(read_logs(bag(tmp_path / "none", "MCAP", joints=False)))


def lerobot(folder: Path, version: str, success: list[bool] | None = None) -> list[np.ndarray]:
    """A dataset of three episodes: each in a file of its own, as version 2 has them, or all in one."""
    rows = [np.random.default_rng(n).normal(size=(60 + n, 4)).astype(np.float32) for n in range(3)]
    feature = {"dtype": "float32", "shape": [2], "names": {"motors": ["shoulder", "elbow"]}}
    picture = {"dtype": "video", "shape": [3, 4, 4], "names": None}
    features = {"observation.state": feature, "action": feature, "observation.images.top": picture}
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    info = {"codebase_version": version, "fps": RATE, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables = []
    for n, episode in enumerate(rows):
        columns = {"observation.state": episode[:, :2].tolist(), "action": episode[:, 2:].tolist()}
        columns["episode_index"] = [n] * len(episode)
        if success:
            columns["next.success"] = [success[n]] * len(episode)
        tables.append(pa.table(columns))
    files = tables if version.startswith("v2") else [pa.concat_tables(tables)]
    for n, table in enumerate(files):
        pq.write_table(table, folder / "data" / f"file-{n:03}.parquet")
    return rows


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_episodes_of_lerobot_are_read_with_the_names_of_their_joints(version, tmp_path):
    rows = lerobot(tmp_path / "set", version, [True, False, True])
    names, read = zip(*read_logs(tmp_path / "set"), strict=True)
    assert names == ("episode 0", "episode 1", "episode 2")
    assert read[0].spec.labels == (
        *("observation.state[shoulder]", "observation.state[elbow]"),
        *("action[shoulder]", "action[elbow]"),
    )
    assert read[0].spec.channels[-1].group == MOTOR
    assert read[0].spec.dt == pytest.approx(1 / RATE)
    for episode, wanted in zip(read, rows, strict=True):
        np.testing.assert_array_equal(episode.stream, wanted)
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
    folder = tmp_path / "set"
    lerobot(folder, "v3.0")
    info = json.loads((folder / "meta" / "info.json").read_text()) | change
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=message):
        list(read_logs(folder))
