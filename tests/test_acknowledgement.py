"""What a person does about an incident: acknowledge, snooze, look at its rows; and the threshold that follows."""

from __future__ import annotations

import csv
import json
import queue
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.data.logs import Log
from asm_gym.detection.adaptive import AdaptiveThreshold
from asm_gym.detection.following_threshold import FollowingThreshold
from asm_gym.evaluation.incident_window import IncidentWindow
from asm_gym.evaluation.recorded_alarms import HEADINGS, alarms_of, by_hour, traces_of
from asm_gym.guard.live_events import LiveEvent
from asm_gym.guard.live_watch import follow
from asm_gym.guard.operator_orders import ACKNOWLEDGE, SNOOZE, Order, order_in, without_orders
from asm_gym.guard.watch_settings import WatchSettings
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.expectation import Expectation, shifts_kept_in
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.needs import needs

SPEC = StreamSpec(
    (
        Channel("q", 2, "rad", noise=0.01, group="joint"),
        Channel("sum", 1, "rad", noise=0.01, group="sum"),
        Channel("cmd", 1, group=MOTOR),
    ),
    dt=0.05,
)
SHIFTED = 300  # row from which a sensor reads another level
SHIFT = 0.6


def motion(seed: int, rows: int = 160) -> np.ndarray:
    """Rows of two joints that follow a command, and of their sum."""
    rng = np.random.default_rng(seed)
    command = np.sin(0.1 * np.arange(rows) + rng.uniform(0, 6))
    q = np.stack([command, 0.5 * command], axis=1) + 0.01 * rng.normal(size=(rows, 2))
    both = q.sum(axis=1) + 0.01 * rng.normal(size=rows)
    return np.column_stack([q, both, command])


@pytest.fixture(scope="module")
def memory() -> NeuralASM:
    episodes = [Episode.from_stream(motion(seed), SPEC) for seed in range(60)]
    made = NeuralASM(SPEC, hidden_size=16, association_size=16, epochs=4).fit(episodes[:20])
    made.calibrate(episodes[20:], false_alarm_rate=0.05)
    return made.with_threshold(4 * made.threshold)  # no false alarm in these minutes


def shifted(rows: int = 1200) -> np.ndarray:
    """Rows in which a sensor reads another level from SHIFTED on."""
    stream = motion(500, rows)
    stream[SHIFTED:, 2] += SHIFT
    return stream


def lines(stream: np.ndarray, orders: dict[int, str] | None = None):
    """Rows as JSON lines, with the orders of a person before rows."""
    for index, row in enumerate(stream):
        if orders and index in orders:
            yield orders[index]
        yield json.dumps(row.tolist())


def watched(memory, stream, orders=None, **settings) -> list[LiveEvent]:
    """All events of a watch."""
    events: list[LiveEvent] = []
    taken: queue.Queue[Order] = queue.Queue()
    source = without_orders(lines(stream, orders), taken)
    follow(source, memory, events.append, WatchSettings(orders=taken, **settings))
    return events


def alarms(events: list[LiveEvent]) -> list[tuple[int, str]]:
    """Row and channel of each alarm."""
    found = [event for event in events if event.kind == "alarm"]
    return [(round(event.time / SPEC.dt), event.channel) for event in found]


def notes(events: list[LiveEvent]) -> str:
    """All notes, a line each."""
    return "\n".join(event.text for event in events if event.kind == "note")


def test_a_level_that_stays_is_one_incident_live_and_in_a_recording(memory):
    events = watched(memory, shifted())
    (trace,) = traces_of([Log("log", Episode.from_stream(shifted(), SPEC))], memory)
    recorded = alarms_of(trace, expectation=Expectation(memory))
    assert len(alarms(events)) == 1
    assert [round(alarm.start / SPEC.dt) for alarm in recorded] == [alarms(events)[0][0]]


def test_an_alarm_tells_what_was_sensed_and_what_was_expected(memory):
    stream = shifted(400)
    (alarm,) = [event for event in watched(memory, stream) if event.kind == "alarm"]
    row = round(alarm.time / SPEC.dt) - 1
    told = json.loads(alarm.to_json())
    assert (told["channel"], told["group"], told["unit"], told["sign"]) == (
        *("sum", "sum", "rad", "+"),
    )
    assert told["sensed"] == pytest.approx(stream[row, 2], abs=1e-5)
    assert told["expected"] == pytest.approx(stream[row, :2].sum(), abs=4 * told["plus_minus"])
    assert told["plus_minus"] < 0.1
    assert told["incident"] == 1


def test_an_acknowledged_level_is_usual_from_then_on_and_another_cause_is_told(memory):
    stream = shifted(3200)
    stream[2900:, 0] += SHIFT
    events = watched(memory, stream, orders={420: "acknowledge"})
    assert "incident 1 is acknowledged: sum +0.5" in notes(events)
    assert [row > 2890 for row, _ in alarms(events)] == [False, True]
    assert alarms(events)[1][1] == "q[0]"  # the level that was learned is no suspect
    learned = float(notes(events).split("sum +")[1].split()[0])
    assert learned == pytest.approx(SHIFT, abs=0.05)


def test_a_channel_that_is_named_is_acknowledged_once_it_is_steady(memory, tmp_path):
    kept = tmp_path / "kept.asm"
    events = watched(memory, shifted(), acknowledges=("sum",), keep=kept)
    assert "incident 1 is acknowledged" in notes(events)
    again = NeuralASM.load(kept)
    (shift,) = shifts_kept_in(again.about)
    assert (shift.channel, shift.unit) == ("sum", "rad")
    assert shift.shift == pytest.approx(SHIFT, abs=0.05)
    assert alarms(watched(again, shifted()[SHIFTED + 5 :])) == []
    (trace,) = traces_of([Log("log", Episode.from_stream(shifted()[SHIFTED + 5 :], SPEC))], again)
    assert alarms_of(trace) == []
    assert "end with this run" in notes(watched(memory, shifted(), acknowledges=("all",)))


def test_an_order_that_fits_no_incident_says_so(memory):
    events = watched(memory, shifted(400), orders={20: "acknowledge", 30: "snooze 5 7"})
    assert "acknowledge: no incident is open" in notes(events)
    assert "snooze: incident 7 is not open" in notes(events)
    assert len(alarms(events)) == 1
    events = watched(memory, motion(501, 100), orders={20: "acknowledge nonsense"})
    assert "cannot be obeyed" in notes(events)


def test_a_channel_that_is_not_steady_is_not_acknowledged(memory):
    stream = shifted(500)
    stream[SHIFTED:, 2] += SHIFT * np.sign(np.sin(np.arange(200)))
    events = watched(memory, stream, orders={450: "acknowledge"})
    assert "is not acknowledged" in notes(events)


def test_a_snoozed_incident_is_silent_and_another_is_not(memory):
    stream = motion(502, 6000)
    for first in (300, 3000, 5400):  # longer than a minute between two of them
        stream[first : first + 40, 2] += SHIFT * np.sign(np.sin(np.arange(40)))
    every = [row for row, _ in alarms(watched(memory, stream))]
    assert [round(row, -2) for row in every] == [300, 3000, 5400]
    silent = [row for row, _ in alarms(watched(memory, stream, orders={330: "snooze 200"}))]
    assert [round(row, -2) for row in silent] == [300, 5400]


@pytest.mark.parametrize(
    ("line", "order"),
    [
        ("acknowledge", Order(ACKNOWLEDGE)),
        ("Acknowledge 3\n", Order(ACKNOWLEDGE, incident=3)),
        ("snooze", Order(SNOOZE)),
        ("snooze 60 2", Order(SNOOZE, incident=2, seconds=60.0)),
        ("[1, 2]", None),
        ("", None),
    ],
)
def test_orders_are_read_from_lines(line, order):
    assert order_in(line) == order


@pytest.mark.parametrize("line", ["snooze -1", "snooze inf", "acknowledge 1 2", "snooze x"])
def test_an_order_that_cannot_be_read_says_how_to_write_it(line):
    order = order_in(line)
    assert order is not None
    assert line in order.problem


def test_the_rows_around_an_incident_are_a_file_live_too(memory, tmp_path):
    stream = shifted(600)
    events = watched(memory, stream, evidence=tmp_path)
    (alarm,) = [event for event in events if event.kind == "alarm"]
    with Path(alarm.evidence).open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    times = np.array([float(line["time [s]"]) for line in table])
    assert times[0] == pytest.approx(alarm.time - 5.0, abs=2 * SPEC.dt)
    assert times[-1] == pytest.approx(alarm.time + 5.0, abs=2 * SPEC.dt)
    first = round(times[0] / SPEC.dt) - 1
    sensed = np.array([float(line["sum"]) for line in table])
    np.testing.assert_allclose(sensed, stream[first : first + len(sensed), 2], atol=1e-5)
    expected = np.array([float(line["expected sum"]) for line in table])
    np.testing.assert_allclose(sensed - expected, SHIFT * (times > SHIFTED * SPEC.dt), atol=0.15)


def test_rows_that_cannot_be_written_are_a_note_and_no_alarm_is_lost(memory, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    events = watched(memory, shifted(600), evidence=blocked)
    assert len(alarms(events)) == 1
    assert notes(events).count("cannot be written") == 1


def test_a_guard_acknowledges_and_says_where_nothing_is_open(memory):
    from asm_gym.guard.adapter import SensedRows
    from asm_gym.guard.guard import Guard
    from asm_gym.guard.options import GuardOptions
    from asm_gym.guard.robot_facts import RobotFacts

    options = GuardOptions("monitor", contact_limits=None)
    guard = Guard(RobotFacts.unknown(SPEC), memory, options)
    guard.begin()
    with pytest.raises(ValueError, match="no incident is open"):
        guard.acknowledge()

    def judge(stream):
        action = np.zeros((1, 1), np.float32)
        return [
            bool(guard.judge(SensedRows(np.float32(row)[None]), action).robots["over"][0])
            for row in stream
        ]

    stream = shifted(800)
    assert any(judge(stream[: SHIFTED + 100]))
    shift = guard.acknowledge()
    assert shift.channel == "sum"
    assert not any(judge(stream[SHIFTED + 100 :])[100:])


def test_the_state_of_a_threshold_that_follows_outlives_the_run(tmp_path):
    path = tmp_path / "state.json"
    first = FollowingThreshold.open(path, calibrated=10.0, per_hour=1.0, dt=1.0)
    for minute in range(5):
        for second in range(60):
            ended = first.add(15.0 if second == 30 and minute < 2 else 1.0)
        assert ended
    first.save()
    oracle = AdaptiveThreshold(1 / 60).start(10.0)
    for minute in range(5):
        oracle.follow(15.0 if minute < 2 else 1.0)
    assert first.value == pytest.approx(oracle.value)
    again = FollowingThreshold.open(path, calibrated=10.0, per_hour=1.0, dt=1.0)
    assert again.value == pytest.approx(first.value)
    with pytest.raises(ValueError, match="give another file"):
        FollowingThreshold.open(path, calibrated=11.0, per_hour=1.0, dt=1.0)
    path.write_text("[]")
    with pytest.raises(ValueError, match="no state of a threshold"):
        FollowingThreshold.open(path, calibrated=10.0, per_hour=1.0, dt=1.0)


def test_a_recording_is_judged_relative_to_the_threshold_that_follows(tmp_path):
    def opened():
        return FollowingThreshold.open(tmp_path / "x", calibrated=2.0, per_hour=1.0, dt=1.0)

    surprise = np.random.default_rng(0).exponential(size=400)
    live = opened()
    expected = []
    for value in surprise:
        expected.append(value / live.value)
        live.add(float(value))
    np.testing.assert_allclose(opened().relative(surprise), expected)


def test_a_confirmed_minute_does_not_move_the_threshold(tmp_path):
    following = FollowingThreshold.open(tmp_path / "x", calibrated=2.0, per_hour=1.0, dt=1.0)
    following.confirm()
    for _ in range(60):
        following.add(5.0)
    assert following.value == pytest.approx(2.0)


def log_of(folder, stream) -> str:
    """A log with dates, one row every 50 ms from 22:59:50 UTC on."""
    origin = 1_780_354_790.0
    names = "time [s],q[0],q[1],sum,cmd"
    rows = [
        f"{origin + SPEC.dt * k:.3f}," + ",".join(f"{x:.6f}" for x in row)
        for k, row in enumerate(stream)
    ]
    path = folder / "log.csv"
    path.write_text("\n".join([names, *rows]) + "\n")
    return str(path)


def test_a_report_counts_alarms_by_hour_of_the_day_and_names_their_files(memory, tmp_path, capsys):
    needs("matplotlib")
    memory.save(tmp_path / "x.asm")
    source = log_of(tmp_path, shifted(600))
    out = tmp_path / "out"
    command = ["watch", source, "--monitor", str(tmp_path / "x.asm"), "--out", str(out)]
    assert main([*command, "--follow-threshold", str(tmp_path / "state.json"), "--json"]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (alarm,) = [event for event in events if event["kind"] == "alarm"]
    assert alarm["expected"] == pytest.approx(alarm["sensed"] - SHIFT, abs=0.15)
    with (out / alarm["evidence"]).open(encoding="utf-8", newline="") as file:
        window = list(csv.DictReader(file))
    assert len(window) == round(10.0 / SPEC.dt) + 1
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "an hour" in report
    assert alarm["evidence"] in report
    assert json.loads((tmp_path / "state.json").read_text())["calibrated"] > 0


def test_a_report_notes_that_the_rows_around_an_alarm_cannot_be_written(memory, tmp_path, capsys):
    memory.save(tmp_path / "x.asm")
    source = log_of(tmp_path, shifted(600))
    out = tmp_path / "out"
    out.mkdir()
    (out / "incidents").write_text("no folder")
    command = ["watch", source, "--monitor", str(tmp_path / "x.asm"), "--out", str(out), "--json"]
    assert main(command) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (alarm,) = [event for event in events if event["kind"] == "alarm"]
    assert alarm["evidence"] == ""
    (note,) = [event["text"] for event in events if event["kind"] == "note"]
    assert str(out / "incidents") in note


def test_alarms_are_counted_by_the_hour_in_which_they_began(memory):
    stream = shifted(600)
    (trace,) = traces_of([Log("log", Episode.from_stream(stream, SPEC))], memory)
    trace = replace(trace, origin=1_780_354_790.0)  # 22:59:50 UTC
    table = by_hour(alarms_of(trace), hours=0.5)
    assert [(row[0][:2], row[1]) for row in table.rows] == [("23", "1")]
    assert "2 an hour" in table.caption


def test_a_report_shows_the_channel_of_an_alarm_beside_what_was_expected_in_the_second_around_it(
    memory, tmp_path, capsys
):
    needs("matplotlib")
    memory.save(tmp_path / "x.asm")
    command = ["watch", log_of(tmp_path, shifted(600)), "--monitor", str(tmp_path / "x.asm")]
    assert main([*command, "--out", str(tmp_path)]) == 1
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    (caption,) = re.findall(r"cards.*?<figcaption>(.*?)</figcaption>", report, re.DOTALL)
    (said,) = re.findall(r"sum read (\S+) rad; from the other senses (\S+) ± (\S+) rad", caption)
    sensed, expected, plus_minus = map(float, said)
    assert sensed - expected == pytest.approx(SHIFT, abs=0.15)
    assert 0 < plus_minus < 0.1
    with (tmp_path / "alarms.csv").open(encoding="utf-8", newline="") as file:
        (alarm,) = csv.DictReader(file)
    assert float(alarm["sensed"]) == pytest.approx(sensed, abs=1e-3)

    window = IncidentWindow(
        times=[SPEC.dt * k for k in range(100)],
        rows=shifted(600)[250:350],
        surprise=[0.0] * 100,
        labels=SPEC.labels,
        column=2,
    )
    moment = window.moment(SPEC.dt * 50, Expectation(memory))
    assert (moment.times[0], moment.times[-1]) == pytest.approx((-0.5, 0.5))
    deviation = moment.sensed - moment.expected
    np.testing.assert_allclose(deviation, SHIFT * (moment.times > -SPEC.dt / 2), atol=0.15)


def test_a_reader_sees_a_capped_surprise_and_a_file_holds_the_number(memory):
    far = shifted(600)
    far[SHIFTED:, 2] += 50.0
    sharp = memory.with_threshold(memory.threshold / 4)
    (trace,) = traces_of([Log("log", Episode.from_stream(far, SPEC))], sharp)
    alarm = max(alarms_of(trace), key=lambda each: each.excess)
    assert alarm.excess > 1000
    column = HEADINGS.index("thresholds")
    assert float(alarm.cells()[column]) == pytest.approx(alarm.excess, abs=0.01)
    assert alarm.cells(to_read=True)[column] == "> 1000"
    assert "(> 1000 thresholds)" in alarm.in_words()
    events = [event for event in watched(sharp, far) if event.kind == "alarm"]
    live = max(events, key=lambda event: event.thresholds)
    assert live.thresholds > 1000
    assert "> 1000 thresholds" in live.text
