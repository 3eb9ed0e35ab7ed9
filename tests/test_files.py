"""Files: complete or not there, nothing read that is no file."""

import os
import stat
from pathlib import Path

import pytest

from asm_gym.files import no_links, regular_file, write_text, written_whole


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "deep" / "x.asm"
    with written_whole(path) as file:
        file.write(b"old")
    with written_whole(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    with pytest.raises(KeyboardInterrupt), written_whole(path) as file:
        raise KeyboardInterrupt
    assert [p.name for p in path.parent.iterdir()] == ["x.asm"]


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o027])
def test_the_umask_says_who_may_read_a_file(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_text(tmp_path / "x", "x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o666 & ~mask


def test_a_symbolic_link_is_replaced_and_what_it_points_to_stays(tmp_path):
    (tmp_path / "own").write_text("precious")
    out = tmp_path / "out"
    out.mkdir()
    for name in ("alarms.csv", "new"):
        (out / name).symlink_to(tmp_path / ("own" if name == "alarms.csv" else "none"))
        write_text(out / name, "text")
        assert (out / name).read_text() == "text"
        assert not (out / name).is_symlink()
    (out / "live").symlink_to(tmp_path / "own")
    with pytest.raises(OSError, match="live"), open(out / "live", "w", opener=no_links):
        pass
    assert (tmp_path / "own").read_text() == "precious"
    assert not (tmp_path / "none").exists()


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
