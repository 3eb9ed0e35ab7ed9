"""Fitted monitors are kept in the folder of a run, and made anew where they cannot be used."""

from __future__ import annotations

from dataclasses import replace

from asm_gym.episodes import EpisodeLabel
from asm_gym.rollouts.benchmark import fitted
from tests.streams import sine_episodes


def test_a_monitor_is_kept_and_one_that_cannot_be_read_is_made_anew(tmp_path):
    recordings = [
        replace(episode, label=EpisodeLabel("Sines", "fit", seed=n)) for n, episode in enumerate(sine_episodes(8))
    ]
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
