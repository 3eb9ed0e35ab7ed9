"""Intervals from scenes and calibration episodes drawn anew, against what the spread of the truth is."""

import numpy as np
import pytest

from asm_gym.evaluation.comparison import BenchmarkResult, Detectability, MonitorResult
from asm_gym.evaluation.detection_tables import lead_table
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.resampling import Calibration, drawn_anew, interval
from asm_gym.evaluation.scored_episode import ScoredEpisode


def a_trace(peak: float, seed: int, onset: int | None = None, before: float = 0.0) -> ScoredEpisode:
    surprise = np.zeros(10)
    surprise[5], surprise[4] = peak, before
    return ScoredEpisode("nominal" if onset is None else "push", seed, 0.1, 1.0, surprise, onset, task="Lift")


def scenes(rng: np.random.Generator, faults: int, n: int = 60) -> tuple[list[ScoredEpisode], list[ScoredEpisode]]:
    """``n`` nominal episodes, and ``faults`` faulty twins of each, which share what their scene adds."""
    height = rng.standard_normal(n)
    nominal = [a_trace(float(np.exp(0.2 * h)), s) for s, h in enumerate(height)]
    faulty = [a_trace(float(np.exp(h)), s, onset=5) for s, h in enumerate(height) for _ in range(faults)]
    return faulty, nominal


def test_more_faults_of_the_same_scenes_do_not_narrow_the_interval():
    widths = []
    for faults in (1, 20):
        faulty, nominal = scenes(np.random.default_rng(0), faults)
        drawn = drawn_anew(faulty, nominal, Calibration(np.ones(200), rates=(0.05,)), 0.5, draws=200).found[0.05]
        widths.append(interval(0.5, drawn).high - interval(0.5, drawn).low)
    assert widths[1] == pytest.approx(widths[0], rel=0.05)
    assert widths[0] == pytest.approx(4 * np.sqrt(0.25 / 60), rel=0.25)  # ± 2 standard errors of 60 scenes


def test_the_interval_holds_what_calibration_adds():
    # Peaks lie close about the threshold, so that it is the threshold that decides.
    rng = np.random.default_rng(1)
    nominal = [a_trace(1.0, s) for s in range(60)]
    faulty = [a_trace(float(p), s, onset=5) for s, p in enumerate(1.0 + 0.01 * rng.standard_normal(60))]
    certain = drawn_anew(faulty, nominal, Calibration(np.ones(40), rates=(0.5,)), 0.5, draws=200).found[0.5]
    maxima = 1 + 0.05 * rng.standard_normal(40)
    unsure = drawn_anew(faulty, nominal, Calibration(maxima, rates=(0.5,)), 0.5, draws=200).found[0.5]
    assert np.std(unsure) > 1.5 * np.std(certain)


def test_draws_agree_with_the_figures_that_they_are_drawn_about():
    faulty, nominal = scenes(np.random.default_rng(2), 2)
    metrics = DetectionMetrics("asm", faulty, nominal, 0.5, {0.05: 1.0}, np.linspace(0.5, 1.01, 200))
    assert np.mean(metrics.draws.auroc) == pytest.approx(metrics.auroc, abs=0.02)
    assert np.mean(metrics.draws.found[0.05]) == pytest.approx(metrics.found[0.05].value, abs=0.03)


def test_an_alarm_that_was_up_before_the_fault_does_not_find_it():
    up = [a_trace(3.0, s, onset=5, before=2.0) for s in range(4)]
    drawn = drawn_anew(up, [a_trace(0.5, s) for s in range(4)], Calibration(np.ones(40), rates=(0.05,)), 0.5, draws=20)
    assert not drawn.found[0.05].any()
    assert (drawn.auroc == 1.0).all()


def test_a_rate_that_too_few_episodes_were_calibrated_for_has_no_interval():
    faulty, nominal = scenes(np.random.default_rng(3), 1, n=5)
    few = Calibration(np.ones(30), rates=(0.01, 0.05))
    assert drawn_anew(faulty, nominal, few, 0.5, draws=5).found.keys() == {0.05}


def test_the_lead_over_a_monitor_that_judged_alike_is_nothing():
    faulty, nominal = scenes(np.random.default_rng(4), 1)
    one = MonitorResult([*nominal, *faulty], [], {0.05: 1.0}, maxima=np.linspace(0.5, 1.1, 60))
    seen = [Detectability("Lift", "push", "", t.seed, 100.0, 0, 0.1) for t in faulty]
    table = lead_table(BenchmarkResult({"asm": one, "twin": one}, seen, 0.05, 0.5))
    assert table.rows == [("twin", "+0.000 (+0.000 to +0.000), within chance", "+0.0 (+0.0 to +0.0), within chance")]
