"""One file format of single episodes: what goes in comes out, and damage is noticed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asm_gym.episode import Episode, EpisodeLabel, load_episode, save_episode
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("x", 2, "m", 0.1), Channel("action", 1, group=MOTOR)), 0.05, "Panda")
X = (np.arange(18, dtype=np.float32) / 8).reshape(6, 3)
LABEL = EpisodeLabel("Lift", "faulty", "push", "mild", 7, onset=2, affected_channels=frozenset({"x[0]"}))
EPISODE = Episode(
    X,
    SPEC,
    success=True,
    seed=7,
    actions=X[:, 2:],
    observations=np.vstack([X[:1, :2], X[:, :2]]),
    rewards=np.ones(6, np.float32),
    faults=np.arange(6) >= 2,
    contact_force=np.arange(6, dtype=np.float32),
    label=LABEL,
    info={"terminated": False},
)


def assert_same(a, b):
    for name in ("stream", "actions", "observations", "rewards", "faults", "contact_force"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    assert (a.success, a.seed, a.spec, a.label, a.info) == (b.success, b.seed, b.spec, b.label, b.info)
    if a.label is not None:
        assert a.label.affected_channels == b.label.affected_channels


@pytest.mark.parametrize("episode", [EPISODE, replace(EPISODE, label=None), Episode(X, SPEC)])
def test_what_was_saved_is_loaded(episode, tmp_path):
    assert_same(load_episode(save_episode(tmp_path / "deep" / "one.npz", episode)), episode)


def test_a_label_names_a_file_and_an_episode_without_one_says_so():
    assert LABEL.path == Path("episodes/Lift/faulty/push-mild-7.npz")
    assert EPISODE.labelled is LABEL
    with pytest.raises(ValueError, match="has no label"):
        Episode(X, SPEC).labelled  # noqa: B018 (a property that raises)


def test_a_damaged_file_is_named(tmp_path):
    whole = save_episode(tmp_path / "new.npz", EPISODE).read_bytes()
    path = tmp_path / "one.npz"
    for damaged in (whole[: len(whole) // 2], b"", whole[:200] + bytes(b ^ 255 for b in whole[200:250]) + whole[250:]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"one\.npz is damaged"):
            load_episode(path)
    with pytest.raises(FileNotFoundError):
        load_episode(tmp_path / "none.npz")
