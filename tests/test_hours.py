"""A shipped memory's alarms an hour are counted over all that it never met, and set beside what was promised."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.rollouts.pretraining.exam import Marks
from asm_gym.scripts.reproduce.hours import Setting, each, kept, missed, records


def episode(seed, peak, onset=None, severity=""):
    """Ten minutes at a row a second, calm but for one row."""
    surprise = np.zeros(600)
    surprise[300 if onset is None else onset] = peak
    return ScoredEpisode(
        "nominal" if onset is None else "push", seed, 1.0, 0.0, surprise, onset=onset, task="Lift", severity=severity
    )


@pytest.fixture
def marks():
    solved = [episode(n, peak) for n, peak in enumerate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])]
    faults = [
        episode(n, peak, 200, severity)
        for n, peak, severity in [(0, 2.5, "strong"), (1, 9.0, "medium"), (2, 2.0, "mild")]
    ]
    return [
        Marks("Lift, lift_sac (left out)", solved, [episode(9, 99.0)], [], DetectionMetrics("", faults, solved, 1.0))
    ]


def test_a_row_a_promise_says_what_came_and_what_was_found(marks):
    table = kept(marks, [Setting("as shipped", {1.0: 4.5, 5.0: 1.5})])
    assert "in 1.00 healthy hours" in table.caption
    assert [row[:3] for row in table.rows] == [("as shipped", "1", "4.5"), ("as shipped", "5", "1.5")]
    assert [row[3].split()[0] for row in table.rows] == ["2.0", "5.0"]  # of the peaks 5 and 6; of 2 to 6
    assert table.headings[-2:] == ("medium and strong found", "mild found")
    assert [row[-2:] for row in table.rows] == [("50 % of 2", "0 % of 1"), ("100 % of 2", "100 % of 1")]


def test_a_promise_that_was_not_kept_is_called_broken(marks):
    rows = each(marks, Setting("anew", {0.5: 0.5, 10.0: 0.5})).rows
    assert rows[0][:3] == ("Lift, lift_sac (left out)", "6 of 7", "1.00")
    assert rows[0][3].endswith("broken")
    assert not rows[0][4].endswith("broken")


def test_every_count_is_kept(marks):
    found = records(marks, [Setting("anew", {1.0: 4.5})])
    assert [(r["alarms"], r["promised"]) for r in found] == [(2, 1.0)]


def test_kinds_that_are_missed_most_come_first(marks):
    table = missed(marks, Setting("as shipped", {1.0: 4.5, 5.0: 2.2}))
    assert table.rows == [("push", "3", "33 %", "67 %")]
