"""Tables of monitors, from verdicts made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.evaluation import comparison, metrics
from asm_gym.evaluation.comparison import BenchmarkResult, Detectability, MonitorResult
from asm_gym.evaluation.detection_tables import harmless_table, kinds_table, monitors_table
from asm_gym.evaluation.scored_episode import ScoredEpisode


def a_trace(peak, kind="nominal", severity="", onset=None):
    surprise = np.zeros(10)
    surprise[5] = peak
    trace = ScoredEpisode(
        kind, 0, 0.05, 3.5, surprise, onset, severity, "Lift", "asm", affected_channels=frozenset("a")
    )
    return trace.attributed(np.ones((10, 1)), ("a",))


def visibility(separation, kind="push", severity="strong", earliest=0):
    return Detectability("Lift", kind, severity, 0, separation, earliest, 0.05)


TRACES = [
    *(a_trace(p) for p in (1.0, 2.0, 3.0, 4.0)),
    a_trace(5.0, "push", "strong", onset=5),
    a_trace(2.5, "push", "mild", onset=5),
    a_trace(0.0, "noise", "mild", onset=5),
]


def test_a_kind_is_visible_where_an_ideal_observer_finds_half_of_it():
    # Power at 1 %: Φ(√S - 2.326), one half at S = 5.41.
    found = [visibility(6.0), visibility(5.0, "touch"), visibility(100.0, "shove"), visibility(0.0, "shove")]
    assert comparison.visible_kinds(found) == {
        ("push", "strong"): True,
        ("touch", "strong"): False,
        ("shove", "strong"): True,  # half of them surely
    }


def test_the_ideal_row_holds_the_bounds():
    ideal = comparison.ideal_metrics("ideal", [visibility(2.0, earliest=None), visibility(np.inf, earliest=1)])
    assert ideal.auroc == pytest.approx((0.8413447 + 1) / 2)  # Φ(√(2/2)) and 1
    assert ideal.delays == pytest.approx((100.0, math.inf, 1, 1))


RESULT = MonitorResult(TRACES, [a_trace(9.0, "touch"), a_trace(0.0, "touch")], {0.01: 3.5, 0.05: 2.2})


def test_scores_are_means_over_the_kinds_that_can_be_seen():
    visible = {("push", "strong"): True, ("push", "mild"): True, ("noise", "mild"): False}
    asm = comparison.monitor_metrics("asm", RESULT, 1.0, visible)
    assert asm.auroc == pytest.approx((1.0 + 0.5) / 2)
    assert (asm.found[0.01].k, asm.found[0.05].k, asm.found[0.05].n) == (1, 2, 2)
    assert asm.delays == pytest.approx((50.0, math.inf, 1, 1))
    assert metrics.false_alarms(asm.nominal).value == 0.25
    assert metrics.hourly_alarms(asm.nominal).value == pytest.approx(1 / (40 * 0.05 / 3600))
    assert metrics.attribution_accuracy(asm.faulty) == (1, 1)


def test_each_kind_is_counted_by_itself():
    kinds = comparison.monitor_metrics("asm", RESULT, 1.0).kinds
    assert list(kinds) == [("push", "strong"), ("push", "mild"), ("noise", "mild")]
    assert [k.auroc for k in kinds.values()] == [1.0, 0.5, 0.0]


def test_the_tables_of_a_benchmark_put_the_ideal_observer_first_and_hide_what_nobody_sees():
    seen = [visibility(100.0), visibility(100.0, severity="mild"), visibility(0.1, "noise", "mild")]
    result = BenchmarkResult({"asm": RESULT}, seen, rate=0.01, window_s=1.0)
    ideal, asm = (dict(zip(monitors_table(result).headings, row, strict=True)) for row in monitors_table(result).rows)
    assert (ideal["Monitor"], ideal["AUROC, same steps"], ideal["False alarms"]) == ("ideal observer", "1.000", "")
    assert asm["AUROC, same steps"].startswith("0.750 (")
    # Whole nominal episodes peak at 1, 2, 3 and 4: the push of 5 is above all, the one of 2.5 above half.
    assert asm["AUROC, whole episodes"] == "0.750"
    assert (asm["at 1 %"], asm["Found at 0.5 %"]) == ("50 %", "needs 199")
    assert "Needs: so many calibration episodes" in monitors_table(result).caption
    enough = replace(RESULT, thresholds={**RESULT.thresholds, 0.005: 4.0})
    assert "Needs" not in monitors_table(replace(result, monitors={"asm": enough})).caption
    assert (asm["False alarms"], asm["Median delay [ms]"], asm["p95 [ms]"]) == ("1 of 4 (5–70 %)", "50", "missed")
    assert "left out: noise mild" in monitors_table(result).caption
    assert kinds_table(result).rows[2] == ("(noise mild)", "0.59 / 0 %", "0.00 / 0 %")
    assert harmless_table(result, ["asm"]).rows == [("touch", "1 of 2")]
