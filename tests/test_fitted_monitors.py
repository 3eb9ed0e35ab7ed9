"""Fitted monitors are kept in the folder of a run, and made anew where they cannot be used."""

from __future__ import annotations

import warnings
from dataclasses import replace

import pytest

from asm_gym.episode import EpisodeLabel
from asm_gym.evaluation.scoring import LEARNING, code_digest, fitted
from asm_gym.rollouts import scoring
from tests.streams import sine_episodes


def some_recordings():
    return [replace(episode, label=EpisodeLabel("Sines", "fit", seed=n)) for n, episode in enumerate(sine_episodes(8))]


def test_a_monitor_is_kept_and_one_that_cannot_be_read_is_made_anew(tmp_path):
    recordings = some_recordings()
    first = fitted(tmp_path, "kalman", recordings, 0)
    (kept,) = (tmp_path / "monitors").glob("*")
    written = kept.stat().st_mtime_ns
    again = fitted(tmp_path, "kalman+evidence", recordings, 0)
    assert kept.stat().st_mtime_ns == written
    assert set(again.learned_) == set(first.learned_)
    kept.write_bytes(kept.read_bytes()[:100])
    fitted(tmp_path, "kalman", recordings, 0)
    assert len(list((tmp_path / "monitors").glob("*"))) == 1
    assert kept.stat().st_size > 1000


def test_what_other_code_has_learned_is_learned_anew_and_that_is_said(tmp_path, monkeypatch):
    recordings = some_recordings()
    fitted(tmp_path, "kalman", recordings, 0)
    monkeypatch.setattr(scoring, "code_digest", lambda: "01234567")
    with pytest.warns(UserWarning, match="kalman was fitted by other code"):
        fitted(tmp_path, "kalman", recordings, 0)
    assert len(list((tmp_path / "monitors").glob("kalman-*.asm"))) == 2
    with warnings.catch_warnings(action="error"):
        fitted(tmp_path, "kalman", recordings, 0)


def test_any_change_of_what_learns_is_other_code_and_nothing_else_is(tmp_path):
    for name in (*LEARNING, "faults"):
        path = tmp_path / name if name.endswith(".py") else tmp_path / name / "deeper" / "part.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a = 1")
    before = code_digest.__wrapped__(tmp_path)
    (tmp_path / "faults" / "deeper" / "part.py").write_text("a = 2")
    assert code_digest.__wrapped__(tmp_path) == before
    (tmp_path / "detection" / "deeper" / "part.py").write_text("a = 2")
    assert code_digest.__wrapped__(tmp_path) != before
