"""Where monitors stand: ahead, behind or within chance of the first; and whether what was promised was kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE
from asm_gym.evaluation.metrics import DetectionMetrics, detected, false_alarms, hourly_alarms
from asm_gym.evaluation.resampling import Draws, interval
from asm_gym.evaluation.statistics import Estimate, Floats, Rate, Share, chance_of_alarms
from asm_gym.evaluation.tables import Table, count, percent

UNLIKELY = 0.025
"""Of a promise that is kept, the chance to be called broken."""

AHEAD, BEHIND, CHANCE = "ahead", "behind", "within chance"


def verdict(difference: Estimate) -> str:
    """What a paired difference says of whoever is first; its 95 % interval decides."""
    if np.isnan(difference.low):
        return ""
    return AHEAD if difference.low > 0 else BEHIND if difference.high < 0 else CHANCE


def lead_table(result: BenchmarkResult) -> Table:
    """How far the first monitor is ahead of each other, on the same scenes and calibration episodes."""
    first, *others = result.on_visible
    compared = [f"Found at {100 * result.rate:g} % [points]", *(f"at {r:g} an hour [points]" for r in first.hourly)]
    rows = []
    for other in others:
        auroc = interval(first.auroc - other.auroc, first.draws.auroc - other.draws.auroc)
        cells = [f"{auroc.value:+.3f} ({auroc.low:+.3f} to {auroc.high:+.3f}), {verdict(auroc)}"]
        cells.append(_ahead(first.found, other.found, first.draws.found, other.draws.found, result.rate))
        both = first.found_hourly, other.found_hourly, first.draws.hourly, other.draws.hourly
        cells += [_ahead(*both, r) for r in first.hourly]
        rows.append((other.name, *cells))
    return Table(
        f"How far {first.name} is ahead of each other monitor; 95 % intervals of the paired difference, which say "
        f"whether it is {AHEAD}, {BEHIND} or {CHANCE}.",
        ("Monitor", "AUROC", *compared),
        rows,
    )


def _ahead(mine: Any, theirs: Any, drawn: Any, others: Any, rate: float) -> str:
    """The difference of two shares of faults found at a rate, in points; empty where either is not known."""
    if rate not in drawn.keys() & others.keys():
        return ""
    found = interval(mine[rate].value - theirs[rate].value, drawn[rate] - others[rate])
    return f"{100 * found.value:+.1f} ({100 * found.low:+.1f} to {100 * found.high:+.1f}), {verdict(found)}"


def kept_table(result: BenchmarkResult) -> Table:
    """False alarms in nominal test episodes, beside what each threshold promised."""
    every = result.on_all
    rates = sorted({r for m in every for r in m.thresholds})
    hourly = sorted({r for m in every for r in m.hourly}, reverse=True)
    rows = []
    for m in every:
        shares = [
            kept_share(false_alarms([t.at(m.thresholds[r]) for t in m.nominal]), m.maxima, m.thresholds[r])
            if r in m.thresholds
            else ""
            for r in rates
        ]
        each = [
            kept_rate(hourly_alarms([t.at(m.hourly[r]) for t in m.nominal]), r) if r in m.hourly else "" for r in hourly
        ]
        rows.append((m.name, *shares, *each))
    hours = sum(len(t) * t.dt for t in every[0].nominal) / 3600
    return Table(
        f"False alarms in {len(every[0].nominal)} nominal test episodes of {hours:.2f} hours, by what was promised; 95 "
        "% intervals (Wilson, Poisson) of these episodes alone. Broken: one calibration in 40 comes to so many by "
        "chance (beta-binomial); by the hour, the interval lies above what was promised.",
        ("Monitor", *(f"promised {100 * r:g} %" for r in rates), *(f"{r:g} an hour" for r in hourly)),
        rows,
    )


def kept_share(share: Share, maxima: Floats, threshold: float) -> str:
    """Such as ``1.2 % (0.8 to 1.8)``, and whether it broke what a threshold promised that these maxima have set."""
    low, high = share.interval
    broken = ", broken" if _unlikely(share, Share.of(list(maxima > threshold))) else ""
    return f"{100 * share.value:.1f} % ({100 * low:.1f} to {100 * high:.1f}){broken}"


def _unlikely(tested: Share, calibrated: Share, looks: int = 1) -> bool:
    """Whether so many alarms come of the same law as those in calibration in less than one of 40 looks."""
    if not tested.n or not calibrated.k < calibrated.n:
        return False
    return chance_of_alarms(*tested, *calibrated) < UNLIKELY / looks


def kept_rate(rate: Rate, promised: float) -> str:
    """The same by the hour."""
    return rate.text + (", broken" if rate.interval[0] > promised else "")


def coverage_table(result: BenchmarkResult) -> Table:
    """Nominal test episodes in alarm, task by task, for each monitor: promised to all of them, and to each."""
    tasks = list(dict.fromkeys(t.task for t in result.on_all[0].nominal))
    rows = []
    for m in result.on_visible:
        threshold = m.thresholds[result.rate]
        tested = _by_task(m, tasks, threshold)
        known = result.monitors[m.name].calibration_tasks
        own = [m.maxima[[k for k, t in enumerate(known) if t == task]] for task in tasks]
        set_on = [Share.of(list(maxima > threshold)) for maxima in own]
        more = [
            ", more than in calibration" * _unlikely(*pair, len(tasks)) for pair in zip(tested, set_on, strict=True)
        ]
        rows.append((m.name, f"{100 * result.rate:g} % of all", *map(str.__add__, map(count, tested), more)))
        if known:
            rows.append(("", "in calibration", *map(count, set_on)))
        if min(map(len, own)) >= conformal_episodes(FALSE_ALARM_RATE):
            each = max(conformal_threshold(maxima, FALSE_ALARM_RATE) for maxima in own)
            found = percent(detected([t.at(each) for t in m.faulty], m.window_s))
            promise = f"{100 * FALSE_ALARM_RATE:g} % of each, finds {found}"
            rows.append(("", promise, *map(count, _by_task(m, tasks, each))))
    return Table(
        "Nominal test episodes in alarm, task by task, by what the threshold promises. One for all of them promises "
        "nothing of one; the greatest that a task needs promises it of each. More than in calibration: of the same law "
        "one table of 40 has such a cell.",
        ("Monitor", "promised", *tasks),
        rows,
    )


def _by_task(metrics: DetectionMetrics, tasks: Sequence[str], threshold: float) -> list[Share]:
    return [false_alarms([t.at(threshold) for t in metrics.nominal if t.task == task]) for task in tasks]


def card(metrics: DetectionMetrics, draws: Draws | None = None) -> dict[str, Any]:
    """The figures of one monitor, for a file."""
    drawn = draws or metrics.draws

    def within(value: float, own: Floats) -> list[float]:
        return [round(number, 4) for number in interval(value, own)]

    return {
        "monitor": metrics.name,
        "faults": len(metrics.faulty),
        "nominal": len(metrics.nominal),
        "auroc": within(metrics.auroc, drawn.auroc),
        "aucpdt": round(metrics.aucpdt, 4),
        "found": {f"{r:g}": within(s.value, drawn.found[r]) for r, s in metrics.found.items() if r in drawn.found},
        "found_at_an_hour": {f"{r:g}": within(s.value, drawn.hourly[r]) for r, s in metrics.found_hourly.items()},
        "median_delay_ms": metrics.delays.median_ms if metrics.delays else None,
        "false_alarms": {f"{r:g}": _share(metrics, q) for r, q in metrics.thresholds.items()},
        "false_alarms_an_hour": {f"{r:g}": _rate(metrics, q) for r, q in metrics.hourly.items()},
    }


def _share(metrics: DetectionMetrics, threshold: float) -> Sequence[int]:
    return list(false_alarms([t.at(threshold) for t in metrics.nominal]))


def _rate(metrics: DetectionMetrics, threshold: float) -> Sequence[float]:
    return list(hourly_alarms([t.at(threshold) for t in metrics.nominal]))
