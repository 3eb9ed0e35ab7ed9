"""Work is done in order wherever it is done, and no worker outlives who asked for it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from asm_gym.rollouts import collect, parallel_map
from asm_gym.rollouts.parallel import parse_workers
from tests.needs import needs

PARENT = """
import os, signal, sys, threading, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
from asm_gym.rollouts.parallel import parallel_map

def work(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(600)

def ask():
    parallel_map(work, [sys.argv[1]] * 2, 2)

if sys.argv[2] == "thread":
    asking = threading.Thread(target=ask)
    asking.start()
    asking.join()
else:
    ask()
"""


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def until(condition, seconds: float) -> bool:
    """Whether the condition came true in time."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.fixture
def start(tmp_path):
    """Starts a parent with two busy workers; hands out the parent and their process ids."""
    parents = []

    def started(where: str) -> tuple[subprocess.Popen, list[int]]:
        command = [sys.executable, "-c", PARENT, str(tmp_path), where]
        parents.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True))
        assert until(lambda: len(list(tmp_path.iterdir())) == 2, 300), "no workers"
        return parents[-1], [int(p.name) for p in tmp_path.iterdir()]

    yield started
    for parent in parents:
        parent.kill()
        parent.wait()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("where", ["main", "thread"])  # from a thread, workers have no signal and look for themselves
def test_workers_end_within_seconds_of_their_killed_parent(start, where):
    parent, workers = start(where)
    assert all(map(is_alive, workers))
    parent.kill()
    parent.wait()
    assert until(lambda: not any(map(is_alive, workers)), 5)


def test_results_are_in_order_and_progress_is_told():
    seen = []
    assert parallel_map(abs, [-3, 1, -2], 2, lambda done, total: seen.append((done, total))) == [3, 1, 2]
    assert seen == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_task_raises_is_raised_here(workers):
    with pytest.raises(TypeError, match="bad operand"):
        parallel_map(abs, ["a"], workers)


def test_a_killed_worker_is_an_error_that_says_so_and_the_next_call_works():
    with pytest.raises(ChildProcessError, match="killed"):
        parallel_map(_kill_myself, [signal.SIGKILL], 2)
    assert parallel_map(abs, [-1], 2) == [1]


def _kill_myself(how: int) -> None:
    os.kill(os.getpid(), how)


def test_nothing_to_do_needs_nobody():
    assert parallel_map(abs, [], "dask:tcp://127.0.0.1:1") == []


@pytest.fixture(scope="module")
def cluster():
    """A real cluster on this machine, with two workers."""
    quiet = {"processes": True, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    with needs("distributed").LocalCluster(2, **quiet) as made:
        yield f"dask:{made.scheduler_address}"


@pytest.mark.slow
def test_a_cluster_keeps_the_order_raises_errors_and_leaves_no_thread_to_chance(cluster):
    seen = []
    squares = parallel_map(lambda x: x * x, range(20), cluster, lambda done, total: seen.append((done, total)))
    assert squares == [x * x for x in range(20)]
    assert seen == [(k, 20) for k in range(1, 21)]
    assert os.getpid() not in parallel_map(lambda _: os.getpid(), range(4), cluster)
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda x: 1 // x, [1, 0], cluster)


@pytest.mark.slow
def test_a_cluster_runs_again_what_a_lost_worker_had(cluster, tmp_path):
    def die_once(item: int) -> int:
        first = tmp_path / str(item)
        if not first.exists():
            first.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return -item

    assert parallel_map(die_once, [1, 2], cluster) == [-1, -2]


@pytest.mark.slow
def test_a_cluster_collects_the_same_episodes(cluster):
    here, there = (collect("asm_gym/Lift-v0", episodes=3, seed=5, workers=w, horizon=15) for w in (1, cluster))
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a.stream, b.stream)
        np.testing.assert_array_equal(a.observations, b.observations)


@pytest.mark.slow
def test_no_cluster_at_the_address_is_said():
    needs("distributed")
    with pytest.raises(ConnectionError, match=r"tcp://127\.0\.0\.1:1"):
        parallel_map(abs, [1], "dask:tcp://127.0.0.1:1")


def test_workers_are_named_in_one_word():
    assert parse_workers("3") == parse_workers(3) == 3
    assert parse_workers("dask:tcp://host:8786") == "tcp://host:8786"
    for wrong in ("", "two", 0, "-1", 10**9, "loky", "dask", "slurm:host"):
        with pytest.raises(ValueError, match="workers must be"):
            parse_workers(wrong)
