"""Checkpoints: every bit kept, and whatever is damaged refused."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.checkpoint import read_checkpoint, write_checkpoint


def test_checkpoint_keeps_every_bit(tmp_path):
    arrays = {"a": np.random.default_rng(0).normal(size=(3, 4)), "empty": np.zeros((0, 3), np.float32)}
    write_checkpoint(tmp_path / "new" / "x.asm", "test", {"n": 0.1, "none": None}, arrays)
    header, back = read_checkpoint(tmp_path / "new" / "x.asm", "test")
    assert header["n"] == 0.1
    assert header["none"] is None
    assert {k: (v.dtype, v.shape, v.tobytes()) for k, v in back.items()} == {
        k: (v.dtype, v.shape, v.tobytes()) for k, v in arrays.items()
    }
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["x.asm"]  # nothing temporary is left


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "x.asm"
    write_checkpoint(path, "test", {"n": 1}, {"a": np.zeros(2)})
    with pytest.raises(ValueError, match="Object arrays"):
        write_checkpoint(path, "test", {"n": 2}, {"a": np.array([object()])})
    assert read_checkpoint(path, "test").header["n"] == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_bad_checkpoints_are_refused(tmp_path):
    path = tmp_path / "x.asm"
    write_checkpoint(path, "test", {}, {"a": np.random.default_rng(0).normal(size=100)})
    good = path.read_bytes()
    middle = len(good) // 2
    flipped = bytes([*good[:middle], good[middle] ^ 1, *good[middle + 1 :]])
    for bad in (b"", b"not a zip", good[:middle], good[:-10], flipped):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="damaged"):
            read_checkpoint(path, "test")
    np.savez(tmp_path / "foreign.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not a checkpoint"):
        read_checkpoint(tmp_path / "foreign.npz", "test")
    with pytest.raises(FileNotFoundError):
        read_checkpoint(tmp_path / "missing", "test")
    path.write_bytes(good)
    with pytest.raises(ValueError, match="of 'test', not of 'other'"):
        read_checkpoint(path, "other")
    write_checkpoint(path, "test", {"version": 2}, {})
    with pytest.raises(ValueError, match="newer"):
        read_checkpoint(path, "test")
