"""A DDS topic watched for as long as asked: rows lost, false alarms, and how many rows after a fault the alarm comes.

    python -m tests.dds_arm --seconds 600 --monitor neural_asm

publishes ``/joint_states`` of a synthetic arm at 500 Hz from another process, with types of its own. Its third joint
slips by 0.05 rad for a fifth of a second once every ``--every`` seconds.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.console import Console

from asm_gym.data.sources import lines_from
from asm_gym.episode import Episode
from asm_gym.monitors import make_monitor
from asm_gym.scripts.live_watching import follow

JOINTS = 7
NAMES = [f"panda_joint{j + 1}" for j in range(JOINTS)]
RATE = 500.0
FAULT_S, SLIP, AT = 0.2, 0.05, 2
FREQUENCY = 0.37 * np.arange(1, JOINTS + 1)  # [rad/s]


def arm(k: int, rng: np.random.Generator, rate: float = RATE) -> np.ndarray:
    """(3, J) position [rad], speed [rad/s] and torque of row k: sines, weight and friction, with noise."""
    t, size = k / rate, np.linspace(0.3, 1.0, JOINTS)
    q = size * np.sin(FREQUENCY * t) + 0.2 * np.sin(2.1 * FREQUENCY * t + 1)
    v = size * FREQUENCY * np.cos(FREQUENCY * t) + 0.42 * FREQUENCY * np.cos(2.1 * FREQUENCY * t + 1)
    torque = 3 * np.sin(q) + 0.5 * np.tanh(v / 0.05) + 0.2 * v
    return np.stack([q, v, torque]) + rng.normal(size=(3, JOINTS)) * [[1e-4], [1e-3], [0.05]]


def episode(seed: int, seconds: float = 5.0) -> Episode:
    """A recording of the arm, from anywhere in its motion, as a bag would name it."""
    rng = np.random.default_rng(seed)
    start, rows = int(rng.integers(0, 100_000)), int(seconds * RATE)
    said = np.stack([arm(start + k, rng) for k in range(rows)])  # (T, 3, J)
    kinds = ("position", "velocity", "effort")
    columns = {f"joint_states.{kind}[{n}]": said[:, i, j] for i, kind in enumerate(kinds) for j, n in enumerate(NAMES)}
    return Episode.from_table({"time": np.arange(rows) / RATE, **columns}, success=True)


def publisher(topic: str, *options: str) -> subprocess.Popen[str]:
    """Publishes from another process, once it is up; see ``tests.dds_publisher``."""
    command = [sys.executable, "-m", "tests.dds_publisher", "--topic", topic, *options]
    made = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert made.stdout is not None
    assert made.stdout.readline() == "up\n"
    return made


class Tap:
    """Lines as they pass, of which the newest stamp is kept.

    Args:
        lines: JSON, with ``time``.
    """

    def __init__(self, lines: Iterator[str]) -> None:
        self.lines, self.stamp = lines, 0.0

    def __iter__(self) -> Iterator[str]:
        for line in self.lines:
            self.stamp = json.loads(line)["time"]
            yield line


class Said(io.StringIO):
    """What is said, and at which row and moment.

    Args:
        tap: of the rows.
    """

    def __init__(self, tap: Tap) -> None:
        super().__init__()
        self.tap, self.lines = tap, list[tuple[float, float, str]]()

    def write(self, text: str) -> int:
        if text.strip():
            self.lines.append((self.tap.stamp, time.time(), text.strip()))
        return super().write(text)


def watched(monitor: Any, topic: str, seconds: float, every: float) -> dict[str, Any]:
    """What came of watching the topic for so long."""
    there = publisher(topic, "--seconds", str(seconds), "--every", str(every))
    try:
        tap = Tap(lines_from(f"dds:{topic}", sys.stdin, 1.0))
        said = Said(tap)
        follow(tap, monitor, Console(file=said, width=200))
        out, _ = there.communicate(timeout=30)
    finally:
        there.kill()
    faults = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    alarms = [line for line in said.lines if "thresholds" in line[2]]
    rows, delays = [], []
    for fault in faults:
        after = [line for line in alarms if -0.5 / RATE < line[0] - fault["stamp"] < 2 * FAULT_S]
        if after:
            rows.append(round((after[0][0] - fault["stamp"]) * RATE) + 1)
            delays.append(1e3 * (after[0][1] - fault["written"]))
        alarms = [line for line in alarms if line not in after]
    return {
        "seconds": seconds,
        "faults": len(faults),
        "found within two rows": sum(n <= 2 for n in rows),
        "rows to the alarm, at most": max(rows, default=None),
        "ms from written to alarm: median": float(np.median(delays)) if delays else None,
        "at most": max(delays, default=None),
        "other alarms": len(alarms),
        "lost": [line[2] for line in said.lines if "lost" in line[2]],
        "said last": said.lines[-1][2],
    }


def fitted(name: str, learned: int = 24, calibrated: int = 39) -> Any:
    """A monitor of the arm, of so many pieces of 5 s; its promise is of one without an alarm in 39 of 40."""
    settings = {"values": True} if name == "neural_asm" else {}  # as asm-gym fit makes it of a log
    made = make_monitor(name, episode(0).spec, **settings).fit([episode(n) for n in range(learned)])
    return made.calibrate([episode(100 + n) for n in range(calibrated)], 0.025)


def main() -> None:
    """Watches, and prints what came of it."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seconds", type=float, default=600.0)
    options.add_argument("--every", type=float, default=20.0)
    options.add_argument("--monitor", default="neural_asm")
    args = options.parse_args()
    monitor = fitted(args.monitor, 80, 79)  # 13 minutes of it
    print(json.dumps(watched(monitor, "/joint_states", args.seconds, args.every), indent=1))


if __name__ == "__main__":
    main()
