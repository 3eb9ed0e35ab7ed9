"""Results of detection as tables. A new column is one line in ``CONDITION_COLUMNS`` or ``monitor_columns``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy import stats

from asm_gym.detection import Blocks, conformal_episodes
from asm_gym.detection.conformal import EPISODE, HOUR
from asm_gym.evaluation import metrics
from asm_gym.evaluation.comparison import IDEAL, BenchmarkResult, Bound
from asm_gym.evaluation.defaults import PER_HOUR, RATES, TRANSIENT
from asm_gym.evaluation.metrics import DetectionMetrics, Kind, Outcomes
from asm_gym.evaluation.resampling import Calibration, Windows, interval
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.evaluation.statistics import Estimate, Rate, Share
from asm_gym.evaluation.tables import Table, count, percent, tabulate
from asm_gym.monitors.calibration import AlarmRate

SPLITS = 20  # of nominal episodes into halves
UNLIKELY = (
    0.025  # a calibration counts as broken where so many false alarms are less likely than this
)


def milliseconds(delay: float, otherwise: str = "missed") -> str:
    """Format a delay [ms]; ``otherwise`` where it is infinite."""
    return f"{delay:.0f}" if math.isfinite(delay) else otherwise


def _delays(m: DetectionMetrics) -> str:
    return (
        ", ".join(milliseconds(delay, f">{1e3 * m.window_s:.0f}") for delay in m.delays)
        if m.faulty
        else ""
    )


def _before_and_after(measure: Callable[[Outcomes], str]) -> Callable[[DetectionMetrics], str]:
    return lambda m: " → ".join(measure(outcome) for outcome in m.outcomes)


CONDITION_COLUMNS: dict[str, Callable[[DetectionMetrics], str]] = {
    "": lambda m: m.name,
    "\nepisodes": lambda m: str(len(m.watched)),
    "\ndetected": lambda m: str(m.detected.k) if m.detected.n else "",
    "delay [ms]\nmedian, 95 %": _delays,
    "false\nalarms": lambda m: str(metrics.false_alarms(m.watched).k),
    "tasks\nsolved": _before_and_after(lambda o: str(o.success.k)),
    "of these\nunsafe": _before_and_after(lambda o: str(o.unsafe.k)),
    "median\ntime [s]": _before_and_after(lambda o: f"{o.time:.1f}"),
    "peak\nforce [N]": _before_and_after(lambda o: f"{o.peak_force:.1f}"),
}
"""One monitor by condition: detection with the policy alone; solved and force: alone → with the response."""


def headline(rows: Sequence[DetectionMetrics]) -> str:
    """Return one sentence: detected of all faults, false alarms of all nominal episodes."""
    found = Share(sum(m.detected.k for m in rows), sum(m.detected.n for m in rows))
    false = metrics.false_alarms([t for m in rows if m.name == NOMINAL for t in m.watched])
    return f"{count(found)} faults detected; {count(false)} nominal episodes with a false alarm."


def monitor_columns(promises: Sequence[AlarmRate]) -> dict[str, Callable[[DetectionMetrics], str]]:
    """Return the columns of monitors side by side."""
    return {
        "Monitor": lambda m: m.name,
        "AUROC, same steps": lambda m: "{:.3f} ({:.3f}–{:.3f})".format(
            *interval(m.auroc, m.draws.auroc)
        ),
        **{f"Found at {_rate(promise)}": partial(_found, promise=promise) for promise in promises},
        "Median delay [ms]": lambda m: milliseconds(m.delays.median_ms),
        "False alarms": _false_alarms,
        "Alarms/h": lambda m: metrics.hourly_alarms(m.nominal).text,
        "Right channel": lambda m: percent(metrics.attribution_accuracy(m.faulty)),
    }


def _rate(promise: AlarmRate) -> str:
    """Format such as ``1 %`` or ``10/h``."""
    return f"{promise.rate:g}/h" if promise.per == HOUR else f"{100 * promise.rate:g} %"


BRIEF = ("Monitor", "AUROC, same steps", "Median delay [ms]", "Alarms/h", "Right channel")
"""Columns that a terminal shows, beside the share found at the run's own rate."""


def monitors_table(result: BenchmarkResult) -> Table:
    """Return the monitors side by side, the ideal observer on top."""
    hidden = [_in_words(kind) for kind, seen in result.visible.items() if not seen]
    failed, crashed = result.left_out
    caption = (
        f"Detection within {1e3 * result.window_s:.0f} ms of the onset, over kinds and severities of fault that an "
        f"ideal observer can detect; thresholds from separate nominal episodes, delays and alarms at a false-alarm "
        f"rate of {100 * result.rate:g} % of episodes; in brackets 95 % intervals over resampled scenes and "
        f"calibration episodes. AUROC: against nominal episodes over the same steps. Needs: calibration episodes for "
        f"that rate, where there were fewer. Left out: nominal episodes in which the policy failed ({failed}) or "
        f"crashed ({crashed}), and faults in such scenes."
        + (f" Kinds that cannot be detected: {', '.join(hidden)}." if hidden else "")
    )
    promises = [AlarmRate(r, EPISODE) for r in sorted({*RATES, result.rate})] + [
        AlarmRate(r, HOUR) for r in PER_HOUR
    ]
    monitors = tabulate(caption, monitor_columns(promises), result.on_visible)
    ideal = result.bound([kind for kind, seen in result.visible.items() if seen])
    found = [percent(ideal.found.get(promise)) for promise in promises]
    first = (IDEAL, f"{ideal.auroc:.3f}", *found, milliseconds(ideal.delays.median_ms), "", "", "")
    return Table(caption, monitors.headings, [first, *monitors.rows])


def brief_monitors_table(result: BenchmarkResult) -> Table:
    """Return the chief columns without their intervals, narrow enough for a terminal."""
    table = monitors_table(result)
    headings = [h for h in table.headings if h in BRIEF or h == f"Found at {_rate(result.promise)}"]
    columns = [table.headings.index(heading) for heading in headings]
    rows = [[str(row[n]).partition(" (")[0] for n in columns] for row in table.rows]
    return Table(f"found within {result.window_s:g} s of the onset", headings, rows)


def kinds_table(result: BenchmarkResult) -> Table:
    """Return AUROC and faults found of every kind."""
    rows = []
    for kind, seen in result.visible.items():
        own: list[Bound | DetectionMetrics] = [
            result.bound([kind]),
            *(m.only([kind]) for m in result.monitors.values()),
        ]
        found = (f"{m.auroc:.2f} / {percent(m.found.get(result.promise))}" for m in own)
        rows.append((_in_words(kind) if seen else f"({_in_words(kind)})", *found))
    return Table(
        f"AUROC / faults found at a false-alarm rate of {100 * result.rate:g} %. In brackets: no observer could "
        "detect it.",
        ("Fault", IDEAL, *result.monitors),
        rows,
    )


def _in_words(kind: Kind) -> str:
    return " ".join(part.replace("_", " ") for part in kind if part)


def lead_table(result: BenchmarkResult) -> Table:
    """Return how far the first monitor is ahead of each other, on the same scenes and calibration episodes."""
    first, *others = result.on_visible
    promises = [result.promise, *(p for p in first.calibration.thresholds if p.per == HOUR)]
    rows = []
    for other in others:
        cells = [
            _lead(interval(first.auroc - other.auroc, first.draws.auroc - other.draws.auroc), 1, 3)
        ]
        for promise in promises:
            if promise not in first.draws.found.keys() & other.draws.found.keys():
                cells.append("")
                continue
            difference = first.found[promise].value - other.found[promise].value
            draws = first.draws.found[promise] - other.draws.found[promise]
            cells.append(_lead(interval(difference, draws), 100, 1))
        rows.append((other.name, *cells))
    return Table(
        f"How far {first.name} is ahead of each other monitor; 95 % intervals of the paired difference, which decide "
        "between ahead, behind and within chance.",
        ("Monitor", "AUROC", *(f"Found at {_rate(promise)} [points]" for promise in promises)),
        rows,
    )


def _lead(difference: Estimate, scale: float, digits: int) -> str:
    value, low, high = (f"{scale * x:+.{digits}f}" for x in difference)
    verdict = (
        "ahead" if difference.low > 0 else "behind" if difference.high < 0 else "within chance"
    )
    return f"{value} ({low} to {high}), {verdict}"


def kept_table(result: BenchmarkResult) -> Table:
    """Return the false alarms in nominal test episodes, beside the promise of each threshold."""
    every = list(result.monitors.values())
    promises = sorted(
        {promise for m in every for promise in m.calibration.thresholds},
        key=lambda p: (p.per == HOUR, -p.rate if p.per == HOUR else p.rate),
    )
    rows = [(m.name, *(_kept(m, promise) for promise in promises)) for m in every]
    hours = sum(len(t) * t.dt for t in every[0].nominal) / 3600
    unsafe = Share.of([t.outcome.unsafe for t in every[0].nominal if t.outcome.success])
    return Table(
        f"False alarms in {len(every[0].nominal)} nominal test episodes of {hours:.2f} hours, by the promise of the "
        "threshold; 95 % intervals (Wilson, Poisson). Broken: less likely than 1 in 40 (beta-binomial); by the hour, "
        f"the interval lies above the promise. {count(unsafe)} solved ones pressed with more than {TRANSIENT:g} N.",
        ("Monitor", *(f"promised {_rate(promise)}" for promise in promises)),
        rows,
    )


def splits_table(result: BenchmarkResult) -> Table:
    """Return what each promise comes to over random halves of the nominal episodes: set on one, kept on the other."""
    promises = list(result.on_visible[0].calibration.thresholds)
    rows = []
    for m in result.on_visible:
        of = Blocks.of([t.surprise for t in m.nominal], m.nominal[0].dt)
        known = m.calibration.blocks or Blocks(*np.zeros((2, 0)))
        by_hour = Blocks(*(np.concatenate(both) for both in zip(known[:2], of[:2], strict=True)))
        maxima = np.concatenate([m.calibration.maxima, [t.surprise.max() for t in m.nominal]])
        units = {EPISODE: Blocks(maxima, np.ones(len(maxima))), HOUR: by_hour}
        rows.append((m.name, *(over_splits(m, units[p.per], p) for p in promises)))
    return Table(
        f"False alarms that came, and faults found within {1e3 * result.window_s:.0f} ms, where {SPLITS} random halves "
        "of the nominal episodes for calibration and test set the threshold and the other halves count: mean ± SD.",
        ("Monitor", *(f"promised {_rate(promise)}" for promise in promises)),
        rows,
    )


def over_splits(m: DetectionMetrics, units: Blocks, promise: AlarmRate) -> str:
    """Return the false alarms that came, and faults found, where random halves of ``units`` set the threshold."""
    rng, windows, came, found = np.random.default_rng(0), Windows(m.faulty, m.window_s), [], []
    for _ in range(SPLITS):
        half = np.zeros(len(units.maxima), bool)
        half[rng.permutation(len(half))[: len(half) // 2]] = True
        own = Blocks(units.maxima[half], units.hours[half])
        try:
            threshold = promise.threshold(own.maxima, own)
        except ValueError:  # too few
            return ""
        came.append((units.maxima[~half] > threshold).sum() / units.hours[~half].sum())
        found.append(windows.detected(threshold).mean())
    unit, scale = ("/h", 1.0) if promise.per == HOUR else (" %", 100.0)
    return (
        f"{scale * np.mean(came):.2f} ± {scale * np.std(came):.2f}{unit}, "
        f"{100 * np.mean(found):.1f} ± {100 * np.std(found):.1f} % found"
    )


def _kept(m: DetectionMetrics, promise: AlarmRate) -> str:
    threshold = m.calibration.thresholds.get(promise)
    if threshold is None:
        return ""
    judged = [t.at(threshold) for t in m.nominal]
    if promise.per == HOUR:
        return kept_rate(metrics.hourly_alarms(judged), promise.rate)
    return _kept_share(metrics.false_alarms(judged), m.calibration, threshold)


def kept_rate(rate: Rate, promised: float) -> str:
    """Format the alarms per hour, and say whether the promise was broken."""
    return rate.text + (", broken" if rate.interval[0] > promised else "")


def _kept_share(share: Share, calibration: Calibration, threshold: float) -> str:
    """Format the share of episodes with an alarm, and say whether the threshold broke its promise.

    ``beyond`` of n calibration maxima exceed the threshold. The share of fresh ones that exceed it is itself drawn,
    from Beta(beyond + 1, n - beyond), so their count is beta-binomial.
    """
    low, high = share.interval
    beyond, n = int((calibration.maxima > threshold).sum()), len(calibration.maxima)
    broken = bool(
        share.n
        and beyond < n
        and stats.betabinom.sf(share.k - 1, share.n, beyond + 1, n - beyond) < UNLIKELY
    )
    return f"{100 * share.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})" + ", broken" * broken


def _false_alarms(m: DetectionMetrics) -> str:
    share = metrics.false_alarms(m.nominal)
    low, high = share.interval
    return f"{count(share)} ({100 * low:.0f}–{100 * high:.0f} %)" if share.n else ""


def _found(m: DetectionMetrics, promise: AlarmRate) -> str:
    share = m.found.get(promise)
    if share is None:
        return "" if promise.per == HOUR else f"needs {conformal_episodes(promise.rate)}"
    if promise not in m.draws.found:
        return percent(share)
    found = interval(share.value, m.draws.found[promise])
    return f"{100 * found.value:.0f} % ({100 * found.low:.0f}–{100 * found.high:.0f})"
