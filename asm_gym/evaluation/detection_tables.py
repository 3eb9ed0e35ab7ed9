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
UNLIKELY = 0.025  # a promise counts as broken if so many false alarms have a smaller probability
BRIEF_HEADINGS = ("Monitor", "AUROC, same steps", "Median delay [ms]", "Alarms/h", "Right channel")
"""Columns that a terminal shows, beside the share found at the run's own rate."""


# ------------------------------------------------------------------ one monitor by condition


def milliseconds(delay: float, otherwise: str = "missed") -> str:
    """Format a delay [ms]; ``otherwise`` where it is infinite."""
    if not math.isfinite(delay):
        return otherwise
    return f"{delay:.0f}"


def _delays(m: DetectionMetrics) -> str:
    if not m.faulty:
        return ""
    missed = f">{1e3 * m.window_s:.0f}"
    return ", ".join(milliseconds(delay, missed) for delay in m.delays)


def _by_response(measure: Callable[[Outcomes], str]) -> Callable[[DetectionMetrics], str]:
    """Return the function for a cell: a measure with the policy alone → the same with the override."""
    return lambda m: " → ".join(map(measure, m.outcomes))


CONDITION_COLUMNS: dict[str, Callable[[DetectionMetrics], str]] = {
    "": lambda m: m.name,
    "found": lambda m: count(m.detected) if m.detected.n else "",
    "delay [ms]\nmedian, 95 %": _delays,
    "false\nalarms": lambda m: str(metrics.false_alarms(m.watched).k),
    "tasks\nsolved": _by_response(lambda o: str(o.success.k)),
    "harm\n[N s]": _by_response(lambda o: f"{o.harm:.1f}"),
}
"""One monitor by condition, in the width of a terminal: detection is measured with the policy alone."""

ALL_CONDITION_COLUMNS: dict[str, Callable[[DetectionMetrics], str]] = {
    **CONDITION_COLUMNS,
    "episodes": lambda m: str(len(m.watched)),
    "solved,\nunsafe": _by_response(lambda o: str(o.unsafe.k)),
    "overridden\nsteps": _by_response(lambda o: str(o.overridden_steps)),
    "median\ntime [s]": _by_response(lambda o: f"{o.time:.1f}"),
    "median peak\nforce [N]": _by_response(lambda o: f"{o.peak_force:.1f}"),
}
"""The same for a report."""


def headline(rows: Sequence[DetectionMetrics]) -> str:
    """Return one sentence: detected of all faults, false alarms of all nominal episodes."""
    detected = Share.total([m.detected for m in rows])
    nominal = [trace for m in rows if m.name == NOMINAL for trace in m.watched]
    return (
        f"{count(detected)} faults detected; {count(metrics.false_alarms(nominal))} nominal "
        "episodes with a false alarm."
    )


# ------------------------------------------------------------------ monitors side by side


def monitor_columns(promises: Sequence[AlarmRate]) -> dict[str, Callable[[DetectionMetrics], str]]:
    """Return the columns of monitors side by side."""
    columns: dict[str, Callable[[DetectionMetrics], str]] = {
        "Monitor": lambda m: m.name,
        "AUROC, same steps": _auroc,
    }
    for promise in promises:
        columns[f"Found at {_rate(promise)}"] = partial(_found, promise)
    columns["Median delay [ms]"] = lambda m: milliseconds(m.delays.median_ms)
    columns["False alarms"] = _false_alarms
    columns["Alarms/h"] = lambda m: metrics.hourly_alarms(m.nominal).text
    columns["Right channel"] = lambda m: percent(metrics.attribution_accuracy(m.faulty))
    return columns


def _rate(promise: AlarmRate) -> str:
    """Format as ``1 %`` or ``10/h``."""
    if promise.per == HOUR:
        return f"{promise.rate:g}/h"
    return f"{100 * promise.rate:g} %"


def _auroc(m: DetectionMetrics) -> str:
    auroc = interval(m.auroc, m.draws.auroc)
    return f"{auroc.value:.3f} ({auroc.low:.3f}–{auroc.high:.3f})"


def _found(promise: AlarmRate, m: DetectionMetrics) -> str:
    """Format the share of faults found, or how many calibration episodes the promise needs."""
    share = m.found.get(promise)
    if share is None:
        if promise.per == HOUR:
            return ""
        return f"needs {conformal_episodes(promise.rate)}"
    if promise not in m.draws.found:
        return percent(share)
    found = interval(share.value, m.draws.found[promise])
    return f"{100 * found.value:.0f} % ({100 * found.low:.0f}–{100 * found.high:.0f})"


def _false_alarms(m: DetectionMetrics) -> str:
    share = metrics.false_alarms(m.nominal)
    if not share.n:
        return ""
    low, high = share.interval
    return f"{count(share)} ({100 * low:.0f}–{100 * high:.0f} %)"


def monitors_table(result: BenchmarkResult) -> Table:
    """Return the monitors side by side, the ideal observer on top."""
    left_out = result.left_out
    caption = (
        f"Detection within {1e3 * result.window_s:.0f} ms of the onset, over kinds and severities "
        "of fault that an ideal observer can detect; thresholds from separate nominal episodes, "
        f"delays and alarms at a false-alarm rate of {100 * result.rate:g} % of episodes; in "
        "brackets 95 % intervals over resampled scenes and calibration episodes. AUROC: against "
        "nominal episodes over the same steps. Needs: calibration episodes for that rate, where "
        "there were fewer. Left out: nominal episodes in which the policy failed "
        f"({left_out.failed_episodes}) or crashed ({left_out.crashed_scenes}), and faults in such "
        "scenes."
    )
    hidden = [_in_words(kind) for kind, is_visible in result.visible.items() if not is_visible]
    if hidden:
        caption += f" Kinds that cannot be detected: {', '.join(hidden)}."

    promises = [AlarmRate(rate, EPISODE) for rate in sorted({*RATES, result.rate})]
    promises += [AlarmRate(rate, HOUR) for rate in PER_HOUR]
    monitors = tabulate(caption, monitor_columns(promises), result.on_visible)
    ideal = result.bound(result.visible_kinds)
    found = [percent(ideal.found.get(promise)) for promise in promises]
    delay = milliseconds(ideal.delays.median_ms)
    ideal_row = (IDEAL, f"{ideal.auroc:.3f}", *found, delay, "", "", "")
    return Table(caption, monitors.headings, [ideal_row, *monitors.rows])


def brief_monitors_table(result: BenchmarkResult) -> Table:
    """Return the chief columns without their intervals, narrow enough for a terminal."""
    table = monitors_table(result)
    shown = (*BRIEF_HEADINGS, f"Found at {_rate(result.promise)}")
    columns = [n for n, heading in enumerate(table.headings) if heading in shown]
    rows = []
    for row in table.rows:
        cells = [str(row[n]) for n in columns]
        rows.append([cell.partition(" (")[0] for cell in cells])
    headings = [table.headings[n] for n in columns]
    return Table(f"found within {result.window_s:g} s of the onset", headings, rows)


def kinds_table(result: BenchmarkResult) -> Table:
    """Return AUROC and faults found of every kind."""
    rows = []
    for kind, is_visible in result.visible.items():
        name = _in_words(kind)
        if not is_visible:
            name = f"({name})"
        observers: list[Bound | DetectionMetrics] = [result.bound([kind])]
        observers += [monitor.only([kind]) for monitor in result.monitors.values()]
        row = [name]
        for observer in observers:
            found = percent(observer.found.get(result.promise))
            row.append(f"{observer.auroc:.2f} / {found}")
        rows.append(tuple(row))
    return Table(
        f"AUROC / faults found at a false-alarm rate of {100 * result.rate:g} %. In brackets: no "
        "observer could detect it.",
        ("Fault", IDEAL, *result.monitors),
        rows,
    )


def _in_words(kind: Kind) -> str:
    kind_and_severity = " ".join(kind).strip()
    return kind_and_severity.replace("_", " ")


def lead_table(result: BenchmarkResult) -> Table:
    """Return how far the first monitor is ahead of each other.

    All are compared on the same scenes and calibration episodes.
    """
    first, *others = result.on_visible
    caption = (
        f"How far {first.name} is ahead of each other monitor; 95 % intervals of the paired "
        "difference, which decide between ahead, behind and within chance."
    )
    by_hour = [promise for promise in first.calibration.thresholds if promise.per == HOUR]
    columns: dict[str, Callable[[DetectionMetrics], str]] = {
        "Monitor": lambda m: m.name,
        "AUROC": partial(_auroc_lead, first),
    }
    for promise in (result.promise, *by_hour):
        columns[f"Found at {_rate(promise)} [points]"] = partial(_found_lead, promise, first)
    return tabulate(caption, columns, others)


def _auroc_lead(first: DetectionMetrics, other: DetectionMetrics) -> str:
    lead = interval(first.auroc - other.auroc, first.draws.auroc - other.draws.auroc)
    return _lead(lead, scale=1, digits=3)


def _found_lead(promise: AlarmRate, first: DetectionMetrics, other: DetectionMetrics) -> str:
    if promise not in first.draws.found or promise not in other.draws.found:
        return ""
    difference = first.found[promise].value - other.found[promise].value
    draws = first.draws.found[promise] - other.draws.found[promise]
    return _lead(interval(difference, draws), scale=100, digits=1)


def _lead(difference: Estimate, scale: float, digits: int) -> str:
    """Format how far the first monitor is ahead, its interval, and the verdict."""
    verdict = "within chance"
    if difference.low > 0:
        verdict = "ahead"
    elif difference.high < 0:
        verdict = "behind"
    value, low, high = (f"{scale * number:+.{digits}f}" for number in difference)
    return f"{value} ({low} to {high}), {verdict}"


# ------------------------------------------------------------------ promises and false alarms


def kept_table(result: BenchmarkResult) -> Table:
    """Return the false alarms in nominal test episodes, beside the promise of each threshold."""
    monitors = list(result.monitors.values())
    promises: set[AlarmRate] = set()
    for monitor in monitors:
        promises.update(monitor.calibration.thresholds)
    by_episode = sorted(promise for promise in promises if promise.per == EPISODE)
    by_hour = sorted((promise for promise in promises if promise.per == HOUR), reverse=True)

    nominal = monitors[0].nominal
    hours = sum(len(trace) * trace.dt for trace in nominal) / 3600
    outcomes_of_solved = [trace.outcome for trace in nominal if trace.outcome.success]
    unsafe = Share.of([outcome.unsafe for outcome in outcomes_of_solved])
    caption = (
        f"False alarms in {len(nominal)} nominal test episodes of {hours:.2f} hours, by the "
        "promise of the threshold; 95 % intervals (Wilson, Poisson). Broken: less likely than 1 in "
        f"40 (beta-binomial); by the hour, the interval lies above the promise. {count(unsafe)} "
        f"solved ones pressed with more than {TRANSIENT:g} N."
    )
    return _by_promise(caption, [*by_episode, *by_hour], _kept, monitors)


def _by_promise(
    caption: str,
    promises: Sequence[AlarmRate],
    cell: Callable[[AlarmRate, DetectionMetrics], str],
    monitors: Sequence[DetectionMetrics],
) -> Table:
    """Return a row for each monitor, with a cell for each promise."""
    columns: dict[str, Callable[[DetectionMetrics], str]] = {"Monitor": lambda m: m.name}
    for promise in promises:
        columns[f"promised {_rate(promise)}"] = partial(cell, promise)
    return tabulate(caption, columns, monitors)


def _kept(promise: AlarmRate, m: DetectionMetrics) -> str:
    """Format the false alarms at the threshold of a promise; empty where the monitor has none."""
    threshold = m.calibration.thresholds.get(promise)
    if threshold is None:
        return ""
    nominal = [trace.at(threshold) for trace in m.nominal]
    if promise.per == HOUR:
        return kept_rate(metrics.hourly_alarms(nominal), promise.rate)
    return _kept_share(metrics.false_alarms(nominal), m.calibration, threshold)


def kept_rate(rate: Rate, promised: float) -> str:
    """Format the alarms per hour, and say if the promise was broken."""
    low, _ = rate.interval
    if low > promised:
        return f"{rate.text}, broken"
    return rate.text


def _kept_share(share: Share, calibration: Calibration, threshold: float) -> str:
    """Format the share of episodes with an alarm, and say if the threshold broke its promise.

    ``over`` of n calibration maxima exceed the threshold. Then the probability that a test episode exceeds it has the
    distribution Beta(over + 1, n - over), so the number of test episodes that do is beta-binomial.
    """
    low, high = share.interval
    text = f"{100 * share.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    n = len(calibration.maxima)
    over = int((calibration.maxima > threshold).sum())
    if not share.n or over >= n:
        return text
    chance = stats.betabinom.sf(share.k - 1, share.n, over + 1, n - over)  # of k alarms or more
    if chance < UNLIKELY:
        return f"{text}, broken"
    return text


def splits_table(result: BenchmarkResult) -> Table:
    """Return false alarms and faults found, where one random half of the nominal episodes sets the threshold."""
    caption = (
        f"False alarms that came, and faults found within {1e3 * result.window_s:.0f} ms, where "
        f"{SPLITS} random halves of the nominal episodes for calibration and test set the "
        "threshold and the other halves count: mean ± SD."
    )
    promises = list(result.on_visible[0].calibration.thresholds)
    return _by_promise(caption, promises, _over_splits_of_nominal, result.on_visible)


def _over_splits_of_nominal(promise: AlarmRate, m: DetectionMetrics) -> str:
    """Return the cell of ``over_splits``, whose units are the nominal episodes for calibration and test."""
    surprises = [trace.surprise for trace in m.nominal]
    if promise.per == EPISODE:
        test_maxima = [surprise.max() for surprise in surprises]
        maxima = np.concatenate([m.calibration.maxima, test_maxima])
        one_hour_each = np.ones(len(maxima))
        return over_splits(m, Blocks(maxima, one_hour_each), promise)

    blocks = Blocks.of(surprises, m.nominal[0].dt)
    calibration = m.calibration.blocks
    if calibration is not None:
        maxima = np.concatenate([calibration.maxima, blocks.maxima])
        hours = np.concatenate([calibration.hours, blocks.hours])
        blocks = Blocks(maxima, hours)
    return over_splits(m, blocks, promise)


def over_splits(m: DetectionMetrics, units: Blocks, promise: AlarmRate) -> str:
    """Return false alarms and faults found, mean ± SD over random halves of ``units`` that set the threshold.

    Args:
        m: the faults.
        units: the largest surprise in each episode, which has 1 "hour", or in each block of time.
        promise: of false alarms, by the episode or by the hour.
    """
    rng = np.random.default_rng(0)
    windows = Windows(m.faulty, m.window_s)
    size = len(units.maxima)
    alarms = []  # of each split: false alarms an hour, or an episode
    found = []  # of each split: share of the faults
    for _ in range(SPLITS):
        half = np.zeros(size, bool)
        half[rng.permutation(size)[: size // 2]] = True
        calibration = Blocks(units.maxima[half], units.hours[half])
        try:
            threshold = promise.threshold(calibration.maxima, calibration)
        except ValueError:  # too few units for this promise
            return ""
        false_alarms = (units.maxima[~half] > threshold).sum()
        alarms.append(false_alarms / units.hours[~half].sum())
        found.append(windows.detected(threshold).mean())

    detected = f"{100 * np.mean(found):.1f} ± {100 * np.std(found):.1f} % found"
    if promise.per == HOUR:
        return f"{np.mean(alarms):.2f} ± {np.std(alarms):.2f}/h, {detected}"
    return f"{100 * np.mean(alarms):.2f} ± {100 * np.std(alarms):.2f} %, {detected}"
