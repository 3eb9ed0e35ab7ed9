"""Too little memory, or no shared memory, ends a command with one line that says what is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from asm_gym.rollouts.parallel import parallel_map
from asm_gym.scripts import command
from asm_gym.scripts.shortage import shortage_of
from tests.needs import needs

LIMITED = """
import resource, sys
size = int(float(sys.argv[1]) * 2**30)
resource.setrlimit(resource.RLIMIT_AS, (size, size))
from asm_gym.scripts.cli import main
raise SystemExit(main(sys.argv[2:]))
"""


def limited(gib: float, *argv: str) -> subprocess.CompletedProcess[str]:
    """Run a command in so much address space [GiB]."""
    words = [sys.executable, "-c", LIMITED, str(gib), *argv]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 8.00 EiB for an array"),
        RuntimeError("can't start new thread"),
        RuntimeError("Caught an unknown exception!"),  # numba's, of LLVM
        Exception("Could not allocate memory"),  # mujoco.FatalError
        ValueError("Error: engine error: Could not allocate memory\nElement name 'cube'"),
        ImportError("libx.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        SystemError("OpenBLAS error: Memory allocation still failed after 10 attempts"),
    ],
)
def test_whatever_a_library_raises_for_want_of_memory_is_one_line(error, capsys):
    def work() -> int:
        raise error

    assert command.exit_code("try", work) == command.REFUSED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("asm-gym try: out of memory")


def test_another_error_is_no_shortage():
    assert not shortage_of(ValueError("no file allocated.asm in /memory"))
    assert not shortage_of(RuntimeError("a bug"))


def test_too_little_address_space_for_the_libraries_is_refused_at_once():
    refused = limited(0.65, "watch", "-", "--monitor", "any.asm")
    assert refused.returncode == command.REFUSED
    (line,) = refused.stderr.splitlines()
    assert "out of memory" in line
    assert "0.65 GiB of address space" in line


@pytest.mark.parametrize("gib", [1.5, 2.5])
def test_an_environment_in_too_little_address_space_is_refused_in_a_line(gib, tmp_path):
    needs("robosuite")
    argv = ["Lift", "--episodes", "1", "--workers", "1", "--out", str(tmp_path)]
    refused = limited(gib, "collect", *argv)
    assert refused.returncode == command.REFUSED
    (line,) = refused.stderr.splitlines()
    assert line.startswith("asm-gym collect: out of memory")
    assert "address space" in line


@pytest.mark.parametrize(
    "error",
    [
        OSError(30, "Read-only file system"),
        PermissionError(13, "Permission denied"),
        OSError(28, "No space left on device"),
    ],
)
def test_workers_without_shared_memory_are_refused_in_a_line(error, monkeypatch, capsys):
    synchronize = needs("loky.backend.synchronize")
    loky = needs("loky")
    loky.get_reusable_executor().shutdown(wait=True, kill_workers=True)

    class NoSemaphore:
        def __init__(self, *args: object) -> None:
            raise error

    monkeypatch.setattr(synchronize, "_SemLock", NoSemaphore)
    code = command.exit_code("try", lambda: len(parallel_map(abs, [-1, 2], workers=2)))
    assert code == command.REFUSED
    (line,) = capsys.readouterr().err.splitlines()
    assert "/dev/shm" in line
    assert "workers to 1" in line
    monkeypatch.undo()
    assert parallel_map(abs, [-1, 2], workers=2) == [1, 2]


def test_what_a_task_raises_is_not_taken_for_want_of_shared_memory(tmp_path):
    needs("loky")
    with pytest.raises(FileNotFoundError, match="absent"):
        parallel_map(open, [str(tmp_path / "absent")] * 2, workers=2)
