"""What was promised, beside what came: over all tasks, and in each."""

import numpy as np
import pytest
from scipy import stats

from asm_gym.detection import conformal_threshold
from asm_gym.evaluation.comparison import BenchmarkResult, Detectability, MonitorResult
from asm_gym.evaluation.detection_tables import UNLIKELY, coverage_table, kept_table
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.statistics import chance_of_alarms
from asm_gym.monitors import make_monitor
from tests.streams import sine_episodes

RATE = 0.05


def traces(task: str, peaks) -> list[ScoredEpisode]:
    return [ScoredEpisode("nominal", s, 0.1, 1.0, np.array([0.0, p]), task=task) for s, p in enumerate(peaks)]


def judged(calibrated: dict[str, np.ndarray], tested: dict[str, np.ndarray]) -> BenchmarkResult:
    """One monitor, by its maxima in each task."""
    maxima = np.concatenate(list(calibrated.values()))
    tasks = [task for task, own in calibrated.items() for _ in own]
    nominal = [t for task, peaks in tested.items() for t in traces(task, peaks)]
    fault = ScoredEpisode("push", 0, 0.1, 1.0, np.array([0.0, 0.0, 9.0]), 2, task="Lift")
    threshold = conformal_threshold(maxima, RATE)
    one = MonitorResult([*nominal, fault], [], {RATE: threshold}, maxima=maxima, calibration_tasks=tasks)
    return BenchmarkResult({"asm": one}, [Detectability("Lift", "push", "", 0, 100.0, 0, 0.1)], RATE, 0.5)


def test_the_chance_of_alarms_is_beta_binomial():
    for k, n, beyond, calibrated in ((10, 707, 4, 538), (0, 5, 0, 19), (5, 5, 18, 19)):
        expected = stats.betabinom.sf(k - 1, n, beyond + 1, calibrated - beyond)
        assert chance_of_alarms(k, n, beyond, calibrated) == pytest.approx(expected, rel=1e-9)


def test_a_promise_that_is_kept_is_called_broken_as_seldom_as_is_said():
    rng, broken = np.random.default_rng(0), 0
    for _ in range(400):
        result = judged({"Lift": rng.exponential(size=99)}, {"Lift": rng.exponential(size=300)})
        broken += "broken" in kept_table(result).rows[0][1]
    assert 0 < broken <= stats.binom.ppf(0.999, 400, UNLIKELY)


def test_a_promise_that_is_not_kept_is_called_broken():
    rng = np.random.default_rng(1)
    result = judged({"Lift": rng.exponential(size=99)}, {"Lift": 2 * rng.exponential(size=300)})
    assert "broken" in kept_table(result).rows[0][1]


def test_a_threshold_for_all_tasks_is_told_from_one_for_each():
    calm, wild = np.linspace(0, 1, 100), np.linspace(0, 4, 100)
    table = coverage_table(judged({"Lift": calm, "Door": wild}, {"Lift": calm, "Door": wild}))
    of_all, in_calibration, of_each = table.rows
    assert of_all[1:] == ("5 % of all", "0 of 100", "9 of 100")
    assert in_calibration[2:] == of_all[2:]
    assert of_each[1:] == ("5 % of each, finds 100 %", "0 of 100", "4 of 100")


def test_a_task_that_is_not_what_it_was_in_calibration_is_named():
    calm = np.linspace(0, 1, 100)
    table = coverage_table(judged({"Lift": calm, "Door": calm}, {"Lift": calm, "Door": 1.5 * calm}))
    assert table.rows[0][2:] == ("4 of 100", "36 of 100, more than in calibration")


def test_a_promise_for_each_task_takes_the_greatest_threshold_that_one_needs():
    quiet, loud = sine_episodes(30, 0), sine_episodes(30, 1, noise=0.1)
    monitor = make_monitor("kalman", quiet[0].spec).fit(sine_episodes(6, 2))
    names = ["quiet"] * 30 + ["loud"] * 30
    of_all = monitor.calibrate([*quiet, *loud], RATE).threshold
    alone = monitor.calibrate(loud, RATE).threshold
    assert monitor.calibrate([*quiet, *loud], RATE, each=names).threshold == alone > of_all
    with pytest.raises(ValueError, match=r"^loud by itself: .* needs at least 19 nominal episodes, got 9"):
        monitor.calibrate([*quiet, *loud[:9]], RATE, each=names[:39])
    with pytest.raises(ValueError, match="each must name one group an episode, got 59 for 60"):
        monitor.calibrate([*quiet, *loud], RATE, each=names[1:])
    assert monitor.threshold == alone
