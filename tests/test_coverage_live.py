"""A memory from a live source: what the arm has shown while it is recorded, and when that is enough."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from asm_gym.data.coverage import Coverage
from asm_gym.data.live import SourceDied
from asm_gym.data.selection import divided_in_time, pieces
from asm_gym.episode import Episode
from asm_gym.scripts import live_recording as listening
from asm_gym.scripts.cli import main


def shown(q, rate=10.0):
    coverage = Coverage([f"q[{j}]" for j in range(q.shape[1])])
    for k, row in enumerate(q):
        coverage.see(k / rate, row)
    return coverage


def test_a_joint_that_has_not_moved_or_went_one_way_is_said():
    t = np.arange(600) / 10
    swings = np.sin(t) + 0.2 * np.sin(2.3 * t)
    still, up, swing = shown(np.stack([0 * t, 0.02 * t, swings], axis=1)).shown()
    assert still.missing == ("moved",)
    assert "not moved yet" in str(still)
    assert set(up.missing) == {"fast backwards", "slowly backwards", "slowly forwards"}
    assert not swing.missing
    assert (swing.low, swing.high) == pytest.approx((swings.min(), swings.max()))
    assert swing.fastest == pytest.approx(np.abs(np.gradient(swings, 0.1)).max(), rel=0.05)


def test_what_is_new_falls_as_the_same_is_shown_again():
    t = np.arange(3000) / 10
    q = (np.sin(t) + 0.5 * np.sin(1.9 * t))[:, None]
    new = [shown(q[:n]).shown()[0].new for n in (30, 300, 3000)]
    assert new[0] > new[1] > new[2]
    assert new[2] < 0.05
    assert shown(q).enough
    assert not shown(q[:30]).enough


def test_looks_are_a_tenth_of_a_second_apart():
    coverage = Coverage(["q"])
    for k in range(1000):
        coverage.see(k / 1000, [float(k)])
    assert len(coverage._times) == 10


def rows(count, rate=100.0, still=False):
    rng = np.random.default_rng(0)
    for k in range(count):
        q = (0 if still else 1) * np.sin(k / rate * np.array([1.0, 1.7])) + 1e-4 * rng.normal(size=2)
        yield json.dumps({"time": k / rate, "position": q.tolist(), "effort": (3 * np.sin(q)).tolist()})


def test_it_ends_when_enough_was_heard_and_not_before(tmp_path, monkeypatch):
    clock = iter(np.arange(1, 1_000_000) / 100)
    monkeypatch.setattr(listening.time, "monotonic", lambda: float(next(clock)))
    said: list[str] = []
    listening.listen(rows(60_000), tmp_path / "a.jsonl", 10.0, said.append)
    assert any(line.startswith("enough was heard") for line in said)
    kept = (tmp_path / "a.jsonl").read_text().splitlines()
    assert 6_000 <= len(kept) < 60_000
    said.clear()
    listening.listen(rows(60_000, still=True), tmp_path / "b.jsonl", 1.0, said.append)
    assert any(line.startswith("the time is over") for line in said)
    assert "  position[0]: not moved yet" in said


def test_a_source_that_dies_leaves_what_it_said_and_words_are_refused(tmp_path):
    def dying():
        yield from rows(50)
        raise SourceDied("nothing came for 2 s")

    said: list[str] = []
    listening.listen(dying(), tmp_path / "a.jsonl", 1.0, said.append)
    assert len((tmp_path / "a.jsonl").read_text().splitlines()) == 50
    assert "the source has died" in said[0]
    for line in ("[1, 2]", "good morning", '{"q": "high"}'):
        with pytest.raises(ValueError, match="a row to learn from must be an object of numbers by channel"):
            listening.listen([line], tmp_path / "b.jsonl", 1.0, said.append)
    with pytest.raises(ValueError, match="no row came"):
        listening.listen([], tmp_path / "c.jsonl", 1.0, said.append)


def test_a_memory_is_fitted_from_a_pipe(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(rows(6000))))
    out = tmp_path / "arm.asm"
    fit = ["fit", "-", "--out", str(out), "--monitor", "kalman", "--false-alarm-rate", "0.1", "--split", "1"]
    assert main(fit) == 0
    said = capsys.readouterr().out
    assert "Learned from 30 episodes: 3000 rows" in said
    assert "from 29 other episodes" in said
    assert "from 0.483 min nothing under 125 an hour can be promised, and one an hour takes 60 min more" in said
    assert out.exists()
    assert out.with_suffix(".jsonl").exists()


def test_a_controller_has_to_be_asked_for_something():
    with pytest.raises(ValueError, match="say --channels actual_q"):
        listening.rtde_source("10.0.0.1", (), None, 1.0)


def test_the_head_of_a_log_is_learned_from_and_its_tail_calibrated_on():
    log = Episode.from_table({"q": np.arange(100.0)}, rate=10.0)
    fitting, calibration = divided_in_time([pieces(log, 1.0)], 0.5)
    assert [int(e.stream[0, 0]) for e in fitting] == [0, 10, 20, 30, 40]
    assert [int(e.stream[0, 0]) for e in calibration] == [60, 70, 80, 90]
    with pytest.raises(ValueError, match="too few"):
        divided_in_time([pieces(log, 10.0)], 0.5)
