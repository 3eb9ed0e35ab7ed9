"""A log's meaning: inferred once, written to a file, edited, kept by a memory, and never contradicted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.live_rows import RowReader
from asm_gym.data.log_comparison import FACTOR
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_file import read_schema, write_schema
from asm_gym.guard.live_events import LiveEvent
from asm_gym.guard.live_watch import follow
from asm_gym.monitors import load_monitor, make_monitor
from asm_gym.scripts.cli import main
from tests.streams import arm_table
from tests.test_export_shapes import SHAPES, motion

pytestmark = pytest.mark.filterwarnings("default::asm_gym.data.reader_notes.LogWarning")
FAST = ["--monitor", "kalman", "--seed", "1", "--false-alarm-rate", "0.1"]


def write_folder(folder: Path, logs: list[dict[str, Any]]) -> Path:
    folder.mkdir(parents=True)
    for n, log in enumerate(logs):
        pd.DataFrame(log).to_csv(folder / f"{n:02}.csv", index=False)
    return folder


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# ------------------------------------------------------------------ the file


@pytest.mark.parametrize("name", ["UR RTDE", "LeRobot 0.7", "JSON of ros2 topic echo", "KUKA FRI"])
def test_a_schema_is_the_same_when_it_is_written_and_read_back(name, tmp_path):
    shape = SHAPES[name]
    path = shape.write(tmp_path, motion(shape.hz))
    schema_file = tmp_path / "logs.toml"
    assert main(["inspect", str(path), "--schema", str(schema_file), "--out", str(tmp_path)]) == 0
    schema = read_schema(schema_file)
    ((_, read),) = read_logs(path, schema=schema)
    ((_, inferred),) = read_logs(path)
    assert read.spec.labels == inferred.spec.labels
    assert read.spec.dt == pytest.approx(inferred.spec.dt)
    np.testing.assert_array_equal(read.stream, inferred.stream)
    assert LogSchema.from_json(json.loads(json.dumps(schema.to_json()))) == schema


def test_an_edited_line_is_what_is_read(tmp_path):
    t = np.arange(300) / 50
    log = {"time": t, "a7": np.degrees(np.sin(t)), "fan": np.cos(3 * t), "note": ["x"] * 300}
    path = write_folder(tmp_path / "logs", [log])
    schema_file = tmp_path / "logs.toml"
    main(["inspect", str(path), "--schema", str(schema_file), "--out", str(tmp_path)])
    edit(
        schema_file,
        '"a7" = { role = "sense"',
        '"a7" = { role = "sense", unit = "rad", scale = 0.0174533',
    )
    edit(schema_file, '"fan" = { role = "sense"', '"fan" = { role = "ignored"')
    ((_, episode),) = read_logs(path, schema=read_schema(schema_file))
    assert episode.spec.labels == ("a7",)
    assert episode.spec.channels[0].unit == "rad"
    np.testing.assert_allclose(episode.stream[:, 0], np.sin(t), atol=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('role = "sense"', 'role = "sens"', "line 10: q_0"),
        ("rate = 50.0", "rate = -1", "line 5: rate"),
        ("rate = 50.0", "rate = ", "line 5"),
        ('units = ["s"]', 'units = ["week"]', "line 6: clock"),
        ('role = "sense"', 'role = "sense", colour = "red"', "line 10: q_0"),
        ("rate = 50.0", "speed = 50.0", "line 5: speed"),
    ],
)
def test_a_damaged_schema_names_the_line(old, new, line, tmp_path):
    path = tmp_path / "logs.toml"
    write_schema(path, LogSchema.infer([arm_table(0)]))
    edit(path, old, new)
    with pytest.raises(ValueError, match=line):
        read_schema(path)


def test_a_log_that_does_not_fit_names_what_is_missing_extra_or_of_another_type():
    schema = LogSchema.infer([arm_table(0)])
    other = arm_table(1)
    other["effort"] = other.pop("torque")
    with pytest.raises(ValueError, match=r"not there: torque.*lacks them: effort"):
        schema.read(other)
    words = arm_table(1) | {"torque": np.array(["high"] * 80, object)}
    with pytest.raises(ValueError, match="torque must hold numbers"):
        schema.read(words)


# ------------------------------------------------------------------ kept by a memory


def test_a_memory_keeps_its_schema_so_that_watch_needs_no_option(tmp_path, capsys):
    """Foreign names, a clock that has none, a command that is not called one."""

    def foreign(seed: int) -> dict[str, np.ndarray]:
        log = arm_table(seed)
        return {
            "tick": np.rint(1000 * log["time"]).astype(int),
            "a": log["q_0"],
            "b": log["q_1"],
            "m": log["torque"],
            "u": log["cmd_0"],
        }

    logs = write_folder(tmp_path / "logs", [foreign(n) for n in range(40)])
    out = tmp_path / "m.asm"
    fit = ["fit", str(logs), "--out", str(out), *FAST, "--action", "u"]
    assert main(fit) == 2
    assert "--clock" in capsys.readouterr().err
    assert main([*fit, "--clock", "tick [ms]"]) == 0
    assert load_monitor(out).spec.dt == pytest.approx(0.02)

    faulty = foreign(50)
    faulty["b"][40:] = faulty["b"][40]
    bad = write_folder(tmp_path / "bad", [faulty])
    good = write_folder(tmp_path / "good", [foreign(51)])
    to = ["--monitor", str(out), "--out", str(tmp_path / "w")]
    assert main(["watch", str(good), *to]) == 0
    assert main(["watch", str(bad), *to]) == 1


def test_a_live_row_is_read_by_the_schema_that_the_memory_keeps():
    t = np.arange(100) / 50
    log = {"Zeit": 1000 * t, "Winkel [°]": np.degrees(np.sin(t)), "M": np.cos(t)}
    schema = LogSchema.infer([log], clock="Zeit [ms]")
    kept = LogSchema.from_json(json.loads(json.dumps(schema.to_json())))
    lines = [json.dumps({name: float(v[k]) for name, v in log.items()}) for k in range(20)]
    rows = [row for row, _ in RowReader(kept).rows(lines)]
    np.testing.assert_allclose([r.numbers for r in rows], schema.read(log).stream[:20], rtol=1e-6)
    assert [row.stamp for row in rows] == pytest.approx(list(t[:20]))
    assert not any(row.problem or row.lost for row in rows)


def test_python_memories_keep_the_schema_too(tmp_path):
    episodes = Episode.from_tables([arm_table(n) for n in range(30)])
    monitor = make_monitor("kalman", episodes[0].spec).fit(episodes[:15])
    monitor.calibrate(episodes[15:], 0.1).save(tmp_path / "m.asm")
    loaded = load_monitor(tmp_path / "m.asm")
    assert LogSchema.kept_in(loaded.about, loaded.spec).clock is not None


# ------------------------------------------------------------------ clocks


@pytest.mark.parametrize(
    "clock",
    [
        {"Zeit": np.arange(200) / 50},
        {"Uhrzeit": [f"10:15:{t:06.3f}".replace(".", ",") for t in np.arange(200) / 50]},
        {
            "robot_timestamp_seconds": 1_700_000_000 + np.arange(200) // 50,
            "robot_timestamp_nanos": np.arange(200) % 50 * 20_000_000,
        },
    ],
)
def test_a_clock_is_found_whatever_its_language(clock, tmp_path):
    q = np.sin(np.arange(200) / 9)
    path = write_folder(tmp_path / "logs", [clock | {"q": q}])
    ((_, episode),) = read_logs(path)
    assert episode.spec.labels == ("q",)
    assert episode.spec.dt == pytest.approx(0.02)


def test_whole_numbers_without_a_unit_are_said_in_both_readings():
    table = {"t": np.arange(400), "q": np.sin(0.02 * np.arange(400))}
    with noted() as notes:
        schema = LogSchema.infer([table])
    assert schema.rate == 1000
    assert any("1000 rows a second" in line and "in s it would be 1" in line for line in notes)
    assert LogSchema.infer([table], clock="t [s]").rate == 1


# ------------------------------------------------------------------ logs beside each other


def in_degrees(log: dict[str, np.ndarray], unit: bool) -> dict[str, np.ndarray]:
    made = dict(log)
    for k in range(2):
        made[f"q_{k}"] = np.degrees(made[f"q_{k}"])
    return with_units(made, "deg") if unit else made


def with_units(log: dict[str, np.ndarray], unit: str) -> dict[str, np.ndarray]:
    return {f"{n} [{unit}]" if n.startswith("q") else n: v for n, v in log.items()}


def test_logs_of_another_scale_are_named_until_the_schema_says_otherwise(tmp_path, capsys):
    logs = [in_degrees(arm_table(n), False) if n % 4 == 3 else arm_table(n) for n in range(40)]
    folder = write_folder(tmp_path / "logs", logs)
    out = ["--out", str(tmp_path / "m.asm"), *FAST]
    assert main(["fit", str(folder), *out]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "q_0" in said
    assert "degrees" in said
    assert "03.csv" in said
    assert "04.csv" not in said

    schema_file = tmp_path / "logs.toml"
    main(["inspect", str(folder), "--schema", str(schema_file), "--out", str(tmp_path / "i")])
    edit(schema_file, '"q_0" = { role = "sense"', '"q_0" = { role = "sense", varies = true')
    assert main(["fit", str(folder), *out, "--schema", str(schema_file)]) == 0


def test_python_refuses_logs_of_another_scale_too():
    logs = [in_degrees(arm_table(n), False) if n % 4 == 3 else arm_table(n) for n in range(12)]
    episodes = Episode.from_tables(logs)
    with pytest.raises(ValueError, match=r"degrees.*episode 3"):
        make_monitor("kalman", episodes[0].spec).fit(episodes)


def test_logs_with_units_are_converted_and_no_note_says_otherwise(tmp_path):
    logs = []
    for n in range(8):
        log = arm_table(n)
        logs.append(in_degrees(log, True) if n % 4 == 3 else with_units(log, "rad"))
    with noted() as notes:
        episodes = [log.episode for log in read_logs(write_folder(tmp_path / "logs", logs))]
    assert not any("not read" in line for line in notes)
    np.testing.assert_allclose(episodes[3].stream[:, 0], arm_table(3)["q_0"], rtol=1e-5)


def test_a_log_in_which_the_arm_stands_is_no_log_of_another_scale(tmp_path):
    logs = [arm_table(n) for n in range(24)]
    rng = np.random.default_rng(0)
    for k in range(2):
        logs[5][f"q_{k}"] = 1.0 + 0.01 * rng.normal(size=80)
    folder = write_folder(tmp_path / "logs", logs)
    assert main(["fit", str(folder), "--out", str(tmp_path / "m.asm"), *FAST]) == 0
    assert FACTOR > 10


def test_a_log_that_is_there_twice_is_refused(tmp_path, capsys):
    folder = write_folder(tmp_path / "logs", [arm_table(n) for n in [*range(24), 3]])
    assert main(["fit", str(folder), "--out", str(tmp_path / "m.asm"), *FAST]) == 2
    assert "24.csv is a copy of 03.csv" in " ".join(capsys.readouterr().err.split())


# ------------------------------------------------------------------ the robot's time


def test_alarms_of_a_recording_carry_the_stamp_of_the_row_and_its_name_in_the_log(tmp_path, capsys):
    folder = write_folder(tmp_path / "logs", [arm_table(n) for n in range(40)])
    memory = tmp_path / "m.asm"
    assert main(["fit", str(folder), "--out", str(memory), *FAST]) == 0
    faulty = arm_table(50)
    faulty["q_1"][40:] = faulty["q_1"][40]
    dated = dict(faulty, time=1_700_000_000.0 + faulty["time"])
    late = dict(faulty, time=960.0 + faulty["time"])
    bad = write_folder(tmp_path / "bad", [dated, late])
    capsys.readouterr()
    watch = ["watch", str(bad), "--monitor", str(memory), "--out", str(tmp_path / "w")]
    assert main([*watch, "--json"]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    alarm, of_late = (
        next(event for event in events if event["kind"] == "alarm" and event["log"] == name)
        for name in ("00.csv", "01.csv")
    )
    assert events[-1]["kind"] == "summary"
    assert alarm["date"].startswith("2023-11-14T22:13:2")
    table = pd.read_csv(tmp_path / "w" / "alarms.csv")
    begins = table.groupby("log")["from [s]"].first()
    first_stuck = faulty["time"][40]
    for event, origin in ((alarm, 1_700_000_000.0), (of_late, 960.0)):
        assert event["stamp"] == event["time"]
        assert 0 <= event["stamp"] - origin - first_stuck < 0.4
        assert begins[event["log"]] == pytest.approx(event["stamp"], abs=1e-3)
        assert event["channel"].startswith("q_")


def test_live_alarms_carry_the_stamp_and_the_name_of_the_log(tmp_path):
    episodes = Episode.from_tables([arm_table(n) for n in range(30)])
    monitor = make_monitor("kalman", episodes[0].spec).fit(episodes[:15])
    monitor.calibrate(episodes[15:], 0.1)
    faulty = arm_table(50)
    faulty["q_1"][40:] += 3.0
    faulty["time"] = 960.0 + faulty["time"]
    lines = [json.dumps({name: float(v[k]) for name, v in faulty.items()}) for k in range(60)]
    events: list[LiveEvent] = []
    assert follow(lines, monitor, events.append) > 0
    assert events[0].channel in faulty
    assert events[0].stamp == pytest.approx(960.0 + 40 * 0.02)
    assert str(events[0]).startswith("960.8")


def test_the_period_of_a_schema_is_that_of_its_rate():
    schema = LogSchema.infer([arm_table(0)])
    assert replace(schema, rate=100.0).spec.dt == pytest.approx(0.01)


# ------------------------------------------------------------------ six folders


def write_logs(shape: Any, folder: Path, seeds: range, fault: bool = False) -> Path:
    """Write a log of each seed; with a fault its first joint jumps."""
    for seed in seeds:
        m = motion(shape.hz, seed=seed)
        if fault:
            m.q[100:, 0] += 1.0
        (folder / f"{seed:02}").mkdir(parents=True)
        shape.write(folder / f"{seed:02}", m)
    return folder


SIX = {
    "rostopic echo -p": "field.velocity",
    "UR RTDE": "actual_current",
    "JSON of ros2 topic echo": "effort",
    "LeRobot 0.7": "observation.state",
    "libfranka": "state.dq",
    "rosbag 2, MCAP": "joint_states.effort",
}
"""Public shapes, and the channel whose line is edited."""


@pytest.mark.parametrize("name", SIX)
def test_a_schema_is_written_edited_and_read_by_fit_and_watch(name, tmp_path):
    shape = SHAPES[name]
    logs = write_logs(shape, tmp_path / "logs", range(24))
    bad = write_logs(shape, tmp_path / "bad", range(30, 31), fault=True)
    good = write_logs(shape, tmp_path / "good", range(40, 41))
    split = []
    if name.startswith("LeRobot"):  # a data set is a folder of its own
        logs, bad, good = logs / "00" / "x", bad / "30" / "x", good / "40" / "x"
        split = ["--split", "0.5", "--false-alarm-rate", "0.4"]

    schema_file = tmp_path / "logs.toml"
    assert main(["inspect", str(logs), "--schema", str(schema_file), "--out", str(tmp_path)]) == 0
    lines = schema_file.read_text().splitlines()
    edited = [n for n, line in enumerate(lines) if f'channel = "{SIX[name]}"' in line]
    lines[edited[0]] = lines[edited[0]].replace('role = "sense"', 'role = "sense", unit = "1"')
    schema_file.write_text("\n".join(lines))

    out = tmp_path / "m.asm"
    fit = ["fit", str(logs), "--out", str(out), *FAST, *split, "--schema", str(schema_file)]
    assert main(fit) == 0
    spec = load_monitor(out).spec
    assert set(spec.labels) == set(shape.senses)
    assert 1 / spec.dt == pytest.approx(shape.hz, rel=1e-3)
    watch = ["--monitor", str(out), "--out", str(tmp_path / "w"), "--bridge", "1"]
    assert main(["watch", str(bad), *watch]) == 1
    assert main(["watch", str(good), *watch]) in (0, 1)
