"""Scores of verdicts against values worked out by hand."""

import math

import numpy as np
import pytest

from asm_gym.evaluation import scoring
from asm_gym.evaluation.scoring import Verdict


def verdict(surprise, onset=None, task="Lift", **fields):
    kind = "nominal" if onset is None else "push"
    return Verdict(task, "asm", kind, "", 0, 0.1, np.array(surprise, float), onset, **fields)


NOMINAL = [verdict([1, 1, 2, 1]), verdict([1, 3, 1, 1]), verdict([5, 1, 1, 1]), verdict([0, 0, 0, 0])]


def test_placements_compare_the_same_steps_of_the_same_task():
    # In steps 1 and 2 the nominal maxima are 2, 3, 1, 0; another task's episode does not count.
    faulty = [verdict([9, 2.5, 0, 9], onset=1)]
    elsewhere = [verdict([9, 9, 9, 9], task="Door")]
    np.testing.assert_allclose(scoring.placements(faulty, NOMINAL + elsewhere, 0.2), [0.25])
    assert scoring.placements([verdict([0, 9], 1, task="Wipe")], NOMINAL, 0.2).size == 0


def test_a_tie_counts_half():
    np.testing.assert_allclose(scoring.placements([verdict([0, 2, 0], onset=1)], NOMINAL[:2], 0.2), [0.75])


def test_average_precision_of_a_hand_computed_case():
    # Recalls 1/2 and 1 at false-alarm rates 0 and 0.5: precisions 1 and 2/3.
    assert scoring.average_precision(np.array([0.5, 0.0])) == pytest.approx((1 + 2 / 3) / 2)
    assert math.isnan(scoring.average_precision(np.array([])))


def test_average_precision_of_chance_is_one_half():
    assert scoring.average_precision(np.linspace(0, 1, 1001)) == pytest.approx(0.5, abs=0.01)


def test_detections_and_delays():
    faulty = [
        verdict([0, 0, 9, 0, 0], onset=2),  # at once: 100 ms
        verdict([0, 0, 0, 9, 0], onset=2),  # 200 ms
        verdict([0, 9, 9, 9, 0], onset=2),  # stood before the onset and was not raised again
        verdict([0, 9, 0, 0, 9], onset=2),  # a false alarm, then too late for the window
    ]
    share = scoring.detections(faulty, threshold=1.0, window_s=0.2)
    assert (share.k, share.n) == (2, 4)
    late = scoring.delays(faulty, 1.0, 0.2)
    assert (late.median_ms, late.p95_ms, late.missed) == (pytest.approx(200), math.inf, 2)
    assert scoring.delays([], 1.0, 0.2) is None


def test_false_alarms_by_episode_and_by_hour():
    nominal = [verdict([0, 9, 0, 9]), verdict([0, 0, 0, 0])]
    assert scoring.coverage(nominal, 1.0).value == 0.5
    assert scoring.false_alarms_per_hour(nominal, 1.0) == pytest.approx(2 / (8 * 0.1 / 3600))


def test_accuracies():
    nominal = [verdict([0, 0, 0, 0]), verdict([9, 0, 0, 0])]
    faulty = [verdict([0, 0, 0, 9, 0], onset=1), verdict([0, 0, 0, 0, 0], onset=1)]
    assert scoring.balanced_accuracy(faulty, nominal, 1.0, 1.0) == pytest.approx(0.5)
    # One of two faults found, 2 of 4 steps after its onset.
    assert scoring.timestep_weighted_accuracy(faulty, nominal, 1.0) == pytest.approx(0.5 * (0.25 + 0.5))


def test_attribution_counts_alarms_alone():
    guilty = frozenset({"a", "b"})
    faulty = [verdict([9], 0, blamed=b, guilty=guilty) for b in ("a", "c", "")]
    share = scoring.attribution_accuracy(faulty)
    assert (share.k, share.n) == (1, 2)
