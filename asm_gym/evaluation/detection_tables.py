"""Results of detection as tables. A new column is one line in ``CONDITION_COLUMNS`` or ``monitor_columns``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from asm_gym.detection import conformal_episodes
from asm_gym.evaluation import metrics
from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.defaults import PER_HOUR, RATES
from asm_gym.evaluation.metrics import ActingMetrics, Delays, DetectionMetrics, KindMetrics, in_words
from asm_gym.evaluation.resampling import Calibration, interval
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.evaluation.statistics import Estimate, Floats, Rate, Share, chance_of_alarms
from asm_gym.evaluation.tables import Column, Table, count, count_within, number, percent, tabulate

Compared = DetectionMetrics | KindMetrics
"""A monitor, or the ideal observer, whose row has fewer cells."""

UNLIKELY = 0.025
"""A calibration counts as broken where so many false alarms are less likely than this."""


def milliseconds(delays: Delays | None, which: str, otherwise: str = "missed") -> str:
    """Format the ``median_ms`` or ``p95_ms``; ``otherwise`` where it is infinite."""
    delay = math.inf if delays is None else getattr(delays, which)
    return f"{delay:.0f}" if math.isfinite(delay) else otherwise


def _delays(m: DetectionMetrics) -> str:
    longest = f">{1e3 * m.window_s:.0f}"
    return ", ".join(milliseconds(m.delays, q, longest) for q in ("median_ms", "p95_ms")) if m.delays else ""


def _before_and_after(measure: Callable[[ActingMetrics], str]) -> Callable[[DetectionMetrics], str]:
    return lambda m: " → ".join(measure(outcome) for outcome in m.outcomes)


CONDITION_COLUMNS: Sequence[Column[DetectionMetrics]] = (
    Column("", lambda m: m.name),
    Column("\nepisodes", lambda m: str(len(m.watched))),
    Column("\ndetected", lambda m: str(m.detected.k) if m.detected.n else ""),
    Column("delay [ms]\nmedian, 95 %", _delays),
    Column("false\nalarms", lambda m: str(metrics.false_alarms(m.watched).k)),
    Column("tasks\nsolved", _before_and_after(lambda o: str(o.success.k))),
    Column("peak\nforce [N]", _before_and_after(lambda o: f"{o.peak_force:.1f}")),
)
"""One monitor by condition: detection with the policy alone; solved and force: alone → with the response."""


def headline(rows: Sequence[DetectionMetrics]) -> str:
    """Return one sentence: detected of all faults, false alarms of all nominal episodes."""
    found = Share(sum(m.detected.k for m in rows), sum(m.detected.n for m in rows))
    false = metrics.false_alarms([t for m in rows if m.name == NOMINAL for t in m.watched])
    return f"{count(found)} faults detected; {count(false)} nominal episodes with a false alarm."


def monitor_columns(result: BenchmarkResult) -> Sequence[Column[Compared]]:
    """Return the columns of monitors side by side."""
    rates = sorted({*RATES, result.rate})
    return (
        Column("Monitor", lambda m: m.name),
        Column("AUROC, same steps", _auroc),
        Column("AUROC, whole episodes", _of_monitor(lambda m: number(m.unmatched_auroc, 3))),
        *(Column(f"Found at {100 * rate:g} %", _found(rate)) for rate in rates),
        *(Column(f"Found at {rate:g}/h", _of_monitor(_found_hourly(rate))) for rate in PER_HOUR),
        Column("Median delay [ms]", lambda m: milliseconds(m.delays, "median_ms")),
        Column("p95 [ms]", lambda m: milliseconds(m.delays, "p95_ms")),
        Column("False alarms", _of_monitor(lambda m: count_within(metrics.false_alarms(m.nominal)))),
        Column("Alarms/h", _of_monitor(lambda m: metrics.hourly_alarms(m.nominal).text)),
        Column("Right channel", _of_monitor(lambda m: percent(metrics.attribution_accuracy(m.faulty)))),
    )


BRIEF = ("Monitor", "AUROC, same steps", "Median delay [ms]", "Alarms/h", "Right channel")
"""Columns that a terminal shows, beside the share found at the run's own rate."""


def monitors_table(result: BenchmarkResult) -> Table:
    """Return the monitors side by side, the ideal observer on top."""
    hidden = [in_words(kind) for kind, seen in result.visible.items() if not seen]
    caption = (
        f"Detection within {1e3 * result.window_s:.0f} ms of the onset, over kinds and severities of fault that an "
        f"ideal observer can detect; thresholds from separate nominal episodes, delays and alarms at a false-alarm "
        f"rate of {100 * result.rate:g} % of episodes; in brackets 95 % intervals over resampled scenes and "
        f"calibration episodes. AUROC: against nominal episodes over the same steps, and against the greatest "
        f"surprise of whole ones. Needs: calibration episodes for that rate, where there were fewer. Left out: nominal "
        f"episodes in which the policy failed ({result.left_out.failed}) or crashed ({result.left_out.crashed}), and "
        "faults in such scenes." + (f" Kinds that cannot be detected: {', '.join(hidden)}." if hidden else "")
    )
    return tabulate(caption, monitor_columns(result), _compared(result))


def brief_monitors_table(result: BenchmarkResult) -> Table:
    """Return the chief columns without their intervals, narrow enough for a terminal."""
    wanted = {*BRIEF, f"Found at {100 * result.rate:g} %"}
    columns = [_without_interval(column) for column in monitor_columns(result) if column.heading in wanted]
    return tabulate(f"found within {result.window_s:g} s of the onset", columns, _compared(result))


def _compared(result: BenchmarkResult) -> list[Compared]:
    return [result.ideal, *result.on_visible]


def _without_interval(column: Column[Compared]) -> Column[Compared]:
    return Column(column.heading, lambda m: column.cell(m).partition(" (")[0])


def kinds_table(result: BenchmarkResult) -> Table:
    """Return AUROC and faults found of every kind."""
    rows = []
    for kind, seen in result.visible.items():
        own = [kinds[kind] for kinds in result.kinds.values()]
        found = (f"{k.auroc:.2f} / {percent(k.found.get(result.rate))}" for k in own)
        rows.append((in_words(kind) if seen else f"({in_words(kind)})", *found))
    return Table(
        f"AUROC / faults found at a false-alarm rate of {100 * result.rate:g} %. In brackets: no observer could "
        "detect it.",
        ("Fault", *result.kinds),
        rows,
    )


def harmless_table(result: BenchmarkResult, monitors: Sequence[str]) -> Table:
    """Return the alarms of these monitors under harmless variations."""
    alarms = result.false_alarms_by_variation()
    kinds = dict.fromkeys(kind for name in monitors for kind in alarms[name])
    rows = [(kind.replace("_", " "), *(count(alarms[name].get(kind)) for name in monitors)) for kind in kinds]
    return Table("Episodes with an alarm under harmless variations.", ("Variation", *monitors), rows)


def lead_table(result: BenchmarkResult) -> Table:
    """Return how far the first monitor is ahead of each other, on the same scenes and calibration episodes."""
    first, *others = result.on_visible
    rows = []
    for other in others:
        cells = [_lead(interval(first.auroc - other.auroc, first.draws.auroc - other.draws.auroc), 1, 3)]
        cells.append(_lead_found(first.found, other.found, first.draws.found, other.draws.found, result.rate))
        hourly = first.found_hourly, other.found_hourly, first.draws.hourly, other.draws.hourly
        cells += [_lead_found(*hourly, rate) for rate in first.hourly]
        rows.append((other.name, *cells))
    found = [f"Found at {100 * result.rate:g} % [points]", *(f"Found at {r:g}/h [points]" for r in first.hourly)]
    return Table(
        f"How far {first.name} is ahead of each other monitor; 95 % intervals of the paired difference, which decide "
        "between ahead, behind and within chance.",
        ("Monitor", "AUROC", *found),
        rows,
    )


def kept_table(result: BenchmarkResult) -> Table:
    """Return the false alarms in nominal test episodes, beside the promise of each threshold."""
    every = result.on_all
    rates = sorted({r for m in every for r in m.thresholds})
    hourly = sorted({r for m in every for r in m.hourly}, reverse=True)
    rows = [(m.name, *(_kept_share(m, r) for r in rates), *(_kept_rate(m, r) for r in hourly)) for m in every]
    hours = sum(len(t) * t.dt for t in every[0].nominal) / 3600
    return Table(
        f"False alarms in {len(every[0].nominal)} nominal test episodes of {hours:.2f} hours, by the promise of the "
        "threshold; 95 % intervals (Wilson, Poisson). Broken: less likely than 1 in 40 (beta-binomial); by the hour, "
        "the interval lies above the promise.",
        ("Monitor", *(f"promised {100 * r:g} %" for r in rates), *(f"promised {r:g}/h" for r in hourly)),
        rows,
    )


def kept_share(share: Share, calibration: Calibration, threshold: float) -> str:
    """Format such as ``1.2 % (0.8 to 1.8)``, and say whether the threshold broke its promise."""
    low, high = share.interval
    beyond, n = int((calibration.maxima > threshold).sum()), len(calibration.maxima)
    broken = share.n and beyond < n and chance_of_alarms(*share, beyond, n) < UNLIKELY
    return f"{100 * share.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})" + ", broken" * bool(broken)


def kept_rate(rate: Rate, promised: float) -> str:
    """Format the alarms per hour, and say whether the promise was broken."""
    return rate.text + (", broken" if rate.interval[0] > promised else "")


def _kept_share(m: DetectionMetrics, rate: float) -> str:
    if rate not in m.thresholds:
        return ""
    threshold = m.thresholds[rate]
    return kept_share(metrics.false_alarms([t.at(threshold) for t in m.nominal]), m.calibration, threshold)


def _kept_rate(m: DetectionMetrics, rate: float) -> str:
    if rate not in m.hourly:
        return ""
    return kept_rate(metrics.hourly_alarms([t.at(m.hourly[rate]) for t in m.nominal]), rate)


def _lead_found(
    mine: Mapping[float, Share],
    theirs: Mapping[float, Share],
    drawn: Mapping[float, Floats],
    others: Mapping[float, Floats],
    rate: float,
) -> str:
    if rate not in drawn.keys() & others.keys():
        return ""
    return _lead(interval(mine[rate].value - theirs[rate].value, drawn[rate] - others[rate]), 100, 1)


def _lead(difference: Estimate, scale: float, digits: int) -> str:
    value, low, high = (f"{scale * x:+.{digits}f}" for x in difference)
    verdict = "ahead" if difference.low > 0 else "behind" if difference.high < 0 else "within chance"
    return f"{value} ({low} to {high}), {verdict}"


def _of_monitor(cell: Callable[[DetectionMetrics], str]) -> Callable[[Compared], str]:
    """Return a cell that is empty for the ideal observer, who raises no alarms."""
    return lambda m: cell(m) if isinstance(m, DetectionMetrics) else ""


def _auroc(m: Compared) -> str:
    if not isinstance(m, DetectionMetrics):
        return f"{m.auroc:.3f}"
    found = interval(m.auroc, m.draws.auroc)
    return f"{found.value:.3f} ({found.low:.3f}–{found.high:.3f})"


def _found(rate: float) -> Callable[[Compared], str]:
    def cell(m: Compared) -> str:
        share = m.found.get(rate)
        if not isinstance(m, DetectionMetrics):
            return percent(share)
        if share is None:
            return f"needs {conformal_episodes(rate)}"
        return _percent(interval(share.value, m.draws.found[rate])) if rate in m.draws.found else percent(share)

    return cell


def _found_hourly(rate: float) -> Callable[[DetectionMetrics], str]:
    def cell(m: DetectionMetrics) -> str:
        if rate not in m.found_hourly:
            return ""
        return _percent(interval(m.found_hourly[rate].value, m.draws.hourly[rate]))

    return cell


def _percent(estimate: Estimate) -> str:
    return f"{100 * estimate.value:.0f} % ({100 * estimate.low:.0f}–{100 * estimate.high:.0f})"
