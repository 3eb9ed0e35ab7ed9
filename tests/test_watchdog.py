"""The arm is told to hold where the guard, the policy, the stream or the watchdog itself is killed."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.guard.watchdog import Watchdog
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
from asm_gym.wrappers.lerobot import LeRobotGuard

RATE, MOTORS = 50.0, ["pan.pos", "lift.pos"]
TICKS = "import sys, time\nwhile True: print('tick', flush=True); time.sleep(0.02)"
ECHO = "import sys\nfor line in sys.stdin: print(line, end='', flush=True)"


def sine(t: int) -> dict[str, float]:
    return dict(zip(MOTORS, (20.0 * np.sin(np.array([2.0, 3.0]) * t / RATE)).tolist(), strict=True))


def recorded(seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    rows = [
        [*(np.array(list(sine(t).values())) + 0.1 * rng.normal(size=2)), *sine(t).values()]
        for t in range(120)
    ]
    names = [f"{what}[{m}]" for what in ("observation.state", "action") for m in MOTORS]
    return Episode.from_table(
        dict(zip(names, np.array(rows).T, strict=True)), rate=RATE, action=["action*"]
    )


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("memory") / "arm.asm"
    monitor = make_monitor("kalman", recorded(0).spec).fit([recorded(n) for n in range(4)])
    monitor.calibrate([recorded(10 + n) for n in range(4)], 0.5).with_threshold(1e9).save(path)
    return path


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def tell(port: int, why: str) -> None:
    """Tell the simulated arm to hold, by a datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(f"hold {why}".encode(), ("127.0.0.1", port))


def drive(memory: Path, port: int, processes: Any) -> None:
    """The loop of a guarded arm: a stream and a policy in processes of their own."""
    stream = subprocess.Popen([sys.executable, "-c", TICKS], stdout=subprocess.PIPE, text=True)
    policy = subprocess.Popen(
        [sys.executable, "-c", ECHO],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    assert stream.stdout
    assert policy.stdin
    assert policy.stdout
    watchdog = Watchdog(partial(tell, port), processes=[policy.pid])
    guard = LeRobotGuard(memory, watchdog=watchdog)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for t, _ in enumerate(stream.stdout):
        policy.stdin.write(json.dumps(sine(t)) + "\n")
        action = json.loads(policy.stdout.readline())
        sent = guard.guarded(sine(t), action)
        sender.sendto(
            ("hold" if guard.intervened else json.dumps(sent)).encode(), ("127.0.0.1", port)
        )
        if t == 10:
            processes.send(
                {"stream": stream.pid, "policy": policy.pid, "watchdog": watchdog.process.pid}
            )
    time.sleep(60)  # the stream has ended, and nobody notices


@pytest.mark.parametrize("victim", ["guard", "policy", "stream", "watchdog"])
def test_whoever_is_killed_the_arm_is_told_to_hold(victim: str, memory: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as arm:
        arm.bind(("127.0.0.1", 0))
        arm.settimeout(60.0)
        mine, theirs = context.Pipe()
        guard = context.Process(target=drive, args=(memory, arm.getsockname()[1], theirs))
        guard.start()
        assert wait([mine, guard.sentinel], 60.0) == [mine]
        processes = {**mine.recv(), "guard": guard.pid}
        while not arm.recv(1000).startswith(b"{"):
            pass
        os.kill(processes[victim], signal.SIGKILL)
        while not arm.recv(1000).startswith(b"hold"):
            pass
        for process in processes.values():
            if process != processes.get("watchdog") or victim == "watchdog":
                try:
                    os.kill(process, signal.SIGKILL)
                except ProcessLookupError:
                    continue
        guard.join()


def test_a_watch_that_is_killed_runs_its_hook_all_the_same(memory: Path, tmp_path: Path) -> None:
    told = tmp_path / "told"
    command = [
        sys.executable,
        "-m",
        "asm_gym",
        "watch",
        "-",
        "--monitor",
        str(memory),
        "--watchdog",
        "0.5",
    ]
    watch = subprocess.Popen(
        [*command, "--hook", f"cat >> {told}"], stdin=subprocess.PIPE, text=True
    )
    assert watch.stdin
    row = json.dumps([*sine(0).values(), *sine(0).values()])
    for _ in range(5):
        watch.stdin.write(f"{row}\n")
        watch.stdin.flush()
        time.sleep(0.02)
    # silence is told of once rows were judged
    wait_for(lambda: told.exists() and bool(told.read_text()))
    watch.kill()
    watch.wait()
    wait_for(lambda: told.read_text().count("\n") == 2)
    silent, died = map(json.loads, told.read_text().splitlines())
    assert silent["reason"] == died["reason"] == "watchdog"
    assert silent["text"] != died["text"]


def test_a_guard_that_closes_its_watchdog_leaves_the_arm_alone(tmp_path: Path) -> None:
    with Watchdog(partial(tell, 1)) as watchdog:
        assert watchdog.beat()
    assert watchdog.process.exitcode == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--watchdog", "0.5"), "--hook"),
        (("--hook", "true", "--policy", "1"), "--watchdog"),
        (("--hook", "true", "--watchdog", "0.01"), "longer than"),
        (("--hook", "true", "--watchdog", "0.5", "--policy", "4194304"), "process"),
    ],
)
def test_a_watchdog_that_could_do_nothing_is_refused(
    options: tuple[str, ...], says: str, memory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", "-", "--monitor", str(memory), *options]) == 2
    assert says in "".join(capsys.readouterr()).lower()
