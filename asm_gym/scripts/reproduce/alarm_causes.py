"""What an alarm points to, and what it is called: faults and events of known cause on a simulated arm of seven joints.

The arm repeats a programme of ten poses, which differ a little from log to log. One channel of each group is shifted,
frozen, or wrapped by a turn; and the arm goes slower or faster, waits, carries a payload, or has another home.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.data.logs import Log
from asm_gym.evaluation.recorded_alarms import alarms_of, traces_of
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, percent
from asm_gym.monitors import NeuralASM, named_causes
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.day import SMALL
from asm_gym.scripts.reproduce.kit import Findings
from asm_gym.synthetic_arm import JOINTS, SyntheticArm

Floats = NDArray[np.float64]

SPEC = SyntheticArm.stream_spec
DT = SPEC.dt
POSES = 10
MOVE_S = 1.6  # duration of a move [s]
REST_S = 0.4  # rest after it [s]
GAIN = 4.0  # of the position error in the command [1/s]
POSE_SPREAD = 0.03  # by which poses differ from log to log [rad]
FALSE_ALARM_RATE = 0.05
SIZES = (0.05, 0.2, 1.0, 3.0, 10.0)  # of shifts, in ranges of the channel
ONSET_S = 6.0  # when a fault or an event begins [s]
LASTS_S = 6.0  # for how long it is watched [s]
SPEED_UP_S = 0.3  # in which the pace changes [s]
TURN = 2 * np.pi
NEW_HOME = np.array([0.3, -0.3, 0.3, -0.3, 0.3, -0.3, 0.3])  # [rad]
OFFSET = 0.15  # of the range, of a level shift that is to be named
PAYLOAD_KG = 0.5
TASK_SEED = 0  # of the programme
HELD_OUT = 10_000  # first seed of logs that are not learned from
GROUPS = ("position", "velocity", "torque", "command")


@dataclass(frozen=True)
class Config(kit.Config):
    """Blame and names of causes on a simulated arm."""

    seeds: int = option(1, quick=1, least=1)
    """Number of memories."""
    logs: int = option(50, quick=40, least=40)
    """Logs to learn from and to calibrate on, half each."""
    log_s: float = option(20.0, quick=4.0)
    """Length of a log [s]."""
    repeats: int = option(5, quick=1, least=1)
    """Faults of each channel, and events of each kind, at each size."""
    every: int = option(1, quick=9, least=1)
    """One in so many channels has faults."""


@dataclass
class Event:
    """What happens to the arm from ``ONSET_S`` on."""

    pace: float = 1.0
    payload: float = 0.0  # [kg]
    home: Floats = field(default_factory=lambda: np.zeros(JOINTS))  # [rad]


class Fault(NamedTuple):
    """What is wrong with one channel from ``ONSET_S`` on."""

    kind: str  # "shift", "frozen" or "wrapped"
    column: int
    size: float = 0.0  # ranges


class Programme:
    """Positions of the arm over the time of its programme, in one log."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 7])
        learned = np.random.default_rng(TASK_SEED).uniform(-0.7, 0.7, (POSES, JOINTS))
        self.poses = learned + rng.normal(0.0, POSE_SPREAD, (POSES, JOINTS))
        self.sway = rng.uniform(0.005, 0.02, JOINTS)  # [rad]
        self.phase = rng.uniform(0.0, TURN, JOINTS)
        self.start = rng.uniform(0.0, POSES * (MOVE_S + REST_S))  # [s]
        self.frequency = np.linspace(0.5, 1.5, JOINTS)  # [Hz]

    def __call__(self, time: float) -> Floats:
        """Return the positions (7,) at a time of the programme [rad]."""
        move, since = divmod(time, MOVE_S + REST_S)
        s = min(since / MOVE_S, 1.0)
        share = 10 * s**3 - 15 * s**4 + 6 * s**5
        start = self.poses[int(move) % POSES]
        end = self.poses[int(move + 1) % POSES]
        sway = self.sway * np.sin(TURN * self.frequency * time + self.phase)
        return np.asarray(start + share * (end - start) + sway)


def recorded(seed: int, seconds: float, event: Event | None = None) -> NDArray[np.float32]:
    """Return the rows (T, 28) of a log, in which an event happens."""
    event = event or Event()
    programme = Programme(seed)
    arm = SyntheticArm(horizon=round(seconds / DT))
    observation, _ = arm.reset(seed=seed)
    time = programme.start
    arm.begin_at(programme(time) + event.home)
    observation[:JOINTS] = programme(time) + event.home
    rows = []
    for step in range(arm.horizon):
        since = step * DT - ONSET_S
        pace = 1.0 + (event.pace - 1.0) * float(np.clip(since / SPEED_UP_S, 0.0, 1.0))
        arm.payload = event.payload * (since >= 0)
        now = programme(time)
        time += pace * DT
        error = now + event.home - observation[:JOINTS]
        command = (programme(time) - now) / DT + GAIN * error
        observation, *_, info = arm.step(command.astype(np.float32))
        rows.append(info["stream"])
    return np.array(rows)


def faulty(rows: NDArray[np.float32], fault: Fault, width: Floats) -> NDArray[np.float32]:
    """Return rows (T, D) with a fault; ``width`` (D,) of the range of each channel."""
    rows = rows.copy()
    since = rows[round(ONSET_S / DT) :, fault.column]  # a view
    if fault.kind == "frozen":
        since[:] = since[0]
    elif fault.kind == "wrapped":
        since += TURN
    else:
        since += fault.size * width[fault.column]
    return rows


def faults(repeat: int, every: int) -> Iterator[Fault]:
    """Yield all faults of one channel, of one in ``every`` channels."""
    sign = (-1.0) ** repeat
    for column in range(0, SPEC.size, every):
        for size in SIZES:
            yield Fault("shift", column, sign * size)
        yield Fault("frozen", column)
        if column < JOINTS:
            yield Fault("wrapped", column)


def memory_of(config: Config, seed: int) -> tuple[NeuralASM, Floats]:
    """Return a memory, and the width (D,) of the range of each channel in the logs it learned from."""
    offset = seed * HELD_OUT * 2
    logs = [recorded(offset + n, config.log_s) for n in range(config.logs)]
    episodes = [Episode.from_stream(rows, SPEC) for rows in logs]
    half = len(episodes) // 2
    memory = NeuralASM(SPEC, seed=seed, **SMALL).fit(episodes[:half])
    memory.calibrate(episodes[half:], FALSE_ALARM_RATE)
    return memory, np.ptp(np.concatenate(logs), axis=0).astype(np.float64)


def blame_records(memory: NeuralASM, width: Floats, config: Config, seed: int) -> list[Any]:
    """Return a record for each fault of one channel: whether it was found, and what was blamed."""
    records = []
    for repeat in range(config.repeats):
        first = seed * HELD_OUT * 2 + HELD_OUT
        healthy = recorded(first + repeat, ONSET_S + LASTS_S)
        cases = list(faults(repeat, config.every))
        logs = [
            Log(str(n), Episode.from_stream(faulty(healthy, fault, width), SPEC))
            for n, fault in enumerate(cases)
        ]
        for fault, trace in zip(cases, traces_of(logs, memory), strict=True):
            alarms = [alarm for alarm in alarms_of(trace) if alarm.start >= ONSET_S]
            label = SPEC.labels[fault.column]
            channel = ""
            if alarms:
                channel = alarms[0].channel
            joint = label[label.index("[") :]
            records.append(
                {
                    "seed": seed,
                    "fault": fault.kind,
                    "size": abs(fault.size),
                    "group": GROUPS[fault.column // JOINTS],
                    "channel": label,
                    "blamed": channel,
                    "found": bool(alarms),
                    "exact": channel == label,
                    "joint": channel.endswith(joint),
                    "truth": _truth(fault),
                    "named": _name_of(alarms),
                }
            )
    return records


def _truth(fault: Fault) -> str:
    """Return what a fault should be called."""
    if fault.kind == "shift":
        return named_causes.OFFSET
    return fault.kind


def _name_of(alarms: Sequence[Any]) -> str:
    """Return the name of the cause of the first alarm whose cause is known; empty without an alarm."""
    for alarm in alarms:
        if alarm.cause_name not in ("", named_causes.UNEXPLAINED):
            return str(alarm.cause_name)
    if alarms:
        return named_causes.UNEXPLAINED
    return ""


EVENTS = {
    "healthy": Event(),
    "30 % slower": Event(pace=0.7),
    "30 % faster": Event(pace=1.3),
    "standstill": Event(pace=0.0),
    "payload of 0.5 kg": Event(payload=PAYLOAD_KG),
    "another home": Event(home=NEW_HOME),
}


def event_records(memory: NeuralASM, config: Config, seed: int) -> list[Any]:
    """Return a record for each event: what it was called."""
    records = []
    for number, (truth, event) in enumerate(EVENTS.items()):
        first = seed * HELD_OUT * 2 + HELD_OUT + 1000 * (number + 1)
        logs = [
            Log(str(n), Episode.from_stream(recorded(first + n, ONSET_S + LASTS_S, event), SPEC))
            for n in range(config.repeats)
        ]
        for trace in traces_of(logs, memory):
            named = _name_of(alarms_of(trace))
            records.append({"seed": seed, "truth": truth, "named": named})
    return records


def run(config: Config) -> Findings:
    """Learn, inject, and count what is blamed and named."""
    blame: list[Any] = []
    named: list[Any] = []
    for seed in config.repetitions:
        memory, width = memory_of(config, seed)
        blame += blame_records(memory, width, config, seed)
        named += event_records(memory, config, seed)
    is_named = [r for r in blame if r["fault"] != "shift" or r["size"] in (0.2, 1.0)]
    return Findings(blame + named, [blame_table(blame), causes_table(is_named + named)])


def blame_table(records: Sequence[Any]) -> Table:
    """Return the share of faults whose joint, and whose channel, the first alarm names."""
    rows = []
    for kind, size in dict.fromkeys((r["fault"], r["size"]) for r in records):
        own = [r for r in records if (r["fault"], r["size"]) == (kind, size)]
        found = [r for r in own if r["found"]]
        fault = kind
        if kind == "shift":
            fault = f"shifted by {size:g} ranges"
        row = {"fault of one channel": fault, "in alarm": f"{len(found)} of {len(own)}"}
        for what in ("joint", "exact"):
            row[f"right {what.replace('exact', 'channel')}"] = _share(found, what)
        for group in GROUPS:
            row[group] = _share([r for r in found if r["group"] == group], "exact")
        rows.append(row)
    return kit.table_of("The channel that the first row in alarm points to", rows)


def _share(records: Sequence[Any], what: str) -> str:
    """Return the share of records in which something holds."""
    if not records:
        return ""
    return percent(Share(sum(r[what] for r in records), len(records)))


def causes_table(records: Sequence[Any]) -> Table:
    """Return truth against name."""
    truths = dict.fromkeys(r["truth"] for r in records)
    names = [*named_causes.REMEDIES, ""]
    rows = []
    for truth in truths:
        counts = Counter(r["named"] for r in records if r["truth"] == truth)
        row = {"truth": truth}
        for name in names:
            row[name or "no alarm"] = str(counts[name] or "")
        rows.append(row)
    return kit.table_of("What happened, and what it was called", rows)
