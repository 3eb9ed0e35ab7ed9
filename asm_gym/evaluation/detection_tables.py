"""What monitors found, as tables: of one monitor by condition, and of monitors side by side.

A new column is one function and one entry in a list of columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation import metrics
from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.defaults import PER_HOUR, RATES
from asm_gym.evaluation.metrics import ActingMetrics, Delays, DetectionMetrics, KindMetrics, in_words
from asm_gym.evaluation.resampling import interval
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.evaluation.statistics import Estimate, Share
from asm_gym.evaluation.tables import Column, Table, count, count_within, number, percent, tabulate

Compared = DetectionMetrics | KindMetrics
"""A monitor, or the ideal observer, who has fewer columns."""


def milliseconds(delays: Delays | None, which: str, otherwise: str = "missed") -> str:
    """The ``median_ms`` or ``p95_ms``; ``otherwise`` where it is infinite."""
    delay = math.inf if delays is None else getattr(delays, which)
    return f"{delay:.0f}" if math.isfinite(delay) else otherwise


def _late(which: str) -> Callable[[DetectionMetrics], str]:
    return lambda m: milliseconds(m.delays, which, f"> {1e3 * m.window_s:.0f}") if m.delays else ""


CONDITION_COLUMNS: Sequence[Column[DetectionMetrics]] = (
    Column("Condition", lambda m: m.name),
    Column("With false alarm", lambda m: count(metrics.false_alarms(m.watched))),
    Column("False alarms per hour", lambda m: metrics.hourly_alarms(m.watched).text),
    Column("Detected", lambda m: count_within(m.detected)),
    Column("Median delay [ms]", _late("median_ms")),
    Column("95th percentile [ms]", _late("p95_ms")),
    Column("AUROC", lambda m: number(m.auroc, 2)),
    Column(
        "Most surprising channel at the alarm",
        lambda m: ", ".join(f"{channel}\u00a0({n})" for channel, n in m.top_channels),
    ),
)


def detection_table(rows: Sequence[DetectionMetrics]) -> Table:
    """What one monitor told, watching the policy alone: a row a condition."""
    return tabulate(
        "Detection, the monitor only watching. False alarm: raised before the fault, or at all in nominal episodes. "
        f"Detected: alarm raised within {1e3 * rows[0].window_s:.0f} ms of the onset, with the 95 % Wilson interval; a "
        "miss counts as infinitely late. AUROC: against nominal episodes over the same steps.",
        CONDITION_COLUMNS,
        rows,
    )


ACTING_COLUMNS: Sequence[Column[tuple[str, ActingMetrics]]] = (
    Column("Condition", lambda row: row[0]),
    Column("Acting", lambda row: row[1].acting),
    Column("Task solved", lambda row: count_within(row[1].success)),
    Column("Ended by the alarm", lambda row: "" if row[1].acting == POLICY_ALONE else count(row[1].ended_by_alarm)),
    Column("Peak contact force [N]", lambda row: number(row[1].peak_force, 1)),
)


def outcome_table(rows: Sequence[DetectionMetrics]) -> Table:
    """What the override changed, against the policy alone."""
    return tabulate(
        "What acting on the alarm changes. Peak contact force: median over episodes of the greatest force.",
        ACTING_COLUMNS,
        [(m.name, outcome) for m in rows for outcome in m.outcomes],
    )


def _before_and_after(measure: Callable[[ActingMetrics], str]) -> Callable[[DetectionMetrics], str]:
    return lambda m: " → ".join(measure(outcome) for outcome in m.outcomes)


def _late_briefly(m: DetectionMetrics) -> str:
    longest = f">{1e3 * m.window_s:.0f}"
    return ", ".join(milliseconds(m.delays, q, longest) for q in ("median_ms", "p95_ms")) if m.delays else ""


BRIEF_CONDITION_COLUMNS: Sequence[Column[DetectionMetrics]] = (
    Column("", lambda m: m.name),
    Column("\nepisodes", lambda m: str(len(m.watched))),
    Column("\ndetected", lambda m: str(m.detected.k) if m.detected.n else ""),
    Column("delay [ms]\nmedian, 95 %", _late_briefly),
    Column("false\nalarms", lambda m: str(metrics.false_alarms(m.watched).k)),
    Column("tasks\nsolved", _before_and_after(lambda o: str(o.success.k))),
    Column("peak\nforce [N]", _before_and_after(lambda o: f"{o.peak_force:.1f}")),
)


def headline(rows: Sequence[DetectionMetrics]) -> str:
    """One sentence: detected of all faults, false alarms of all nominal episodes."""
    found = Share(sum(m.detected.k for m in rows), sum(m.detected.n for m in rows))
    false = metrics.false_alarms([t for m in rows if m.name == NOMINAL for t in m.watched])
    return f"{count(found)} faults detected; {count(false)} nominal episodes with a false alarm."


def _of_monitor(cell: Callable[[DetectionMetrics], str]) -> Callable[[Compared], str]:
    """A cell that is empty in the row of the ideal observer, who raises no alarms."""
    return lambda m: cell(m) if isinstance(m, DetectionMetrics) else ""


def _found(rate: float) -> Callable[[Compared], str]:
    """Or how many calibration episodes it takes to promise that rate, where there were fewer."""

    def cell(m: Compared) -> str:
        share = m.found.get(rate)
        if share is None and isinstance(m, DetectionMetrics):
            return f"needs {conformal_episodes(rate)}"
        if share is None or not share.n or not isinstance(m, DetectionMetrics) or rate not in m.draws.found:
            return percent(share)
        return _percent(interval(share.value, m.draws.found[rate]))

    return cell


def _found_hourly(rate: float) -> Callable[[DetectionMetrics], str]:
    def cell(m: DetectionMetrics) -> str:
        if rate not in m.found_hourly:
            return ""
        return _percent(interval(m.found_hourly[rate].value, m.draws.hourly[rate]))

    return cell


def _percent(estimate: Estimate) -> str:
    return f"{100 * estimate.value:.0f} % ({100 * estimate.low:.0f}–{100 * estimate.high:.0f})"


def _auroc(m: Compared) -> str:
    if not isinstance(m, DetectionMetrics):
        return f"{m.auroc:.3f}"
    found = interval(m.auroc, m.draws.auroc)
    return f"{found.value:.3f} ({found.low:.3f}–{found.high:.3f})"


_right_channel = _of_monitor(lambda m: percent(metrics.attribution_accuracy(m.faulty)))

MONITOR_COLUMNS: Sequence[Column[Compared]] = (
    Column("Monitor", lambda m: m.name),
    Column("AUROC, same steps", _auroc),
    Column("AUROC, whole episodes", _of_monitor(lambda m: number(m.unmatched_auroc, 3))),
    Column("AUCPDT", _of_monitor(lambda m: number(m.aucpdt, 3))),
    *(Column(f"{'Found ' * (rate == RATES[0])}at {100 * rate:g} %", _found(rate)) for rate in RATES),
    *(Column(f"at {rate:g} an hour", _of_monitor(_found_hourly(rate))) for rate in PER_HOUR),
    Column("Median delay [ms]", lambda m: milliseconds(m.delays, "median_ms")),
    Column("p95 [ms]", lambda m: milliseconds(m.delays, "p95_ms")),
    Column("False alarms", _of_monitor(lambda m: count_within(metrics.false_alarms(m.nominal)))),
    Column("per hour", _of_monitor(lambda m: metrics.hourly_alarms(m.nominal).text)),
    Column("Right channel", _right_channel),
)


def _compared(result: BenchmarkResult) -> list[Compared]:
    return [result.ideal, *result.on_visible]


def monitors_table(result: BenchmarkResult) -> Table:
    """Monitors side by side, the ideal observer on top."""
    hidden = [in_words(kind) for kind, seen in result.visible.items() if not seen]
    hidden_kinds = f" Kinds no observer could see, left out: {', '.join(hidden)}." if hidden else ""
    few = any(rate not in m.found for m in result.on_visible for rate in RATES)
    needed = " Needs: so many calibration episodes, and there were fewer." if few else ""
    return tabulate(
        f"Detection within {1e3 * result.window_s:.0f} ms of the onset, over kinds of fault and severities that an "
        f"ideal observer can see; thresholds from separate nominal episodes, delays and accuracies at a false-alarm "
        f"rate of {100 * result.rate:g} % of episodes; in brackets 95 % intervals, from scenes and calibration "
        f"episodes drawn anew. AUROC: against nominal episodes over the same steps, and against the greatest surprise "
        f"of whole ones, as a threshold sees it. AUCPDT: precision, recall and delay in one number, the lower the "
        f"better. Left out are nominal episodes in which the policy failed "
        f"({result.left_out.failed}) or hit something by itself ({result.left_out.crashed}), and faults in such "
        f"scenes.{hidden_kinds}{needed}",
        MONITOR_COLUMNS,
        _compared(result),
    )


def brief_monitors_table(result: BenchmarkResult) -> Table:
    """The chief columns, narrow enough for a terminal."""
    columns: Sequence[Column[Compared]] = (
        Column("monitor", lambda m: m.name),
        Column("AUROC", lambda m: f"{m.auroc:.3f}"),
        Column("found", _found(result.rate)),
        Column("median [ms]", lambda m: milliseconds(m.delays, "median_ms")),
        Column("alarms/h", _of_monitor(lambda m: number(metrics.hourly_alarms(m.nominal).value, 1))),
        Column("right channel", _right_channel),
    )
    caption = f"found within {result.window_s:g} s at a false-alarm rate of {100 * result.rate:g} %"
    return tabulate(caption, columns, _compared(result))


def kinds_table(result: BenchmarkResult) -> Table:
    """AUROC and faults found of every kind."""
    rows = []
    for kind, seen in result.visible.items():
        own = [kinds[kind] for kinds in result.kinds.values()]
        found = (f"{k.auroc:.2f} / {percent(k.found.get(result.rate))}" for k in own)
        rows.append((in_words(kind) if seen else f"({in_words(kind)})", *found))
    return Table(
        f"AUROC / faults found at a false-alarm rate of {100 * result.rate:g} %. In brackets: no observer could "
        "see it.",
        ("Fault", *result.kinds),
        rows,
    )


def harmless_table(result: BenchmarkResult, monitors: Sequence[str]) -> Table:
    """Alarms of these monitors at what is no fault."""
    alarms = result.false_alarms_by_variation()
    kinds = dict.fromkeys(kind for name in monitors for kind in alarms[name])
    rows = [(kind.replace("_", " "), *(count(alarms[name].get(kind)) for name in monitors)) for kind in kinds]
    return Table("Episodes with an alarm under harmless variations.", ("Variation", *monitors), rows)
