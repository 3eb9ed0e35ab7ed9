"""Recordings survive being written and read, and damage is noticed."""

import numpy as np
import pytest

from asm_gym.episodes import Episode
from asm_gym.evaluation.archive import Label, Recording, read, write
from asm_gym.stream import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("x", 2, "m", 0.1), Channel("action", 1, group=MOTOR)), 0.05, "Panda")


def recording(kind="push", severity="mild"):
    rng = np.random.default_rng(0)
    stream = rng.standard_normal((6, 3)).astype(np.float32)
    episode = Episode(stream, SPEC, success=True, seed=7, faults=np.arange(6) >= 2)
    label = Label("Lift", "faulty", kind, severity, 7, onset=2)
    return Recording(label, episode, rng.random(6).astype(np.float32), frozenset({"x[0]"}))


def test_what_was_written_is_read(tmp_path):
    before = recording()
    path = write(tmp_path, before)
    assert path == tmp_path / "episodes/Lift/faulty/push-mild-7.npz"
    after = read(path)
    assert (after.label, after.guilty, after.episode.spec) == (before.label, before.guilty, SPEC)
    assert (after.episode.success, after.episode.seed) == (True, 7)
    for a, b in (
        (after.episode.stream, before.episode.stream),
        (after.episode.faults, before.episode.faults),
        (after.contact_force, before.contact_force),
    ):
        np.testing.assert_array_equal(a, b)


def test_kinds_severities_and_seeds_lie_side_by_side():
    labels = [
        Label("Lift", r, k, s, i) for r in ("fit", "faulty") for k in ("a", "") for s in ("mild", "") for i in (1, 2)
    ]
    assert len({label.path for label in labels}) == len(labels)


def test_nothing_half_written_is_left(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        write(tmp_path, recording())
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda _: b"", lambda b: b[:200] + b"\0" * 50 + b[250:]]
)
def test_a_damaged_file_is_named(tmp_path, damage):
    path = write(tmp_path, recording())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"push-mild-7\.npz"):
        read(path)
