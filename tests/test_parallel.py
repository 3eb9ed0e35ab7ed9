"""Work is done in order wherever it is done, and no worker outlives who asked for it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from asm_gym.rollouts.parallel import parallel_map

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
        parents.append(
            subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
        )
        assert until(lambda: len(list(tmp_path.iterdir())) == 2, 300), "no workers"
        return parents[-1], [int(p.name) for p in tmp_path.iterdir()]

    yield started
    for parent in parents:
        parent.kill()
        parent.wait()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
# from a thread, workers have no signal and look for themselves
@pytest.mark.parametrize("where", ["main", "thread"])
def test_workers_end_within_seconds_of_their_killed_parent(start, where):
    parent, workers = start(where)
    assert all(map(is_alive, workers))
    parent.kill()
    parent.wait()
    assert until(lambda: not any(map(is_alive, workers)), 5)


def test_results_are_in_order_and_progress_is_told():
    seen = []
    assert parallel_map(abs, [-3, 1, -2], 2, lambda done, total: seen.append((done, total))) == [
        3,
        1,
        2,
    ]
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


def test_processes_work_for_a_program_whose_streams_are_closed(tmp_path):
    program = (
        "import sys; sys.stdout = sys.stderr = None\n"
        "from pathlib import Path\n"
        "from asm_gym.rollouts.parallel import parallel_map\n"
        f"Path({str(tmp_path / 'sums')!r}).write_text(str(parallel_map(abs, [-1, -2], 2)))"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert (tmp_path / "sums").read_text() == "[1, 2]"


def test_nothing_to_do_needs_nobody():
    assert parallel_map(abs, [], 2) == []
