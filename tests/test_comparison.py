"""Tables of monitors, from verdicts made by hand."""

import math

import numpy as np
import pytest

from asm_gym.evaluation import comparison
from asm_gym.evaluation.comparison import Sight
from asm_gym.evaluation.scoring import Verdict


def verdict(peak, kind="nominal", severity="", onset=None):
    surprise = np.zeros(10)
    surprise[5] = peak
    return Verdict("Lift", "asm", kind, severity, 0, 0.05, surprise, onset, "a" if onset else "", frozenset("a"))


def sight(separation, kind="push", severity="strong", earliest=0):
    return Sight("Lift", kind, severity, 0, separation, earliest, 0.05)


VERDICTS = [
    *(verdict(p) for p in (1.0, 2.0, 3.0, 4.0)),
    verdict(5.0, "push", "strong", onset=5),
    verdict(2.5, "push", "mild", onset=5),
    verdict(0.0, "noise", "mild", onset=5),
]


def test_a_kind_is_visible_where_an_ideal_observer_finds_half_of_it():
    # Power at 1 %: Φ(√S - 2.326), one half at S = 5.41.
    sights = [sight(6.0), sight(5.0, "touch"), sight(100.0, "shove"), sight(0.0, "shove")]
    assert comparison.visible_kinds(sights) == {
        ("push", "strong"): True,
        ("touch", "strong"): False,
        ("shove", "strong"): True,  # half of them surely
    }


def test_the_ideal_row_holds_the_bounds():
    cell = comparison.ideal_cell([sight(2.0, earliest=None), sight(np.inf, earliest=1)])
    assert cell.auroc == pytest.approx((0.8413447 + 1) / 2)  # Φ(√(2/2)) and 1
    assert (cell.median_ms, cell.p95_ms) == (pytest.approx(100.0), math.inf)
    assert math.isnan(cell.precision)


def test_scores_are_means_over_the_kinds_that_can_be_seen():
    visible = {("push", "strong"): True, ("push", "mild"): True, ("noise", "mild"): False}
    score = comparison.score("asm", VERDICTS, {0.01: 3.5, 0.05: 2.2}, 0.01, 1.0, visible)
    assert score.cell.auroc == pytest.approx((1.0 + 0.5) / 2)
    assert (score.cell.found[0.01].k, score.cell.found[0.05].k, score.cell.found[0.05].n) == (1, 2, 2)
    assert (score.cell.median_ms, score.cell.p95_ms) == (50.0, math.inf)
    assert score.false_alarms.value == 0.25
    assert score.false_alarms_per_hour == pytest.approx(1 / (40 * 0.05 / 3600))
    assert score.balanced_accuracy == pytest.approx((0.5 + 0.75) / 2)
    assert score.attribution.n == 2


def test_each_kind_has_a_cell_of_its_own():
    cells = comparison.by_kind(VERDICTS, {0.01: 3.5}, 0.01, 1.0)
    assert list(cells) == [("push", "strong"), ("push", "mild"), ("noise", "mild")]
    assert [c.auroc for c in cells.values()] == [1.0, 0.5, 0.0]
