"""HDF5 files with pictures in them: which arrays are senses, and what is said of the others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asm_gym.data.array_files import read_hdf5, read_mat
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema_inference import SchemaHints
from tests.needs import needs

h5py = needs("h5py")

ROWS = 80
RNG = np.random.default_rng(0)
JOINTS = RNG.normal(size=(ROWS, 14))


def pictures(*shape: int, dtype: str = "uint8") -> np.ndarray:
    return RNG.integers(0, 100, shape).astype(dtype)


def hdf5(path: Path, **arrays: np.ndarray) -> Path:
    """A file with arrays by name; two underscores in a name stand for a group."""
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name.replace("__", "/")] = array
    return path


def test_of_an_aloha_file_the_joints_are_read_and_compressed_pictures_are_left_out(tmp_path):
    path = hdf5(
        tmp_path / "episode_0.hdf5",
        observations__images__cam_high=pictures(ROWS, 20_000),
        observations__images__cam_low=pictures(ROWS, 20_000),
        observations__qpos=JOINTS,
        action=JOINTS[::-1],
        compress_len=np.full((2, ROWS), 9000.0),
    )
    with noted() as notes:
        ((_, episode),) = read_logs(path, SchemaHints(rate=50.0))
    qpos = [f"observations.qpos[{k}]" for k in range(14)]
    assert set(episode.spec.labels) == {*qpos, *(f"action[{k}]" for k in range(14))}
    first = episode.spec.labels.index(qpos[0])
    np.testing.assert_allclose(episode.stream[:, first], JOINTS[:, 0], rtol=1e-6)
    for name in ("images.cam_high", "images.cam_low", "compress_len"):
        assert any(name in note for note in notes), name


@pytest.mark.parametrize(
    ("array", "is_sense"),
    [
        (pictures(ROWS, 513), False),
        (pictures(ROWS, 513, dtype="int8"), False),
        (pictures(ROWS, 4, 4), False),
        (pictures(ROWS, 4, 4, 3), False),
        (pictures(ROWS, 512), True),
        (pictures(ROWS, 513, dtype="int16"), True),
        (pictures(ROWS, 3), True),
        (pictures(ROWS), True),
    ],
)
@pytest.mark.parametrize("group", ["", "data__demo_0__obs__"])
def test_type_and_size_tell_pictures_whatever_they_are_called(array, is_sense, group, tmp_path):
    arrays = {f"{group}q": JOINTS, f"{group}front": array}
    with noted() as notes:
        ((columns, _),) = read_hdf5(hdf5(tmp_path / "x.hdf5", **arrays)).values()
    assert ("front" in columns) == is_sense
    assert any("front" in note for note in notes) != is_sense
    np.testing.assert_array_equal(columns["q"], JOINTS)


def test_matlab_keeps_time_second_and_its_flags_are_no_pictures(tmp_path):
    rows = 1000
    times = np.arange(rows) / 50
    flags = np.zeros((1, rows), np.uint8)
    joints = RNG.normal(size=(7, rows))
    path = hdf5(tmp_path / "x.h5", time=times[None], flags=flags, q=joints)
    columns = read_hdf5(path)[""][0]
    np.testing.assert_array_equal(columns["time"], times)
    np.testing.assert_array_equal(columns["q"], joints.T)
    assert columns["flags"].shape == (rows,)
    with noted():
        ((_, episode),) = read_logs(path)
    assert episode.spec.dt == pytest.approx(0.02)


@pytest.mark.parametrize("read", [read_mat, read_hdf5])
def test_a_picture_in_a_matlab_file_is_said_too(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "x.mat"
    arrays = {"q": JOINTS, "front": pictures(ROWS, 8, 8)}
    if read is read_mat:
        needs("scipy.io").savemat(path, arrays)
    else:
        hdf5(path, **arrays)
    with noted() as notes:
        read(path)
    assert any("front" in note for note in notes)
