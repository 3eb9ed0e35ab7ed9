"""Files: complete or not there, nothing left behind by the dead, nothing read that is no file."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from asm_gym.files import regular_file, written_whole

KILLED = """
import os, signal, sys
from asm_gym.files import written_whole
with written_whole(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "deep" / "x.asm"
    with written_whole(path) as file:
        file.write(b"old")
    with written_whole(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    with pytest.raises(KeyboardInterrupt), written_whole(path) as file:
        raise KeyboardInterrupt
    assert [p.name for p in path.parent.iterdir()] == ["x.asm"]


def test_what_a_killed_process_began_is_removed_by_the_next_and_what_a_living_one_writes_is_not(tmp_path):
    path = tmp_path / "x.asm"
    killed = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.read_bytes() == b"half"
    other = tmp_path / "x.asm2"
    with written_whole(path) as outer, written_whole(path) as inner:  # two at once
        outer.write(b"1")
        inner.write(b"2")
        assert len(list(tmp_path.iterdir())) == 2, "both of this process, and no longer that of the dead one"
    with written_whole(other) as file:
        file.write(b"3")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.asm", "x.asm2"]


def test_a_pipe_a_device_or_a_folder_is_neither_read_nor_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/null"), Path("/dev/zero"), tmp_path):
        before = path.stat().st_mode
        with pytest.raises(ValueError, match="is no regular file"):
            regular_file(path)
        with pytest.raises(ValueError, match="is no regular file"), written_whole(path):
            pass
        assert path.stat().st_mode == before
    with pytest.raises(FileNotFoundError, match="none"):
        regular_file(tmp_path / "none")


@pytest.mark.parametrize(("path", "said"), [("", "''"), (Path(), "'.'"), ("x\x00y", r"'x\\x00y'")])
def test_a_path_that_can_name_no_file_is_refused(path, said):
    for use in (regular_file, lambda path: written_whole(path).__enter__()):
        with pytest.raises(ValueError, match=f"a path must name a file, got {said}"):
            use(path)
