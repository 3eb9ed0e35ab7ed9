"""Metrics against hand-computed values, published tables and definitions counted out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from asm_gym.evaluation.earliness import aucpdt

from asm_gym.episode import spans
from asm_gym.evaluation import metrics
from asm_gym.evaluation.metrics import (
    Delays,
    by_condition,
    delays_ms,
    detected,
    false_alarms,
    hourly_alarms,
    placements,
    time_matched_auroc,
    typical,
)
from asm_gym.evaluation.scored_episode import InterventionOutcome, ScoredEpisode, TraceDetail, window_steps
from asm_gym.evaluation.statistics import Share, auroc, wilson_interval


def a_trace(
    surprise: Any, onset: int | None = None, kind: str | None = None, contact_force: float = 0.0, **fields: Any
) -> ScoredEpisode:
    """A trace of 0.1 s steps and the threshold 10."""
    kind = kind or ("nominal" if onset is None else "push")
    values: dict[str, Any] = {"dt": 0.1, "threshold": 10.0, "seed": 0, "onset": onset, **fields}
    outcome = InterventionOutcome(values.pop("success", True), values.pop("ended_by_alarm", False), contact_force)
    return ScoredEpisode(kind=kind, surprise=np.asarray(surprise, np.float64), outcome=outcome, **values)


def detail(fault: Any) -> TraceDetail:
    return TraceDetail(np.zeros((len(fault), 2)), ("calm", "loud"), fault)


def test_spans_are_the_runs_of_true():
    assert spans(np.array([True, True, False, True])) == [(0, 2), (3, 4)]
    assert spans(np.zeros(3, bool)) == []
    assert spans(np.zeros(0, bool)) == []


def test_detection_counts_steps_from_the_onset_to_the_alarm():
    trace = a_trace([1, 1, 1, 1, 20, 20], onset=2)
    assert trace.onset == 2
    assert trace.detected_after == 2
    assert trace.delay == pytest.approx(0.3)  # the fault begins at 0.2 s, step 4 ends at 0.5 s


def test_an_alarm_before_the_onset_is_false_and_no_detection():
    trace = a_trace([1, 20, 1, 1, 1], onset=3)
    assert trace.false_alarms == (1,)
    assert trace.detected_after is None
    assert trace.delay is None


def test_an_alarm_that_was_up_before_the_onset_is_no_detection_until_it_is_raised_again():
    assert a_trace([20, 20, 20, 20], onset=2).detected_after is None
    assert a_trace([20, 20, 20, 1, 20], onset=2).detected_after == 2


def test_an_alarm_in_the_very_step_of_the_onset_is_detection_and_not_false():
    trace = a_trace([1, 1, 20, 1], onset=2)
    assert trace.false_alarms == ()
    assert trace.detected_after == 0


def test_a_trace_without_a_fault_has_no_onset_and_only_false_alarms():
    trace = a_trace([20, 1, 20, 20])
    assert trace.onset is None
    assert trace.detected_after is None
    assert trace.false_alarms == (0, 2)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"surprise": np.zeros((3, 2))}, r"surprise must have the shape \(T,\) with T > 0, got \(3, 2\)"),
        ({"surprise": []}, r"surprise must have the shape \(T,\) with T > 0, got \(0,\)"),
        ({"onset": -1}, "onset must be >= 0, got -1"),
        ({"detail": detail(np.zeros(2, bool))}, "detail must be of 3 rows, got 2"),
        ({"detail": detail(np.ones(3, bool))}, "a fault is active where none should be"),
        (
            {"detail": detail(np.ones(3, bool)), "onset": 1},
            "a fault is active where none should be, before the onset 1",
        ),
        ({"dt": 0.0}, "dt must be > 0, got 0.0"),
        ({"surprise": np.array([1.0, np.nan, 1.0])}, "surprise must not be NaN"),
    ],
)
def test_a_trace_refuses_what_it_cannot_mean(fields: dict[str, Any], message: str):
    surprise = fields.pop("surprise", [1, 1, 1])
    with pytest.raises(ValueError, match=message):
        a_trace(surprise, **fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"attribution": np.zeros((3, 5))}, r"attribution must have the shape \(T, 2\), got \(3, 5\)"),
        ({"fault": np.zeros(2, bool)}, r"fault must have the shape \(3,\), got \(2,\)"),
        ({"fault": np.zeros(3, int)}, "fault must be bool, got int64"),
    ],
)
def test_what_is_drawn_has_a_row_for_every_step(fields: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        TraceDetail(**{"attribution": np.zeros((3, 2)), "channels": ("a", "b"), "fault": np.zeros(3, bool), **fields})


def test_a_nominal_trace_holds_no_fault():
    with pytest.raises(ValueError, match="nominal trace must not hold a fault"):
        a_trace([1, 1], onset=1, kind="nominal")


def test_another_threshold_changes_the_alarms_and_nothing_else():
    trace = a_trace([1, 20, 30], onset=1).attributed(np.eye(3), ("a", "b", "c"))
    other = trace.at(25.0)
    assert (trace.alarms, trace.top_channel) == ((1,), "b")
    assert (other.alarms, other.detected_after, other.top_channel) == ((2,), 1, "")
    np.testing.assert_array_equal(other.surprise, trace.surprise)


def test_a_condition_is_the_kind_in_words():
    trace = a_trace([1, 1], onset=1, kind="weak_joint", severity="mild", task="Lift")
    assert (trace.condition, trace.title) == ("mild weak joint", "mild weak joint in Lift")


def test_a_window_holds_whole_steps_whatever_the_rounding():
    assert window_steps(0.3, 0.1) == 3  # 0.3 / 0.1 = 2.9999999999999996
    assert window_steps(1.0, 0.05) == 20
    assert window_steps(0.01, 0.05) == 1
    with pytest.raises(ValueError, match="window_s must be > 0, got 0"):
        window_steps(0, 0.05)


def test_time_matching_compares_each_fault_with_the_same_steps_of_nominal_episodes():
    # Every episode is surprised at step 0, the nominal ones at step 3 too: only steps 1 and 2 may count.
    faulty = a_trace([99, 5, 7, 1], onset=1)
    nominal = [a_trace([90, 6, 1, 90]), a_trace([90, 1, 8, 90]), a_trace([90, 7, 1, 90]), a_trace([90, 1, 1, 90])]
    assert placements([faulty], nominal, window_s=0.2) == pytest.approx([(1 + 0.5) / 4])  # 8 above, 7 tied
    assert time_matched_auroc([faulty], nominal, window_s=0.2) == pytest.approx(1 - 1.5 / 4)


def test_time_matching_of_one_common_window_is_the_plain_auroc():
    rng = np.random.default_rng(0)
    faulty = [a_trace(rng.random(8) + 0.2, onset=3) for _ in range(9)]
    nominal = [a_trace(rng.random(8)) for _ in range(7)]
    plain = auroc([t.surprise[3:7].max() for t in faulty], [t.surprise[3:7].max() for t in nominal])
    assert time_matched_auroc(faulty, nominal, window_s=0.4) == pytest.approx(plain)


def test_time_matching_leaves_out_nominal_episodes_that_ended_before_the_onset():
    faulty = a_trace([1, 1, 5], onset=2)
    assert math.isnan(time_matched_auroc([faulty], [a_trace([99, 99])], window_s=1.0))
    assert time_matched_auroc([faulty], [a_trace([99, 99]), a_trace([1, 1, 1])], window_s=1.0) == 1.0


def test_a_delay_is_at_least_one_step_and_a_late_alarm_is_a_miss():
    at_once, late = a_trace([1, 20, 1, 1, 1], onset=1), a_trace([1, 1, 1, 20, 1], onset=1)
    never, nominal = a_trace([1, 1, 1, 1, 1], onset=1), a_trace([20, 20])
    assert delays_ms([late, at_once, never, nominal], window_s=0.3) == pytest.approx([100, 300, math.inf])
    assert delays_ms([late], window_s=0.2) == pytest.approx([math.inf])


def test_quantiles_of_the_delay_count_misses_as_infinitely_late():
    traces = [a_trace([1] * k + [20] + [1] * 30, onset=0) for k in range(20)]  # 100, 200, … 2000 ms
    assert Delays.of(delays_ms(traces, window_s=5.0)) == pytest.approx(Delays(1000.0, 1900.0, 20, 0))
    assert Delays.of(delays_ms(traces, window_s=1.5)) == pytest.approx(Delays(1000.0, math.inf, 15, 5))
    assert Delays.of(delays_ms([a_trace([1, 1])], window_s=1.0)) is None


def test_alarms_an_hour_count_only_the_time_before_the_fault_and_one_a_minute():
    # 1300 steps before the fault and 60 nominal ones: 136 s with 2 + 1 alarms, for one that comes back is the same.
    faulty = np.ones(1400)
    faulty[[5, 6, 20, 50, 60, 661, 1310]] = 20  # the fifth and the sixth are more than a minute apart
    nominal = np.ones(60)
    nominal[3] = 20
    found = hourly_alarms([a_trace(faulty, onset=1300), a_trace(nominal)])
    assert found == (3, pytest.approx(136 / 3600))
    assert math.isnan(hourly_alarms([a_trace([1, 1], onset=0)]).value)


def test_the_top_channel_is_read_at_the_first_alarm_since_the_onset():
    attribution = np.array([[0, 0], [20, 0], [0, 0], [0, 20]])
    for onset, top in ((2, "loud"), (None, "calm")):
        assert a_trace([1, 20, 1, 20], onset).attributed(attribution, ("calm", "loud")).top_channel == top
    assert a_trace([1, 1]).attributed(attribution, ("calm", "loud")).top_channel == ""


def test_a_summary_reads_detection_from_watched_episodes_and_outcomes_from_each_acting():
    traces = [
        a_trace([1, 1, 20, 1], onset=1, success=False, top_channel="loud", contact_force=50.0),
        a_trace([1, 1, 1, 1], onset=1, success=False, contact_force=70.0),
        a_trace([20, 1, 1, 20], onset=1, success=True, top_channel="loud", contact_force=90.0),
        # The wrapped episodes see an alarm at once, which must not touch the figures of detection.
        a_trace([1, 20, 1, 1], onset=1, acting="hold", contact_force=10.0),
        a_trace([1, 20, 1, 1], onset=1, acting="hold", ended_by_alarm=True, contact_force=20.0),
        a_trace([1, 2, 3, 4]),
        a_trace([1, 2, 30, 4]),
    ]
    nominal, push = by_condition(traces, window_s=0.2)

    assert (nominal.name, len(nominal.watched)) == ("nominal", 2)
    assert false_alarms(nominal.watched) == Share(1, 2)
    assert nominal.detected == Share(0, 0)
    assert nominal.delays is None
    assert math.isnan(nominal.auroc)
    assert hourly_alarms(nominal.watched) == (1, pytest.approx(0.8 / 3600))

    assert (push.name, len(push.watched)) == ("push", 3)
    assert false_alarms(push.watched) == Share(1, 3)
    assert push.detected == Share(1, 3)  # the third alarm comes 300 ms after the onset
    assert push.detected.interval == wilson_interval(1, 3)
    assert push.delays == pytest.approx(Delays(math.inf, math.inf, 1, 2))
    # Maxima of steps 1 and 2: 20, 1, 1 against 3, 30: of the six pairs one is won.
    assert push.auroc == pytest.approx(1 / 6)
    assert push.top_channels == [("loud", 2)]

    alone, held = push.outcomes
    assert (alone.acting, alone.success, alone.peak_force) == ("policy alone", Share(1, 3), 70.0)
    assert (held.acting, held.success, held.ended_by_alarm, held.peak_force) == ("hold", Share(2, 2), Share(1, 2), 15.0)


def test_episodes_of_another_task_are_not_compared():
    # In steps 1 and 2 the nominal maxima are 2, 3, 1, 0.
    nominal = [a_trace(s) for s in ([1, 1, 2, 1], [1, 3, 1, 1], [5, 1, 1, 1], [0, 0, 0, 0])]
    elsewhere = a_trace([9, 9, 9, 9], task="Door")
    np.testing.assert_allclose(placements([a_trace([9, 2.5, 0, 9], onset=1)], [*nominal, elsewhere], 0.2), [0.25])
    assert placements([a_trace([0, 9], onset=1, task="Wipe")], nominal, 0.2).size == 0
    assert placements([a_trace([0, 9], onset=2)], nominal, 0.2).size == 0  # ended before it began


def test_a_fault_is_detected_by_an_alarm_that_is_raised_in_the_window():
    faulty = [
        a_trace([0, 0, 20, 0, 0], onset=2),  # at once: 100 ms
        a_trace([0, 0, 0, 20, 0], onset=2),  # 200 ms
        a_trace([0, 20, 20, 20, 0], onset=2),  # stood before the onset and was not raised again
        a_trace([0, 20, 0, 0, 20], onset=2),  # a false alarm, then too late for the window
    ]
    assert detected(faulty, window_s=0.2) == Share(2, 4)
    late = Delays.of(delays_ms(faulty, 0.2))
    assert late == pytest.approx(Delays(200.0, math.inf, 2, 2))


def test_attribution_counts_alarms_alone():
    affected = frozenset({"a", "b"})
    faulty = [a_trace([20], onset=0, top_channel=c, affected_channels=affected) for c in ("a", "c", "")]
    assert metrics.attribution_accuracy(faulty) == Share(1, 2)


def test_the_typical_episode_has_the_median_of_the_greatest_surprises_since_the_onset():
    traces = [a_trace([99, 0, peak], onset=1, seed=peak) for peak in (5, 1, 9)]
    assert typical(traces).seed == 5


def test_precision_recall_and_delay_in_one_number_are_what_every_threshold_gives():
    rng = np.random.default_rng(0)
    nominal = [a_trace(rng.integers(0, 6, 8)) for _ in range(7)]
    faulty = [a_trace(rng.integers(2, 9, 8), onset=2) for _ in range(5)]
    points = []
    for q in np.arange(-1, 9) + 0.5:
        rows = [[t.surprise[2 : 2 + k + 1].max() > q for k in range(4)] for t in faulty]
        late = np.mean([[not up for up in row] for row in rows])
        recall, alarms = np.mean([row[-1] for row in rows]), np.mean([t.surprise.max() > q for t in nominal])
        if recall:
            points.append((recall / (recall + alarms), late))
    grid = (np.arange(20000) + 0.5) / 20000
    expected = np.mean([min((late for p, late in points if p >= level), default=1.0) for level in grid])
    assert aucpdt(faulty, nominal, 0.4) == pytest.approx(expected, abs=1e-3)
    assert math.isnan(aucpdt([], nominal, 0.4))


def test_a_fault_that_is_told_at_once_by_a_wide_margin_scores_nothing():
    assert aucpdt([a_trace([0, 9, 9], onset=1)], [a_trace([1, 1, 1])], 0.2) == 0.0
