"""Scored episodes, metrics, statistics, the ideal observer and tables, against values by hand and published tables."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from asm_gym.data.episode import EpisodeLabel
from asm_gym.detection import Blocks, conformal_threshold
from asm_gym.evaluation import metrics
from asm_gym.evaluation.comparison import (
    BenchmarkResult,
    Bound,
    Detectability,
    auroc_bound,
    earliest,
    noise_floor,
    power_bound,
    separation,
    visible_kinds,
)
from asm_gym.evaluation.detection_tables import (
    UNLIKELY,
    brief_monitors_table,
    kept_table,
    kinds_table,
    lead_table,
    monitors_table,
    splits_table,
)
from asm_gym.evaluation.metrics import (
    Delays,
    DetectionMetrics,
    by_condition,
    delays_ms,
    false_alarms,
    hourly_alarms,
)
from asm_gym.evaluation.resampling import Calibration, Windows, Wins, interval, resample
from asm_gym.evaluation.scored_episode import InterventionOutcome, ScoredEpisode
from asm_gym.evaluation.scoring import fitted
from asm_gym.evaluation.statistics import Rate, Share, auroc
from asm_gym.evaluation.tables import Table, plain_cell, tabulate
from asm_gym.monitors.calibration import AlarmRate
from tests.streams import sine_episodes


def a_trace(
    surprise: Any, onset: int | None = None, kind: str | None = None, **fields: Any
) -> ScoredEpisode:
    """An episode of 0.1 s steps and the threshold 10."""
    kind = kind or ("nominal" if onset is None else "push")
    values: dict[str, Any] = {"dt": 0.1, "threshold": 10.0, "seed": 0, "onset": onset, **fields}
    outcome = [values.pop(name, default) for name, default in (("success", True), ("force", 0.0))]
    surprise = np.asarray(surprise, np.float64)
    return ScoredEpisode(
        kind=kind, surprise=surprise, outcome=InterventionOutcome(*outcome), **values
    )


# ------------------------------------------------------------------ scored episodes


@pytest.mark.parametrize(
    ("surprise", "onset", "false", "after"),
    [
        ([1, 1, 1, 1, 20, 20], 2, (), 2),
        ([1, 20, 1, 1, 1], 3, (1,), None),
        ([20, 20, 20, 20], 2, (0,), None),  # up before the onset
        ([20, 20, 20, 1, 20], 2, (0,), 2),  # raised again
        ([20, 1, 1], 0, (), 0),
        ([20, 1, 20, 20], None, (0, 2), None),
    ],
)
def test_an_alarm_is_false_before_the_onset_and_a_detection_when_raised_since(
    surprise, onset, false, after
):
    trace = a_trace(surprise, onset)
    assert (trace.false_alarms, trace.detected_after) == (false, after)
    assert trace.delay == (None if after is None else pytest.approx(0.1 * (after + 1)))
    if onset is not None:
        assert Windows([trace], 1.0).detected(10.0).tolist() == [after is not None]
        assert Windows([trace], 0.2).detected(10.0).tolist() == [after is not None and after < 2]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"surprise": np.zeros((3, 2))}, r"surprise.*\(3, 2\)"),
        ({"surprise": []}, r"surprise.*\(0,\)"),
        ({"surprise": np.array([1.0, np.nan, 1.0])}, "NaN"),
    ],
)
def test_an_episode_refuses_what_it_cannot_mean(fields, message):
    with pytest.raises(ValueError, match=message):
        a_trace(fields.pop("surprise", [1, 1, 1]), **fields)


def test_another_threshold_changes_the_alarms_and_nothing_else():
    trace = a_trace([1, 20, 30], onset=1).attributed(np.eye(3), ("a", "b", "c"))
    other = trace.at(25.0)
    assert (trace.alarms, trace.top_channel) == ((1,), "b")
    assert (other.alarms, other.detected_after, other.top_channel) == ((2,), 1, "")


# ------------------------------------------------------------------ metrics


def test_time_matching_compares_each_fault_with_the_same_steps_of_nominal_episodes_of_its_task():
    # Every episode is surprised at step 0, the nominal ones at step 3 too: only steps 1 and 2 may count.
    faulty = a_trace([99, 5, 7, 1], onset=1)
    nominal = [
        a_trace([90, 6, 1, 90]),
        a_trace([90, 1, 8, 90]),
        a_trace([90, 7, 1, 90]),
        a_trace([90, 1, 1, 90]),
    ]
    nominal.append(a_trace([90, 90, 90, 90], task="Door"))
    # 8 above, 7 tied
    assert Wins([faulty], nominal, 0.2).auroc() == pytest.approx(1 - (1 + 0.5) / 4)
    assert math.isnan(Wins([faulty], [a_trace([99])], 1.0).auroc())  # it ended before the onset
    assert math.isnan(Wins([a_trace([0, 9], onset=2)], nominal, 0.2).auroc())


def test_a_delay_is_at_least_one_step_and_a_late_alarm_is_a_miss():
    at_once, late = a_trace([1, 20, 1, 1, 1], onset=1), a_trace([1, 1, 1, 20, 1], onset=1)
    never, nominal = a_trace([1, 1, 1, 1, 1], onset=1), a_trace([20, 20])
    assert delays_ms([late, at_once, never, nominal], window_s=0.3) == pytest.approx(
        [100, 300, math.inf]
    )
    assert DetectionMetrics("", [late, at_once, never], [], window_s=0.2).detected == Share(1, 3)


def test_quantiles_of_the_delay_count_misses_as_infinitely_late():
    traces = [a_trace([1] * k + [20] + [1] * 30, onset=0) for k in range(20)]  # 100, 200, … 2000 ms
    assert Delays.of(delays_ms(traces, window_s=5.0)) == pytest.approx(Delays(1000.0, 1900.0))
    assert Delays.of(delays_ms(traces, window_s=1.5)) == pytest.approx(Delays(1000.0, math.inf))
    assert Delays.of([]) == Delays(math.inf, math.inf)


def test_alarms_an_hour_count_only_the_time_before_the_fault_and_one_a_minute():
    faulty = np.ones(1400)
    faulty[[5, 6, 20, 50, 60, 661, 1310]] = (
        20  # the fifth and the sixth are more than a minute apart
    )
    nominal = np.ones(60)
    nominal[3] = 20
    found = hourly_alarms([a_trace(faulty, onset=1300), a_trace(nominal)])
    assert found == (3, pytest.approx(136 / 3600))
    excused = {"knock": np.full(60, 99.0)}
    assert hourly_alarms([a_trace(np.ones(60), excused=excused)], "knock").k == 1
    # a fault is no knock beside it
    assert hourly_alarms([a_trace(np.full(60, 20), excused=excused)], "knock").k == 0
    assert math.isnan(hourly_alarms([a_trace([1, 1], onset=0)]).value)


def test_a_summary_reads_detection_from_watched_episodes_and_outcomes_from_each_response():
    traces = [
        a_trace([1, 1, 20, 1], onset=1, success=False, top_channel="loud", force=50.0),
        a_trace([1, 1, 1, 1], onset=1, success=False, force=70.0),
        a_trace([20, 1, 1, 20], onset=1, top_channel="loud", force=290.0),
        # The wrapped episodes see an alarm at once, which must not touch the results of detection.
        a_trace([1, 20, 1, 1], onset=1, acting="hold", force=10.0),
        a_trace([1, 20, 1, 1], onset=1, acting="hold", force=20.0),
        a_trace([1, 2, 3, 4]),
        a_trace([1, 2, 30, 4]),
    ]
    nominal, push = by_condition(traces, window_s=0.2)
    assert (nominal.name, len(nominal.watched), nominal.delays) == ("nominal", 2, Delays())
    assert (false_alarms(nominal.watched), nominal.detected) == (Share(1, 2), Share(0, 0))
    # the third alarm is late
    assert (push.name, len(push.watched), push.detected) == (
        "push",
        3,
        Share(1, 3),
    )
    assert push.delays == Delays(math.inf, math.inf)
    assert push.auroc == pytest.approx(1 / 6)  # maxima 20, 1, 1 against 3, 30
    alone, held = push.outcomes
    assert (alone.acting, alone.success, alone.peak_force) == ("policy alone", Share(1, 3), 70.0)
    assert (alone.unsafe, held.unsafe) == (Share(1, 1), Share(0, 2))
    assert (held.acting, held.success, held.peak_force) == ("hold", Share(2, 2), 15.0)


# ------------------------------------------------------------------ statistics


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0, 0.1611), (0, 0, 0, 1)],
)
def test_wilson_gives_the_intervals_of_newcombe_1998(k, n, low, high):
    assert Share(k, n).interval == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("k", "low", "high"), [(0, 0.0, 3.6889), (1, 0.0253, 5.5716), (100, 81.3640, 121.6268)]
)
def test_a_rate_has_the_intervals_of_garwood_1936(k, low, high):
    assert Rate(k, 1.0).interval == pytest.approx((low, high), abs=5e-5)


def test_a_rate_is_by_the_hour_and_unknown_without_time():
    assert Rate(5, 2.0).interval == pytest.approx((1.6235 / 2, 11.6683 / 2), abs=5e-5)
    assert (Rate(5, 2.0).text, Rate(0, 0.0).text, Rate(0, 0.0).interval) == (
        "2.5 (0.8 to 5.8)",
        "",
        (0.0, math.inf),
    )
    assert math.isnan(Rate(0, 0.0).value)


def test_auroc_is_the_mann_whitney_statistic_takes_infinity_and_refuses_nan():
    rng = np.random.default_rng(0)
    pos, neg = rng.integers(0, 9, 40), rng.integers(0, 7, 60)
    assert auroc(pos, neg) == pytest.approx(stats.mannwhitneyu(pos, neg).statistic / (40 * 60))
    assert auroc([math.inf, math.inf], [1.0, math.inf]) == pytest.approx(0.75)
    with pytest.raises(ValueError, match="nan"):
        auroc([math.nan], [1.0])


# ------------------------------------------------------------------ the ideal observer


def test_the_bounds_are_what_the_likelihood_ratio_reaches():
    """A known signal in white noise, drawn many times: AUROC and power of its log likelihood ratio."""
    rng = np.random.default_rng(0)
    signal, noise = np.array([[0.4, -0.2], [0.1, 0.3], [0.5, 0.0]]), np.array([0.5, 0.2])
    S = separation(signal, np.zeros((3, 2)), noise, onset=0)
    assert S[-1] == pytest.approx(((signal / noise) ** 2).sum())
    draws = rng.standard_normal((2, 40_000, 3, 2)) * noise
    ratio = [
        ((x * signal - signal**2 / 2) / noise**2).sum(axis=(1, 2))
        for x in (draws[0], draws[1] + signal)
    ]
    assert ratio[1].mean() == pytest.approx(S[-1] / 2, rel=0.03)
    assert auroc(ratio[1], ratio[0]) == pytest.approx(float(auroc_bound(S[-1])), abs=0.005)
    threshold = np.quantile(ratio[0], 0.95)
    assert (ratio[1] > threshold).mean() == pytest.approx(float(power_bound(S[-1], 0.05)), abs=0.01)


def test_the_earliest_step_is_where_the_power_suffices():
    """√S must reach z(0.99) + z(0.95) = 3.971, which steps of √S = 2, 2.83, 3.46, 4 do at the fourth."""
    faulty = np.zeros((9, 1))
    faulty[3:] = 2.0
    assert earliest(separation(faulty, np.zeros((9, 1)), np.ones(1), onset=3)) == 3
    assert len(separation(np.zeros((6, 1)), np.zeros((9, 1)), np.ones(1), onset=2)) == 4
    with pytest.raises(ValueError, match="not twins"):
        separation(np.ones((4, 1)), np.zeros((4, 1)), np.ones(1), onset=2)


def test_channels_without_noise_get_a_thousandth_of_their_spread():
    stream = np.column_stack([np.tile([-1.0, 1.0], 50), np.tile([-1.0, 1.0], 50), np.zeros(100)])
    np.testing.assert_allclose(noise_floor(np.array([0.5, 0.0, 0.0]), [stream]), [0.5, 1e-3, 1e-9])


# ------------------------------------------------------------------ monitors side by side


def judged(peak, kind="nominal", severity="", onset=None):
    surprise = np.zeros(10)
    surprise[5] = peak
    affected = frozenset("a")
    trace = ScoredEpisode(
        kind, 0, 0.05, 3.5, surprise, onset, severity, "Lift", "asm", affected_channels=affected
    )
    return trace.attributed(np.ones((10, 1)), ("a",))


def visibility(separation, kind="push", severity="strong", delay=0.05):
    return Detectability(kind, severity, separation, delay)


NOMINAL = [judged(p) for p in (1.0, 2.0, 3.0, 4.0)]
FAULTY = [
    judged(5.0, "push", "strong", onset=5),
    judged(2.5, "push", "mild", onset=5),
    judged(0.0, "noise", "mild", onset=5),
]
ONE, FIVE = AlarmRate(0.01, "episode"), AlarmRate(0.05, "episode")
RESULT = DetectionMetrics("asm", FAULTY, NOMINAL, 1.0, Calibration({ONE: 3.5, FIVE: 2.2}))


def test_a_kind_is_visible_where_an_ideal_observer_finds_half_of_it():
    # Power at 1 %: Φ(√S - 2.326), one half at S = 5.41.
    found = [
        visibility(6.0),
        visibility(5.0, "touch"),
        visibility(100.0, "shove"),
        visibility(0.0, "shove"),
    ]
    assert list(visible_kinds(found).values()) == [True, False, True]
    ideal = Bound.of([visibility(2.0, delay=None), visibility(np.inf, delay=0.1)], 0.01)
    assert ideal.auroc == pytest.approx((0.8413447 + 1) / 2)  # Φ(√(2/2)) and 1
    assert ideal.delays == (100.0, math.inf)


def test_scores_are_means_over_the_kinds_that_can_be_seen():
    asm = RESULT.only([("push", "strong"), ("push", "mild")])
    assert asm.auroc == pytest.approx((1.0 + 0.5) / 2)
    assert (asm.found[ONE], asm.found[FIVE]) == ((1, 2), (2, 2))
    assert metrics.attribution_accuracy(asm.faulty) == (1, 1)
    assert [RESULT.only([(t.kind, t.severity)]).auroc for t in FAULTY] == [1.0, 0.5, 0.0]


def test_the_tables_of_a_benchmark_put_the_ideal_observer_first_and_hide_what_nobody_sees():
    seen = [visibility(100.0), visibility(100.0, severity="mild"), visibility(0.1, "noise", "mild")]
    result = BenchmarkResult({"asm": RESULT}, seen, rate=0.01, window_s=1.0)
    table = monitors_table(result)
    ideal, asm = (dict(zip(table.headings, row, strict=True)) for row in table.rows)
    assert (ideal["Monitor"], ideal["AUROC, same steps"], ideal["False alarms"]) == (
        "ideal observer",
        "1.000",
        "",
    )
    assert asm["AUROC, same steps"].startswith("0.750 (")
    assert (asm["Found at 1 %"], asm["Found at 0.5 %"]) == ("50 %", "needs 199")
    assert (asm["False alarms"], asm["Median delay [ms]"]) == ("1 of 4 (5–70 %)", "50")
    assert "noise mild" in table.caption
    assert set(brief_monitors_table(result).headings) < set(table.headings)
    assert brief_monitors_table(result).rows[1][1] == "0.750"
    assert kinds_table(result).rows[2] == ("(noise mild)", "0.59 / 0 %", "0.00 / 0 %")


def test_a_promise_is_tried_on_random_halves_of_the_nominal_episodes():
    calibrated = np.random.default_rng(1).pareto(3.0, 300) + 1.0
    nominal = [
        ScoredEpisode("nominal", s, 0.1, 1.0, np.array([0.0, p]))
        for s, p in enumerate(calibrated[150:])
    ]
    faulty = [
        ScoredEpisode("push", 0, 0.1, 1.0, np.array([0.0, p, 0.0]), onset=1, severity="mild")
        for p in (0.5, 99.0)
    ]
    promises = dict.fromkeys((ONE, FIVE, AlarmRate(1.0, "hour")), 0.0)
    blocks = Blocks.of([t.surprise for t in nominal], 0.1)
    one = DetectionMetrics(
        "asm", faulty, nominal, 0.5, Calibration(promises, calibrated[:150], blocks)
    )
    table = splits_table(
        BenchmarkResult({"asm": one}, [visibility(100.0, severity="mild")], 0.05, 0.5)
    )
    for row in table.rows:
        for cell, rate in zip(row[1:3], (1.0, 5.0), strict=True):
            came, found = cell.split(", ")
            assert 0.3 * rate < float(came.split()[0]) < 1.3 * rate
            assert found == "50.0 ± 0.0 % found"
        assert row[3] == ""  # half of the episodes are seconds long


def promised(calibrated, tested):
    """One monitor, by its maxima."""
    nominal = [
        ScoredEpisode("nominal", s, 0.1, 1.0, np.array([0.0, p])) for s, p in enumerate(tested)
    ]
    threshold = conformal_threshold(calibrated, 0.05)
    one = DetectionMetrics("asm", [], nominal, 0.5, Calibration({FIVE: threshold}, calibrated))
    return kept_table(BenchmarkResult({"asm": one}, [], 0.05, 0.5)).rows[0][1]


def test_a_kept_promise_is_called_broken_as_seldom_as_is_said_and_a_broken_one_is():
    rng, broken = np.random.default_rng(0), 0
    for _ in range(400):
        broken += "broken" in promised(rng.exponential(size=99), rng.exponential(size=300))
    assert 0 < broken <= stats.binom.ppf(0.999, 400, UNLIKELY)
    assert "broken" in promised(rng.exponential(size=99), 2 * rng.exponential(size=300))


# ------------------------------------------------------------------ resampled intervals


def peaked(peak: float, seed: int, onset: int | None = None, before: float = 0.0) -> ScoredEpisode:
    surprise = np.zeros(10)
    surprise[5], surprise[4] = peak, before
    return ScoredEpisode(
        "nominal" if onset is None else "push", seed, 0.1, 1.0, surprise, onset, task="Lift"
    )


def scenes(rng, faults: int, n: int = 60):
    """``faults`` faulty twins of each of ``n`` nominal episodes, which share what their scene adds."""
    height = rng.standard_normal(n)
    nominal = [peaked(float(np.exp(0.2 * h)), s) for s, h in enumerate(height)]
    return [
        peaked(float(np.exp(h)), s, onset=5) for s, h in enumerate(height) for _ in range(faults)
    ], nominal


def test_more_faults_of_the_same_scenes_do_not_narrow_the_interval():
    widths = []
    for faults in (1, 20):
        calibration = Calibration({FIVE: 1.0}, np.ones(200))
        drawn = resample(
            *scenes(np.random.default_rng(0), faults), calibration, 0.5, draws=200
        ).found[FIVE]
        widths.append(interval(0.5, drawn).high - interval(0.5, drawn).low)
    assert widths[1] == pytest.approx(widths[0], rel=0.05)
    # ± 2 standard errors of 60 scenes
    assert widths[0] == pytest.approx(4 * np.sqrt(0.25 / 60), rel=0.25)


def test_resamples_agree_with_the_results_that_they_are_about():
    faulty, nominal = scenes(np.random.default_rng(2), 2)
    calibration = Calibration({FIVE: 1.0}, np.linspace(0.5, 1.01, 200))
    found = DetectionMetrics("asm", faulty, nominal, 0.5, calibration)
    assert np.mean(found.draws.auroc) == pytest.approx(found.auroc, abs=0.02)
    assert np.mean(found.draws.found[FIVE]) == pytest.approx(found.found[FIVE].value, abs=0.03)
    # an alarm that was up already is no detection
    up = [peaked(3.0, s, onset=5, before=2.0) for s in range(4)]
    assert not resample(up, nominal, calibration, 0.5, draws=20).found[FIVE].any()


def test_the_lead_over_a_monitor_that_judged_alike_is_nothing():
    faulty, nominal = scenes(np.random.default_rng(4), 1)
    one = DetectionMetrics(
        "asm", faulty, nominal, 0.5, Calibration({FIVE: 1.0}, np.linspace(0.5, 1.1, 60))
    )
    seen = [Detectability("push", "", 100.0, 0.1) for _ in faulty]
    table = lead_table(
        BenchmarkResult({"asm": one, "twin": replace(one, name="twin")}, seen, 0.05, 0.5)
    )
    assert table.rows == [
        ("twin", "+0.000 (+0.000 to +0.000), within chance", "+0.0 (+0.0 to +0.0), within chance")
    ]


# ------------------------------------------------------------------ fitted monitors


def recordings():
    return [
        replace(episode, label=EpisodeLabel("Sines", "fit", seed=n))
        for n, episode in enumerate(sine_episodes(8))
    ]


def test_a_fitted_monitor_is_kept_and_a_damaged_one_is_fitted_anew(tmp_path):
    first = fitted(tmp_path, "kalman", recordings(), 0)
    (kept,) = (tmp_path / "monitors").glob("*")
    written = kept.stat().st_mtime_ns
    again = fitted(tmp_path, "kalman", recordings(), 0)
    assert kept.stat().st_mtime_ns == written
    assert set(again.learned_) == set(first.learned_)
    kept.write_bytes(kept.read_bytes()[:100])
    fitted(tmp_path, "kalman", recordings(), 0)
    assert kept.stat().st_size > 1000


def test_recordings_of_the_same_names_and_other_rows_share_no_fitted_monitor(tmp_path):
    first = fitted(tmp_path, "kalman", recordings(), 0)
    louder = [replace(r, stream=1.5 * r.stream) for r in recordings()]
    second = fitted(tmp_path, "kalman", louder, 0)
    episode = recordings()[0]
    assert not np.allclose(first.score(episode).value, second.score(episode).value)


# ------------------------------------------------------------------ tables


@pytest.mark.parametrize("number", ["-1.65", "+2e-3", "-inf", "nan", "4"])
def test_a_number_in_a_csv_stays_one_and_a_formula_is_quoted(number):
    assert plain_cell(number) == number
    assert plain_cell(f"{number}+cmd()").startswith("'" if number[0] in "+-" else number)
    assert plain_cell("=1+1") == "'=1+1"


def test_a_new_column_is_a_heading_and_a_function():
    table = tabulate("numbers", {"n": str, "squared": lambda n: f"{n * n:d}"}, [2, 3])
    assert (table.headings, table.rows) == (["n", "squared"], [("2", "4"), ("3", "9")])
    with pytest.raises(ValueError, match="2 columns, but a row of 1"):
        Table("t", ("a", "b"), [("x",)])


@pytest.mark.parametrize("width", [60, 80, 120, 250])
def test_no_word_of_a_table_breaks_and_columns_left_out_are_named(width):
    headings = ("policy", *(f"heading{n} of a column" for n in range(12)))
    row = ("a scripted expert", *(f"number{n} [N]" for n in range(12)))
    console = Console(width=width, color_system=None)
    with console.capture() as printed:
        console.print(Table("t", headings, [row]))
    lines = printed.get().splitlines()
    assert max(map(len, lines)) <= width
    words = printed.get().replace(",", " ").replace(".", " ").split()
    shown = [f"number{n}" in words for n in range(12)]
    assert all(f"heading{n}" in words for n in range(12))
    assert shown == sorted(shown, reverse=True)
    assert shown[0]
    assert all(shown) == (width == 250)


def test_a_terminal_shows_a_row_in_a_line():
    headings = ("guard", "harm of hostile policies avoided", "healthy [episodes]")
    console = Console(width=120, color_system=None)
    with console.capture() as caught:
        console.print(Table("Harm avoided", headings, [("default", "99.7 %", "1156 of 1200")]))
    assert any("99.7 %" in line and "1156 of 1200" in line for line in caught.get().splitlines())
    assert "healthy [episodes]" in caught.get()
