"""A simulated day of an arm at work: eight hours of motion with ten events, and the incidents that a watch makes of it.

The synthetic arm goes through five poses again and again and grips between them; its rows also hold a force at the
wrist and the width of the gripper. A memory learns from recordings of other days. Each event lasts ten minutes; the
last begins while the one before it lasts.

An incident belongs to an event if it begins while the event lasts, or within a minute after; any other is a false one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.data.episode import Episode
from asm_gym.data.logs import Log
from asm_gym.detection.alarm_rule import MINUTE
from asm_gym.evaluation.recorded_alarms import Alarm, alarms_of, traces_of
from asm_gym.files import written_whole
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.synthetic_arm import CONTROL_PERIOD_S, JOINTS, SyntheticArm, _advance

Floats = NDArray[np.float64]

EVERY = 5  # control periods in a row
POSES = np.random.default_rng(5).uniform(-0.7, 0.7, (5, JOINTS))  # [rad]
POSE_S = 2.0  # from pose to pose [s]
SPREAD = 0.02  # standard deviation of a pose from round to round [rad]
GAIN = 4.0  # of the position error [1/s]
OPEN, CLOSED = 0.08, 0.03  # width of the gripper [m]
GRIPPER_S = 0.15  # in which it moves [s]
LOG_S = 60.0  # length of a recording to learn from [s]
MORNING = 1_780_300_800.0  # stamp of the day's first row: 2026-06-01, 08:00 UTC [s]

SPEC = StreamSpec(
    (
        Channel("q", JOINTS, "rad", noise=1e-4, group="joint"),
        Channel("dq", JOINTS, "rad/s", noise=2e-3, group="joint"),
        Channel("tau", JOINTS, "N m", noise=0.05, group="torque"),
        Channel("force", 3, "N", noise=0.05, group="wrench"),
        Channel("width", 1, "m", noise=1e-4, group="gripper"),
        Channel("command", JOINTS, "rad/s", group=MOTOR),
        Channel("grip", 1, group=MOTOR),
    ),
    dt=EVERY * CONTROL_PERIOD_S,
    source="table",
)
# A small memory learns such repeated work in a minute.
SMALL: dict[str, Any] = {"hidden_size": 64, "association_size": 160, "epochs": 10}
FORCE = SPEC.slices["force"].start
WIDTH = SPEC.slices["width"].start
TORQUE = SPEC.slices["tau"].start
VELOCITY = SPEC.slices["dq"].start


@dataclass(frozen=True)
class Config(kit.Config):
    """A simulated day: incidents against truth."""

    seeds: int = option(1, least=1)
    """Number of days."""
    hours: float = option(8.0, quick=0.5, least=0.01)
    """Length of the day."""
    logs: int = option(30, quick=10, least=2)
    """Recordings of a minute to learn from."""
    calibration: int = option(240, quick=70, least=2)
    """Recordings of a minute that set the threshold."""
    per_hour: float = option(1.0, least=1e-3)
    """Promised false incidents an hour."""
    memory: Path | None = option(None, metavar="FILE.asm")
    """Memory that an earlier run learned, day.asm in its folder."""


class Day(NamedTuple):
    """What changes in a simulation, by control period."""

    pace: Floats  # (N,) speed of the job, 1 as learned
    load: Floats  # (N,) payload, 1 as learned
    home: Floats  # (N,) shift of all poses of the first joint [rad]

    @classmethod
    def usual(cls, seconds: float) -> Self:
        """Return a day on which nothing changes."""
        count = round(seconds / CONTROL_PERIOD_S)
        return cls(pace=np.ones(count), load=np.ones(count), home=np.zeros(count))


class Event(NamedTuple):
    """What happens, and when."""

    name: str
    start: float  # [s]
    end: float  # [s]
    channels: tuple[str, ...]  # that show it; empty if the whole arm does

    def holds(self, alarm: Alarm) -> bool:
        """Return whether an alarm began while it lasted, or within a minute after."""
        return self.start < alarm.start <= self.end + MINUTE


@compiled
def _work(day: Day, targets: Floats, inverse: Floats) -> Floats:
    """Return rows (T, D) without noise, of a day with poses (K, 7) one after another."""
    count = len(day.pace)
    rows = np.zeros((count // EVERY, 3 * JOINTS + 4 + JOINTS + 1))
    q = targets[0].copy()
    v = np.zeros(JOINTS)
    width = OPEN
    phase = 0.0
    for t in range(len(rows) * EVERY):
        phase += day.pace[t] * CONTROL_PERIOD_S / POSE_S
        k = int(phase)
        s = phase - k
        share = 10 * s**3 - 15 * s**4 + 6 * s**5
        rate = (30 * s**2 - 60 * s**3 + 30 * s**4) * day.pace[t] / POSE_S
        way = targets[k + 1] - targets[k]  # (7,)
        reference = targets[k] + share * way
        reference[0] += day.home[t]
        command = rate * way + GAIN * (reference - q)
        before = v
        q, v, torque = _advance(q, v, command, (day.load[t], 0.0, 1.0), inverse)

        gripping = (k % 5 == 1) or (k % 5 == 2)
        goal = CLOSED if gripping else OPEN
        width += (goal - width) * CONTROL_PERIOD_S / GRIPPER_S
        if t % EVERY:
            continue
        acceleration = (v - before) / CONTROL_PERIOD_S
        row = rows[t // EVERY]
        row[:7] = q
        row[7:14] = v
        row[14:21] = torque
        row[21] = 0.5 * acceleration[3] + 0.2 * acceleration[1]
        row[22] = 0.5 * acceleration[5]
        row[23] = 2.0 * day.load[t] * np.cos(q[:4].sum()) + 0.3 * acceleration[1]
        row[24] = width
        row[25:32] = command
        row[32] = 1.0 if gripping else 0.0
    return rows


def simulated(day: Day, seed: int) -> Floats:
    """Return the rows (T, D) of a day, as sensed."""
    rng = np.random.default_rng(seed)
    rounds = int(day.pace.sum() * CONTROL_PERIOD_S / POSE_S) // len(POSES) + 2
    targets = np.tile(POSES, (rounds, 1))
    targets[1:] += rng.normal(0.0, SPREAD, (len(targets) - 1, JOINTS))
    rows = _work(day, targets, SyntheticArm()._inverse)
    noise: Floats = rows + SPEC.noise * rng.standard_normal(rows.shape)
    return noise


def recording(seed: int, seconds: float = LOG_S) -> Episode:
    """Return a recording of usual work."""
    return Episode.from_stream(simulated(Day.usual(seconds), seed), SPEC)


def learned(config: Config) -> NeuralASM:
    """Return a memory of usual work, with its promise by the hour."""
    fitting = [recording(10_000 + n) for n in range(config.logs)]
    calibration = [recording(20_000 + n) for n in range(config.calibration)]
    memory = NeuralASM(SPEC, **SMALL, seed=config.seed).fit(fitting)
    return memory.calibrate(calibration, false_alarms_per_hour=config.per_hour)


# ------------------------------------------------------------------ events


def span_of(event: Event, period: float) -> slice:
    """Return the indices of an event, at a period [s]."""
    return slice(round(event.start / period), round(event.end / period))


def events_of(hours: float) -> list[Event]:
    """Return the ten events of a day; the last two overlap."""
    names = (
        ("force sensor reads 0.5 N more", ("force[0]",)),
        ("gripper opens 5 mm wider", ("width",)),
        ("speed override 70 %", ()),
        ("speed override 130 %", ()),
        ("payload 30 % heavier", ()),
        ("another home, joint 0 by 0.2 rad", ()),
        ("velocity 2 frozen", ("dq[2]",)),
        ("encoder 3 wrapped by a turn", ("q[3]",)),
        ("torque sensor 1 reads 3 N m more", ("tau[1]",)),
        ("gripper opens 5 mm wider, meanwhile", ("width",)),
    )
    slot = 3600.0 * hours / (len(names) + 0.5)  # one after another, with a rest between
    length = min(600.0, 0.5 * slot)
    events: list[Event] = []
    for n, (name, channels) in enumerate(names):
        start = (n + 0.5) * slot
        if n == len(names) - 1:
            start = events[-1].start + 0.5 * length  # while the one before lasts
        events.append(Event(name, start, start + length, channels))
    return events


def changed_day(hours: float, events: Sequence[Event]) -> Day:
    """Return what the events change in the simulation."""
    day = Day.usual(3600.0 * hours)
    spans = [span_of(event, CONTROL_PERIOD_S) for event in events]
    day.pace[spans[2]] = 0.7
    day.pace[spans[3]] = 1.3
    day.load[spans[4]] = 1.3
    day.home[spans[5]] = 0.2
    return day


def disturb(rows: Floats, events: Sequence[Event]) -> None:
    """Write what the events change in the sensors to rows (T, D)."""
    spans = [span_of(event, SPEC.dt) for event in events]
    rows[spans[0], FORCE] += 0.5
    for span in (spans[1], spans[9]):
        is_open = rows[span, WIDTH] > 0.5 * (OPEN + CLOSED)
        rows[span, WIDTH] += 0.005 * is_open
    rows[spans[6], VELOCITY + 2] = rows[spans[6].start, VELOCITY + 2]
    rows[spans[7], 3] += 2 * np.pi
    rows[spans[8], TORQUE + 1] += 3.0


# ------------------------------------------------------------------ results


def watch_day(config: Config, memory: NeuralASM, seed: int) -> tuple[list[Event], list[Alarm]]:
    """Return the events of a day and its incidents; write the day as a log."""
    events = events_of(config.hours)
    rows = simulated(changed_day(config.hours, events), 30_000 + seed)
    disturb(rows, events)
    write_log(config.out / f"day_{seed}.parquet", rows)
    episode = Episode.from_stream(rows, SPEC)
    (trace,) = traces_of([Log("day", episode)], memory)
    return events, alarms_of(trace)


def write_log(path: Path, rows: Floats) -> None:
    """Write rows (T, D) as a log that asm-gym watch reads."""
    table = pd.DataFrame(rows.astype(np.float32), columns=list(SPEC.labels))
    table.insert(0, "time [s]", MORNING + SPEC.dt * np.arange(len(rows)))
    with written_whole(path) as file:
        table.to_parquet(file, index=False)


def run(config: Config) -> Findings:
    """Learn, simulate the days, and hold their incidents against the events."""
    if config.memory is not None:
        memory = NeuralASM.load(config.memory)
    else:
        memory = learned(config)
        memory.save(config.out / "day.asm")
    records = []
    false = 0
    for seed in config.repetitions:
        events, alarms = watch_day(config, memory, seed)
        for event in events:
            own = [alarm for alarm in alarms if owner(alarm, events) is event]
            records.append({"seed": seed} | record_of(event, own))
        false += sum(owner(alarm, events) is None for alarm in alarms)
    quiet = config.hours * len(config.repetitions)
    rate = f"{false / quiet:.3g} false incidents an hour, {config.per_hour:g} promised"
    caption = f"Ten events in a day of {config.hours:g} hours of motion: {rate}."
    rows = [{name: str(value) for name, value in record.items()} for record in records]
    return Findings(records, [kit.table_of(caption, rows)])


def owner(alarm: Alarm, events: Sequence[Event]) -> Event | None:
    """Return the event that an incident belongs to; of two that overlap, the one whose channel it names."""
    holding = [event for event in events if event.holds(alarm)]
    for event in holding:
        if alarm.channel in event.channels:
            return event
    return holding[0] if holding else None


def record_of(event: Event, own: Sequence[Alarm]) -> dict[str, object]:
    """Return a line of the table: an event beside its incidents."""
    delay = ""
    named = ""
    called = ""
    if own:
        delay = f"{own[0].start - event.start:.2f}"
        named = own[0].channel
        called = own[0].cause
    return {
        "event": event.name,
        "from [h]": f"{event.start / 3600:.2f}",
        "truth": "1",
        "incidents": len(own),
        "first after [s]": delay,
        "names": named,
        "of": ", ".join(event.channels) or "the whole arm",
        "called": called,
    }
