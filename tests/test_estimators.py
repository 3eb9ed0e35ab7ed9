"""Estimators of scikit-learn and classes of one's own enter the comparison by their names."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.ensemble import IsolationForest

from asm_gym.episode import Episode
from asm_gym.monitors import MONITORS, make_monitor, monitor_class
from tests.models import Persistence
from tests.streams import sine_episodes

NAME = "sklearn.ensemble:IsolationForest"


class Mute:
    """No model."""


class Wordy(IsolationForest):
    """Gives two numbers a row."""

    def score_samples(self, X):
        return np.zeros((len(X), 2))


def saying(name, change):
    """A class of models whose ``predict`` gives ``change(state, output)``."""

    def predict(self, state, rows):
        return change(*Persistence.predict(self, state, rows))

    return type(name, (Persistence,), {"kind": name, "predict": predict})


Lopsided = saying("lopsided", lambda state, said: (state, said._replace(errors=said.errors[:, 1:])))
Stateless = saying("stateless", lambda state, said: said)
Lost = saying("lost", lambda state, said: (state, said._replace(errors=said.errors * np.nan)))


class Unlearned:
    """An estimator that learns nothing."""

    def score_samples(self, rows):
        return rows[:, 0]


@pytest.fixture(autouse=True)
def registered():
    before = dict(MONITORS)
    yield
    MONITORS.clear()
    MONITORS.update(before)


def judged(name):
    monitor = make_monitor(name, sine_episodes(1)[0].spec, seed=3).fit(sine_episodes(20))
    return monitor.calibrate(sine_episodes(40, 1), 0.05)


def alarms(name):
    """In a worker, of what nobody registered there."""
    broken = sine_episodes(1, 5)[0].stream.copy()
    broken[20:, :12] *= 5.0
    monitor = judged(name)
    return bool(monitor.score(Episode.from_stream(broken, monitor.spec)).value[20:].max() > monitor.threshold)


def test_an_isolation_forest_finds_a_jump_and_its_file_has_no_pickle(tmp_path):
    assert alarms(NAME)
    monitor = judged(NAME)
    monitor.save(tmp_path / "m.asm")
    again = monitor_class(NAME).load(tmp_path / "m.asm")
    episode = sine_episodes(1, 9)[0]
    np.testing.assert_array_equal(again.score(episode).value, monitor.score(episode).value)
    assert b"sklearn" not in (tmp_path / "m.asm").read_bytes()


def test_what_is_no_model_is_refused_in_a_line():
    with pytest.raises(ValueError, match="is no model: it has no kind, fit, start, predict, restore; derive from"):
        monitor_class("tests.test_estimators:Mute")
    with pytest.raises(ValueError, match="is no model: it has no kind, fit, start"):
        monitor_class("tests.test_estimators:Unlearned")
    with pytest.raises(ValueError, match=r"score_samples of Wordy must give \(\d+,\).*got \(\d+, 2\)"):
        judged("tests.test_estimators:Wordy")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Lopsided", r"predict of lopsided must give errors \(\d+, 12\), got \(\d+, 11\)"),
        ("Stateless", "must give a state and a ModelOutput, got ModelOutput"),
        ("Lost", "must give errors that are finite where the rows are"),
    ],
)
def test_what_a_model_may_not_say_is_refused_in_a_line(name, message):
    with pytest.raises(ValueError, match=message):
        judged(f"tests.test_estimators:{name}")
