"""Logs as public tools export them, rebuilt from their recipes: the right reading of each is the oracle.

Two joints swing; of each shape are known the rate, the number of rows, what senses, and the angle of the first joint.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

from asm_gym.data.logs import Log, read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_inference import SchemaHints
from tests.needs import needs

ROWS, START = 200, 1_700_000_000
NAMES = ["shoulder", "elbow"]


class Motion(NamedTuple):
    t: np.ndarray  # [s]
    q: np.ndarray  # (T, 2) [rad]
    v: np.ndarray
    tau: np.ndarray

    @property
    def ns(self) -> np.ndarray:
        return START * 10**9 + np.rint(self.t * 1e9).astype(np.int64)

    def columns(
        self, q: str = "q{}", v: str = "v{}", tau: str = "tau{}", first: int = 0
    ) -> dict[str, np.ndarray]:
        """The senses, named by patterns; an empty one leaves them out."""
        parts = ((q, self.q), (v, self.v), (tau, self.tau))
        return {n.format(k + first): x[:, k] for n, x in parts if n for k in range(2)}


def motion(hz: float, rows: int = ROWS, seed: int = 0) -> Motion:
    rng, t = np.random.default_rng(seed), np.arange(rows) / hz
    w = 2 * np.pi * np.array([0.7, 1.1]) * hz / 100
    q = np.sin(t[:, None] * w + [0.3, 1.0]) + 1e-4 * rng.normal(size=(rows, 2))
    v = w * np.cos(t[:, None] * w + [0.3, 1.0]) + 1e-3 * rng.normal(size=(rows, 2))
    return Motion(t, q, v, 8 * np.cos(q) + 0.05 * rng.normal(size=(rows, 2)))


def csv(
    path: Path, columns: dict[str, Any], sep: str = ",", encoding: str = "utf-8", **how: Any
) -> Path:
    pd.DataFrame(columns).to_csv(path, sep=sep, index=False, encoding=encoding, **how)
    return path


def text(path: Path, lines: list[str], encoding: str = "utf-8") -> Path:
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
    return path


def json_lines(path: Path, rows: list[Any]) -> Path:
    return text(path, [json.dumps(row) for row in rows])


# ------------------------------------------------------------------ tables of text


def rostopic_echo(at: Path, m: Motion) -> Path:
    names = {f"field.name{k}": [name] * ROWS for k, name in enumerate(NAMES)}
    head = {"%time": m.ns, "field.header.seq": 1000 + np.arange(ROWS), "field.header.stamp": m.ns}
    senses = m.columns("field.position{}", "field.velocity{}", "field.effort{}")
    return csv(at / "x.csv", head | {"field.header.frame_id": [""] * ROWS} | names | senses)


def shuffled_names(at: Path, m: Motion) -> Path:
    """The same joints, in another order in every other row."""
    odd = np.arange(ROWS) % 2 == 1
    columns: dict[str, Any] = {"%time": m.ns}
    columns |= {f"field.name{k}": np.where(odd, NAMES[1 - k], NAMES[k]) for k in range(2)}
    columns |= {f"field.position{k}": np.where(odd, m.q[:, 1 - k], m.q[:, k]) for k in range(2)}
    return csv(at / "x.csv", columns)


def rtde(at: Path, m: Motion) -> Path:
    state = {"runtime_state": np.full(ROWS, 2), "robot_mode": np.full(ROWS, 7)}
    senses = m.columns("actual_q_{}", "actual_qd_{}", "actual_current_{}")
    return csv(at / "x.csv", {"timestamp": 5321.5 + m.t} | senses | state, sep=" ")


def kuka_rsi(at: Path, m: Motion) -> Path:
    degrees = {f"AIPos.A{k + 1}": np.degrees(m.q[:, k]) for k in range(2)}
    currents = {f"MACur.A{k + 1}": m.tau[:, k] for k in range(2)}
    stamps = [f"2026-01-02 03:04:{5 + int(t):02d}" for t in m.t]
    delay = {"Delay.D": np.zeros(ROWS, int)}
    return csv(
        at / "x.csv",
        {"Time": stamps}
        | degrees
        | currents
        | delay
        | {"IPOC": 4_208_163_634 + 12 * np.arange(ROWS)},
        ";",
    )


def kuka_fri(at: Path, m: Motion) -> Path:
    clock = {"timestamp_sec": m.ns // 10**9, "timestamp_nanosec": m.ns % 10**9}
    senses = m.columns("measured_position[{}]", "", "external_torque[{}]")
    return csv(at / "x.tsv", clock | senses | {"tracking_performance": np.ones(ROWS)}, "\t")


def libfranka(at: Path, m: Motion) -> Path:
    state = {"success_rate": np.ones(ROWS)} | m.columns(
        "state.q[{}]", "state.dq[{}]", "state.tau_J[{}]"
    )
    return csv(
        at / "x.csv",
        {"time": 1000 * np.arange(1, ROWS + 1) // 1000}
        | state
        | {"cmd.tau_J_d[0]": 3 * m.tau[:, 0]},
    )


def abb_egm(at: Path, m: Motion) -> Path:
    clock = {"seqno": np.arange(ROWS), "time.sec": m.ns // 10**9, "time.usec": m.ns // 1000 % 10**6}
    joints = {f"joint{k + 1} [deg]": np.degrees(m.q[:, k]) for k in range(2)}
    return csv(at / "x.csv", clock | joints | {"motor_state": ["MOTORS_ON"] * ROWS})


def plotjuggler(at: Path, m: Motion) -> Path:
    """Two topics in one table, empty cells where the other one spoke."""
    fast = pd.DataFrame(
        {"__time": START + m.t}
        | {f"/joint_states/{n}/position": m.q[:, k] for k, n in enumerate(NAMES)}
    )
    slow = pd.DataFrame({"__time": START + m.t[::5] + 0.002, "/wrench/force/z": m.tau[::5, 0]})
    return csv(at / "x.csv", pd.concat([fast, slow]).sort_values("__time").to_dict("list"))


def matlab_table(at: Path, m: Motion) -> Path:
    return csv(
        at / "x.csv",
        {"Time": [f"{t:g} sec" for t in m.t]}
        | {"t_ms": 1000 * m.t}
        | m.columns("q_{}", "", "tau_{}", 1),
    )


def pandas_with_index(at: Path, m: Motion) -> Path:
    pd.DataFrame({"time": m.t} | m.columns()).to_csv(at / "x.csv")
    return at / "x.csv"


def pandas_with_times_as_index(at: Path, m: Motion) -> Path:
    pd.DataFrame(m.columns(), index=pd.to_datetime(m.ns)).to_csv(at / "x.csv")
    return at / "x.csv"


def pandas_with_seconds_as_index(at: Path, m: Motion) -> Path:
    pd.DataFrame(m.columns(), index=m.t).to_csv(at / "x.csv")
    return at / "x.csv"


def influx(at: Path, m: Motion) -> Path:
    stamps = pd.to_datetime(m.ns).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return csv(
        at / "x.csv",
        {"name": ["arm"] * ROWS, "time": stamps, "host": ["cell 3"] * ROWS} | m.columns(),
    )


def long_table(at: Path, m: Motion) -> Path:
    rows = [
        (m.t[i], name, m.q[i, k], m.tau[i, k]) for i in range(ROWS) for k, name in enumerate(NAMES)
    ]
    return csv(
        at / "x.csv",
        pd.DataFrame(rows, columns=["time_s", "joint", "position", "effort"]).to_dict("list"),
    )


def long_table_of_numbers(at: Path, m: Motion) -> Path:
    rows = [(m.t[i], k + 1, m.q[i, k]) for i in range(ROWS) for k in range(2)]
    return csv(
        at / "x.csv", pd.DataFrame(rows, columns=["time", "joint_id", "angle"]).to_dict("list")
    )


def german(at: Path, m: Motion) -> Path:
    stamps = [f"24.11.2026 10:00:{t:06.3f}" for t in m.t]
    columns = {
        "Zeitstempel_time": np.arange(ROWS),
        "timestamp": stamps,
        "Achse 1 [°]": np.degrees(m.q[:, 0]),
    }
    return csv(
        at / "x.csv", columns | {"Achse 2 [°]": np.degrees(m.q[:, 1])}, ";", "latin-1", decimal=","
    )


def excel_unicode(at: Path, m: Motion) -> Path:
    return csv(
        at / "x.tsv",
        {"Time": [f"9:59:{59 + t:06.3f}" if t < 1 else f"10:00:{t - 1:06.3f}" for t in m.t]}
        | m.columns(),
        "\t",
        "utf-16",
    )


def labview(at: Path, m: Motion) -> Path:
    """A preamble, names, units below, and decimals behind a point."""
    head = [
        "LabVIEW Measurement",
        "Writer_Version 2",
        "Operator: somebody",
        "time\tq1\tq2",
        "s\tdeg\tdeg",
    ]
    return text(
        at / "x.txt",
        head
        + [f"{t:.4f}\t{a:.5f}\t{b:.5f}" for t, (a, b) in zip(m.t, np.degrees(m.q), strict=True)],
    )


def units_in_names(at: Path, m: Motion) -> Path:
    degrees = {f"q{k}(deg)": np.degrees(m.q[:, k]) for k in range(2)}
    return csv(
        at / "x.csv",
        {"time(ms)": 1000 * m.t} | degrees | {f"tau{k}_Nm": m.tau[:, k] for k in range(2)},
    )


def milliseconds_without_unit(at: Path, m: Motion) -> Path:
    return csv(at / "x.csv", {"time": np.rint(1000 * m.t).astype(int)} | m.columns())


def without_header(at: Path, m: Motion) -> Path:
    np.savetxt(at / "x.dat", np.column_stack([m.t, m.q]))
    return at / "x.dat"


def words_in_the_first_row(at: Path, m: Motion) -> Path:
    state = ["starting"] + ["moving"] * (ROWS - 1)
    return text(
        at / "x.csv",
        [f"{t:.4f},{a:.5f},{s}" for t, a, s in zip(m.t, m.q[:, 0], state, strict=True)],
    )


def hexadecimal(at: Path, m: Motion) -> Path:
    return csv(
        at / "x.csv",
        {"time": m.t, "status": [hex(0x1000 + k % 3) for k in range(ROWS)]}
        | m.columns("q{}", "", ""),
    )


def codes_for_missing(at: Path, m: Motion) -> Path:
    q = m.q.copy()
    q[np.random.default_rng(0).choice(ROWS, 12, replace=False), 1] = -99999
    return csv(at / "x.csv", {"time": m.t, "q0": q[:, 0], "q1": q[:, 1]})


def doubled(at: Path, m: Motion) -> Path:
    values = np.column_stack([m.t, m.q, m.q[:, 1]])
    np.savetxt(at / "x.csv", values, delimiter=",", header="time,q0,q1,q1", comments="")
    return at / "x.csv"


# ------------------------------------------------------------------ other formats


def json_of_ros2(at: Path, m: Motion) -> Path:
    """`ros2 topic echo`, as JSON: names, and lists in their order."""
    stamps = [{"sec": int(ns // 10**9), "nanosec": int(ns % 10**9)} for ns in m.ns]
    rows = zip(stamps, m.q.tolist(), m.tau.tolist(), strict=True)
    lists = [
        {"header": {"stamp": s}, "name": NAMES, "position": q, "velocity": [], "effort": f}
        for s, q, f in rows
    ]
    return json_lines(at / "x.jsonl", lists)


def json_of_two_publishers(at: Path, m: Motion) -> Path:
    arm = [
        (t, {"t": t, "name": NAMES, "position": q})
        for t, q in zip(m.t.tolist(), m.q.tolist(), strict=True)
    ]
    gripper = [
        (t, {"t": t, "name": ["finger"], "position": [f]})
        for t, f in zip((m.t[::3] + 0.001).tolist(), m.tau[::3, 0].tolist(), strict=True)
    ]
    return json_lines(
        at / "x.jsonl", [row for _, row in sorted(arm + gripper, key=lambda each: each[0])]
    )


def parquet_with_index(at: Path, m: Motion) -> Path:
    frame = pd.DataFrame({"timestamp": m.t} | m.columns(), index=np.arange(600, 600 + ROWS))
    frame.to_parquet(at / "x.parquet", index=True)
    return at / "x.parquet"


def structured(at: Path, m: Motion) -> Path:
    rows = np.rec.fromarrays([m.t, m.q[:, 0], m.q[:, 1].astype(np.float32)], names="t,q0,q1")
    np.save(at / "x.npy", np.asarray(rows))
    return at / "x.npy"


def matlab(at: Path, m: Motion) -> Path:
    needs("scipy.io").savemat(
        at / "x.mat", {"data": {"time": m.t, "q": m.q.T, "tau": m.tau, "robot": "iiwa"}}
    )
    return at / "x.mat"


def robomimic(at: Path, m: Motion) -> Path:
    with needs("h5py").File(at / "x.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "env_kwargs": {"control_freq": 20}}
        )
        for demo in range(2):
            group = data.create_group(f"demo_{demo}")
            group["actions"], group["rewards"] = m.v, np.zeros(ROWS)
            group["obs/robot0_joint_pos"], group["obs/image"] = (
                m.q,
                np.zeros((ROWS, 2, 2, 3), np.uint8),
            )
    return at / "x.hdf5"


def lerobot(at: Path, m: Motion, names: Any = NAMES, version: str = "v3.0") -> Path:
    """Frames that were lost are known by their stamps."""
    keep = (np.arange(ROWS) < 80) | (np.arange(ROWS) >= 110)
    rows = {
        "observation.state": m.q[keep].tolist(),
        "action": m.v[keep].tolist(),
        "timestamp": m.t[keep].astype(np.float32),
    }
    count = int(keep.sum())
    rows |= {
        "frame_index": np.arange(count),
        "episode_index": np.zeros(count, int),
        "index": np.arange(count),
    }
    (at / "x" / "meta").mkdir(parents=True)
    (at / "x" / "data").mkdir()
    pd.DataFrame(rows).to_parquet(at / "x" / "data" / "file-000.parquet")
    feature = {"dtype": "float32", "shape": [2], "names": names}
    features = {
        "observation.state": feature,
        "action": feature,
        "observation.images.top": {"dtype": "video"},
    }
    info = {"codebase_version": version, "fps": 30, "features": features}
    (at / "x" / "meta" / "info.json").write_text(json.dumps(info))
    return at / "x"


def bag(at: Path, m: Motion, plugin: str = "SQLITE3", gripper: bool = False) -> Path:
    """Joint states; perhaps of a gripper too, on the same topic at a rate of its own."""
    rosbag1, rosbag2, typesys = (
        needs(f"rosbags.{part}") for part in ("rosbag1", "rosbag2", "typesys")
    )
    first = plugin == "ROS1"
    store = typesys.get_typestore(
        typesys.Stores.ROS1_NOETIC if first else typesys.Stores.ROS2_HUMBLE
    )
    kind = "sensor_msgs/msg/JointState"
    State, Header, Time = (
        store.types[n] for n in (kind, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    how = {} if first else {"version": 9, "storage_plugin": getattr(rosbag2.StoragePlugin, plugin)}
    path = at / ("x.bag" if first else "x")
    with (rosbag1 if first else rosbag2).Writer(path, **how) as writer:
        topic = writer.add_connection("/joint_states", kind, typestore=store)
        said = [(ns, NAMES, m.q[k], m.tau[k]) for k, ns in enumerate(m.ns.tolist())]
        if gripper:
            said += [
                (ns + 10**6, ["finger"], m.v[k, :1], m.v[k, 1:])
                for k, ns in enumerate(m.ns.tolist())
                if k % 3 == 0
            ]
        for ns, names, q, tau in sorted(said, key=lambda each: each[0]):
            head = Header(*((0,) if first else ()), Time(ns // 10**9, ns % 10**9), "")
            message = State(head, names, np.array(q), np.full(len(names), np.nan), np.array(tau))
            write = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(topic, ns, write(message, kind))
    return path


class Shape(NamedTuple):
    write: Callable[[Path, Motion], Path]
    hz: float
    senses: tuple[str, ...]
    first: float = 1.0  # what the first sense is of the first joint's angle
    rows: int = ROWS
    layout: dict[str, Any] = {}  # noqa: RUF012 (options that a user types)


def two(*kinds: str, of: Any = range(2)) -> tuple[str, ...]:
    return tuple(f"{kind}[{k}]" for kind in kinds for k in of)


DEG = 180 / np.pi
STATES = tuple(f"joint_states.{kind}[{n}]" for n in NAMES for kind in ("position", "effort"))
SHAPES = {
    "rostopic echo -p": Shape(
        rostopic_echo, 125, two("field.position", "field.velocity", "field.effort", of=NAMES)
    ),
    "rostopic echo -p, joints in any order": Shape(
        shuffled_names, 125, two("field.position", of=NAMES)
    ),
    "rosbag 1": Shape(lambda at, m: bag(at, m, "ROS1"), 100, STATES),
    "rosbag 2, SQLite": Shape(bag, 100, STATES),
    "rosbag 2, MCAP": Shape(lambda at, m: bag(at, m, "MCAP"), 100, STATES),
    "two publishers on one topic": Shape(
        lambda at, m: bag(at, m, "MCAP", gripper=True),
        125,
        (*STATES, "joint_states.position[finger]", "joint_states.effort[finger]"),
    ),
    "UR RTDE": Shape(rtde, 500, two("actual_q", "actual_qd", "actual_current")),
    "KUKA RSI": Shape(kuka_rsi, 1000 / 12, two("AIPos.A", "MACur.A", of=(1, 2)), DEG),
    "KUKA FRI": Shape(kuka_fri, 200, two("measured_position", "external_torque")),
    "libfranka": Shape(
        libfranka, 1000, (*two("state.q", "state.dq", "state.tau_J"), "cmd.tau_J_d[0]")
    ),
    "ABB EGM": Shape(abb_egm, 250, two("joint", of=(1, 2)), DEG),
    "PlotJuggler": Shape(
        plotjuggler, 100, (*(f"/joint_states/{n}/position" for n in NAMES), "/wrench/force/z")
    ),
    "MATLAB table": Shape(
        matlab_table, 100, two("q", "tau", of=(1, 2)), 1.0, ROWS, {"clock": "t_ms"}
    ),
    "MATLAB file": Shape(matlab, 100, two("data.q", "data.tau")),
    "pandas to_csv": Shape(pandas_with_index, 50, two("q", "v", "tau")),
    "pandas to_csv, dates as index": Shape(pandas_with_times_as_index, 50, two("q", "v", "tau")),
    "pandas to_csv, seconds as index": Shape(
        pandas_with_seconds_as_index, 50, two("q", "v", "tau")
    ),
    "pandas to_parquet": Shape(parquet_with_index, 50, two("q", "v", "tau")),
    "InfluxDB": Shape(influx, 100, two("q", "v", "tau")),
    "a row a joint": Shape(long_table, 100, two("position", "effort", of=NAMES)),
    "a row a joint, by number": Shape(long_table_of_numbers, 100, two("angle", of=(1, 2))),
    "German Excel": Shape(german, 100, ("Achse 1", "Achse 2"), DEG),
    "Excel, Unicode text": Shape(excel_unicode, 100, two("q", "v", "tau")),
    "LabVIEW": Shape(labview, 100, two("q", of=(1, 2)), DEG),
    "units in names": Shape(units_in_names, 100, two("q", "tau"), DEG),
    "milliseconds without a unit": Shape(milliseconds_without_unit, 125, two("q", "v", "tau")),
    "no header": Shape(without_header, 100, two("q"), 1.0, ROWS, {"columns": ["t", "q0", "q1"]}),
    "a word in the first row": Shape(
        words_in_the_first_row, 100, ("q",), 1.0, ROWS, {"columns": ["t", "q", "state"]}
    ),
    "hexadecimal status": Shape(hexadecimal, 100, two("q")),
    "codes for missing data": Shape(codes_for_missing, 100, two("q")),
    "equal columns of one name": Shape(doubled, 100, two("q")),
    "JSON of ros2 topic echo": Shape(json_of_ros2, 100, two("position", "effort", of=NAMES)),
    "JSON of two publishers": Shape(
        json_of_two_publishers, 100, two("position", of=(*NAMES, "finger"))
    ),
    "NumPy records": Shape(structured, 100, two("q")),
    "robomimic": Shape(robomimic, 20, two("robot0_joint_pos", "actions")),
    "LeRobot 0.7": Shape(lerobot, 30, two("observation.state", "action", of=NAMES)),
    "LeRobot, nested names": Shape(
        lambda at, m: lerobot(at, m, [NAMES], "v2.1"),
        30,
        two("observation.state", "action", of=NAMES),
    ),
}


def logs_of(shape: Shape, at: Path) -> tuple[list[Log], Motion]:
    m = motion(shape.hz)
    with noted():
        return list(read_logs(shape.write(at, m), SchemaHints(**shape.layout))), m


def test_names_of_lerobot_that_do_not_fit_are_numbered_with_a_note(tmp_path):
    m = motion(30)
    for at in ("few", "twice"):
        (tmp_path / at).mkdir()
    with noted() as notes:
        ((_, few),) = read_logs(lerobot(tmp_path / "few", m, NAMES[:1]))
        ((_, twice),) = read_logs(lerobot(tmp_path / "twice", m, [NAMES[0]] * 2))
    state = "observation.state"
    assert few.spec.labels[:2] == (f"{state}[0]", f"{state}[1]")
    assert twice.spec.labels[:2] == (f"{state}[{NAMES[0]}]", f"{state}[{NAMES[0]}_2]")
    np.testing.assert_array_equal(few.stream, twice.stream)
    assert sum(state in note for note in notes) == 2


def test_a_memory_with_names_takes_no_column_by_position(tmp_path):
    m = motion(30)
    for at in ("named", "bare"):
        (tmp_path / at).mkdir()
    ((_, named),) = read_logs(lerobot(tmp_path / "named", m))
    bare = lerobot(tmp_path / "bare", m, None)
    schema = LogSchema.kept_in(named.info, named.spec)
    with noted(), pytest.raises(ValueError, match=NAMES[1]):
        list(read_logs(bare, schema=schema))


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_has_its_right_reading(name, tmp_path):
    shape = SHAPES[name]
    logs, m = logs_of(shape, tmp_path)
    episode = logs[0].episode
    assert set(episode.spec.labels) == set(shape.senses)
    assert 1 / episode.spec.dt == pytest.approx(shape.hz, rel=1e-3)
    assert shape.rows - 10 <= len(episode) <= shape.rows
    angle = episode.stream[:, episode.spec.labels.index(shape.senses[0])]
    wanted = shape.first * m.q[len(m.q) - len(angle) :, 0]
    known = np.isfinite(angle)
    assert known.mean() > 0.8
    np.testing.assert_allclose(angle[known], wanted[known], atol=2e-3 * shape.first)
