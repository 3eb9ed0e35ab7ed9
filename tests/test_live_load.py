"""A watch takes 10,000 rows a second while nobody reads what it prints, and its hook is told at once."""

from __future__ import annotations

import fcntl
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from asm_gym.guard.live_watch import follow
from asm_gym.monitors import NeuralASM, load_monitor
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.streams import swing

SPEC = StreamSpec(
    (Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.02
)
RATE = 10_000  # rows a second
BLOCK = 50  # rows that are written at once
CYCLE = 5_000  # rows from one fault to the next
FAULT = 2_500  # place of the fault in a cycle
SMALL_PIPE_BYTES = 4096
LATEST_S = 10.0  # rows that queue up; alone on the machine the worst took 29 ms
MOST_GROWTH_KB = 4096


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    sizes = {"hidden_size": 8, "association_size": 24, "epochs": 4, "values": False}
    memory = NeuralASM(SPEC, **sizes).fit([swing(SPEC, n) for n in range(24)])
    memory.calibrate([swing(SPEC, 100 + n) for n in range(39)], 0.05)
    memory.threshold_ *= 5.0  # the faults are far above it, and nothing else is
    file = tmp_path_factory.mktemp("memory") / "m.asm"
    memory.save(file)
    return file


def blocks() -> list[bytes]:
    """Return the lines of a cycle without a seam, ``BLOCK`` in each element."""
    rng = np.random.default_rng(0)
    command = np.sin(2.0 * np.pi * 80 / CYCLE * np.arange(CYCLE))
    q = np.stack([command, -command], axis=1) + 0.01 * rng.normal(size=(CYCLE, 2))
    rows = np.column_stack([q, q.sum(axis=1), command])  # (CYCLE, 4)
    rows[FAULT, 2] += 100.0  # not rounded: the memory learned that the torque is the sum of q
    lines = [json.dumps(row) + "\n" for row in rows.tolist()]
    return ["".join(lines[k : k + BLOCK]).encode() for k in range(0, CYCLE, BLOCK)]


def feed(process: subprocess.Popen[bytes], seconds: float) -> tuple[list[float], list[int]]:
    """Write rows at ``RATE``; return when each block was written [s], and memory twice [KB]."""
    cycle = blocks()
    count = int(seconds * RATE) // BLOCK
    written = []
    memory_kb = []
    start = time.time()
    for k in range(count):
        wait = start + k * BLOCK / RATE - time.time()
        if wait > 0:
            time.sleep(wait)
        written.append(time.time())
        process.stdin.write(cycle[k % len(cycle)])
        process.stdin.flush()
        if k in (count // 4, count - 1):
            memory_kb.append(resident_kb(process.pid))
    return written, memory_kb


def resident_kb(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (line,) = [line for line in lines if line.startswith("VmRSS")]
    return int(line.split()[1])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("seconds", [2, pytest.param(60, marks=pytest.mark.slow)])
def test_ten_thousand_rows_a_second_while_nobody_reads(seconds, memory, tmp_path):
    told = tmp_path / "told"
    hook = f'read event; echo "$(date +%s%N) $event" >> {shlex.quote(str(told))}'
    command = [sys.executable, "-m", "asm_gym", "watch", "-", "--json", "--monitor", str(memory)]
    process = subprocess.Popen(
        [*command, "--hook", hook, "--silence", "60"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    fcntl.fcntl(process.stdout, fcntl.F_SETPIPE_SZ, SMALL_PIPE_BYTES)
    process.stdin.write(blocks()[0] + b"no row\n")  # an alarm, once all is compiled
    process.stdin.flush()
    while not told.exists() and process.poll() is None:
        time.sleep(0.1)
    try:
        written, memory_kb = feed(process, seconds)
        process.stdin.close()
        process.wait(30)
    finally:
        process.kill()

    _, *lines = told.read_text().splitlines()
    events = [line.split(" ", 1) for line in lines]
    late_s = []
    for nanoseconds, text in events:
        row = round(json.loads(text)["time"] / SPEC.dt) - 1 - BLOCK
        late_s.append(int(nanoseconds) * 1e-9 - written[row // BLOCK])
    taken = len(written) * BLOCK / (written[-1] - written[0])
    print(
        f"{taken:.0f} rows/s, {len(events)} alarms, told after {np.median(late_s) * 1e3:.1f} ms, "
        f"the last of all {max(late_s) * 1e3:.1f} ms; memory {memory_kb} KB"
    )
    reasons = [json.loads(text)["reason"] for _, text in events]
    assert reasons.count("surprise") == seconds * RATE // CYCLE
    assert max(late_s) < LATEST_S
    assert memory_kb[1] - memory_kb[0] < MOST_GROWTH_KB


def test_a_watch_spends_no_time_on_causes_that_it_does_not_print(memory, monkeypatch):
    asked = []
    monkeypatch.setattr(Diagnosis, "__call__", lambda *args: asked.append(args))
    events = []
    assert follow(b"".join(blocks()).decode().splitlines(), load_monitor(memory), events.append)
    assert events[0].reason == "surprise"
    assert not asked
