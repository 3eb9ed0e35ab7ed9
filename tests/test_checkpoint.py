"""Checkpoints: every bit kept, and whatever is damaged refused."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from functools import partial

import numpy as np
import pytest

from asm_gym.checkpoint import read_arrays, read_checkpoint, read_header, write_checkpoint


def test_checkpoint_keeps_every_bit(tmp_path):
    arrays = {
        "a": np.random.default_rng(0).normal(size=(3, 4)),
        "empty": np.zeros((0, 3), np.float32),
    }
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


def npy(array, **header):
    """The bytes of an ``.npy`` whose header says something else than what is in it."""
    file = io.BytesIO()
    said = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape} | header
    np.lib.format.write_array_header_1_0(file, said)
    return file.getvalue() + array.tobytes()


def packed(path, header=None, compression=zipfile.ZIP_STORED, **members):
    """A zip with a header of ours, and arrays as bytes."""
    text = json.dumps({"format": "asm-gym", "version": 1, "kind": "test"} | (header or {}))
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("header.json", text.replace('"1e999"', "1e999"))
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"a": npy(np.zeros(3), shape=(10**13,))}, ""),
        ({"a": npy(np.zeros(3), shape=(2**62, 2**62))}, ""),
        ({"a": npy(np.zeros(3), shape=(-3,))}, ""),
        ({"a": npy(np.zeros(3), shape=(4,))}, ""),
        ({"a": npy(np.zeros(3, ">f8"))}, "cannot be of dtype"),
        ({"a": npy(np.zeros(3, "S8"))}, "cannot be of dtype"),
        ({"a": npy(np.zeros(3)), "header": {"arrays": {}}}, "declares otherwise: a"),
        ({"header": {"arrays": {"a": ["<f8", 3]}}}, "declares otherwise: a"),
        ({"a": npy(np.zeros(3)), "header": {"arrays": {"a": ["<f8", 4]}}}, "declares otherwise: a"),
        ({"a": npy(np.zeros(3)), "header": {"arrays": {"a": ["<f4", 3]}}}, "declares otherwise: a"),
        ({"header": {"threshold": math.nan}}, "NaN, which is no number"),
        ({"header": {"threshold": math.inf}}, "Infinity, which is no number"),
        ({"header": {"threshold": "1e999"}}, "1e999, which is no number"),
        ({"a": npy(np.zeros(10**6)), "compression": zipfile.ZIP_DEFLATED}, "compressed"),
    ],
)
def test_hostile_checkpoints_are_refused_with_a_reason(how, message, tmp_path):
    with pytest.raises(ValueError, match=rf"x\.asm is damaged.*{message}"):
        read_checkpoint(packed(tmp_path / "x.asm", **how), "test")


def test_what_claims_to_be_larger_than_its_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    bomb = packed(tmp_path / "x.npz", compression=zipfile.ZIP_DEFLATED, a=npy(np.zeros(10**6)))
    assert bomb.stat().st_size < 20_000
    # calling it would be a TypeError, which nothing here catches
    monkeypatch.setattr(zipfile.ZipFile, "read", None)
    with pytest.raises(ValueError, match="its members claim 8000"):
        read_arrays(bomb)
    with pytest.raises(ValueError, match="compressed"):
        read_checkpoint(bomb, "test")
    with zipfile.ZipFile(tmp_path / "two.asm", "w") as file:
        file.writestr("header.json", "{}")
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("header.json", "{}")
    with pytest.raises(ValueError, match="same name"):
        read_checkpoint(tmp_path / "two.asm", "test")


@pytest.mark.parametrize("seed", range(4))
def test_no_flipped_bit_changes_what_is_read(tmp_path, seed):
    path, rng = tmp_path / "x.asm", np.random.default_rng(seed)
    write_checkpoint(path, "test", {"n": 1}, {"a": rng.normal(size=20), "b": np.arange(5)})
    whole, good = path.read_bytes(), read_checkpoint(path, "test")
    for place in rng.integers(8 * len(whole), size=100):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            found = read_checkpoint(path, "test")
        except ValueError:
            continue
        assert found.header == good.header
        for name in good.arrays:
            np.testing.assert_array_equal(found.arrays[name], good.arrays[name])


@pytest.mark.parametrize("read", [partial(read_checkpoint, kind="test"), read_header, read_arrays])
def test_a_pipe_is_no_checkpoint_and_nobody_waits_for_it(read, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is no regular file"):
        read(tmp_path / "pipe")


def test_bytes_behind_the_end_of_a_checkpoint_are_refused(tmp_path):
    path = tmp_path / "x.asm"
    write_checkpoint(path, "test", {}, {"a": np.zeros(2)})
    path.write_bytes(path.read_bytes() + b"garbage" * 15)
    with pytest.raises(ValueError, match=r"x\.asm is damaged.*follow its end"):
        read_checkpoint(path, "test")
