"""A shipped memory's false alarms per hour are counted over all that it never met, beside what was promised."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.rollouts.pretraining.exam import Marks
from asm_gym.scripts.reproduce.hours import exams_table, kept_table


def episode(seed, peak, onset=None, severity=""):
    """Ten minutes at a row a second, without surprise but for one row."""
    surprise = np.zeros(600)
    surprise[300 if onset is None else onset] = peak
    kind = "nominal" if onset is None else "push"
    return ScoredEpisode(kind, seed, 1.0, 0.0, surprise, onset=onset, task="Lift", severity=severity)


@pytest.fixture
def marks():
    solved = [episode(n, peak) for n, peak in enumerate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])]
    severities = [(2.5, "strong"), (9.0, "medium"), (2.0, "mild")]
    faults = [episode(n, peak, 200, severity) for n, (peak, severity) in enumerate(severities)]
    metrics = DetectionMetrics("", faults, solved, 1.0)
    return [Marks("Lift, lift_sac (left out)", solved, [episode(9, 99.0)], [], metrics)]


def test_a_row_for_each_promise_has_the_alarms_and_the_faults_found(marks):
    table = kept_table(marks, {1.0: 4.5, 5.0: 1.5})
    assert "in 1.00 healthy hours" in table.caption
    assert [row[:2] for row in table.rows] == [("1", "4.5"), ("5", "1.5")]
    assert [row[2].split()[0] for row in table.rows] == ["2.0", "5.0"]  # peaks 5 and 6; peaks 2 to 6
    assert [row[-2:] for row in table.rows] == [("50 % of 2", "0 % of 1"), ("100 % of 2", "100 % of 1")]


def test_a_promise_that_was_not_kept_is_called_broken(marks):
    (row,) = exams_table(marks, {0.5: 0.5, 10.0: 0.5}).rows
    assert row[:3] == ("Lift, lift_sac (left out)", "6 of 7", "1.00")
    assert row[3].endswith("broken")
    assert not row[4].endswith("broken")
