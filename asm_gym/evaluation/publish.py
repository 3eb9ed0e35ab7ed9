"""Tables, figures, a report, and one row of Parquet for each episode and monitor."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.evaluation import comparison_plots as plots
from asm_gym.evaluation.comparison import IDEAL, Cell, Score, Sight
from asm_gym.evaluation.plots import attribution_figure, stream_figure, surprise_figure
from asm_gym.evaluation.report import Table, write_report
from asm_gym.evaluation.scoring import Verdict
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.text_tables import markdown
from asm_gym.evaluation.trace import window_steps
from asm_gym.extras import needed_for
from asm_gym.rollouts.benchmark import Judgement

_HEADINGS = ("Monitor", "AUROC", "AP", "Found at 0.5 %", "at 1 %", "at 5 %", "Median delay [ms]", "p95 [ms]")
_MORE = ("False alarms", "per hour", "Balanced accuracy", "Timestep-weighted", "Right channel")


def main_table(judgement: Judgement) -> Table:
    """Monitors side by side, the ideal observer on top."""
    rows = [(IDEAL, *_cell(judgement.ideal()), "", "", "", "", ""), *map(_score, judgement.scores)]
    hidden = [" ".join(k).strip() for k, seen in judgement.visible.items() if not seen]
    left_out = f" Kinds no observer could see, left out: {', '.join(hidden)}." if hidden else ""
    return Table(
        f"Detection within {1e3 * judgement.window_s:.0f} ms of the onset, over kinds of fault and severities that an "
        f"ideal observer can see; thresholds from separate nominal episodes, delays and accuracies at a false-alarm "
        f"rate of {100 * judgement.rate:g} % of episodes; 95 % Wilson intervals in brackets. Nominal episodes that did "
        f"not succeed, {judgement.failed} in all, are left out.{left_out}",
        (*_HEADINGS, *_MORE),
        rows,
    )


def kinds_table(judgement: Judgement) -> Table:
    """AUROC and faults found of every kind."""
    cells = judgement.cells
    monitors = list(cells)
    rows = []
    for kind, seen in judgement.visible.items():
        name = " ".join(part.replace("_", " ") for part in kind if part)
        found = (f"{cells[m][kind].auroc:.2f} / {_percent(cells[m][kind].found.get(judgement.rate))}" for m in monitors)
        rows.append((name if seen else f"({name})", *found))
    return Table(
        f"AUROC / faults found at a false-alarm rate of {100 * judgement.rate:g} %. In brackets: no observer could "
        "see it.",
        ("Fault", *monitors),
        rows,
    )


def harmless_table(judgement: Judgement) -> Table:
    """Alarms at what is no fault."""
    cries = judgement.cries()
    kinds = list(dict.fromkeys(k for own in cries.values() for k in own))
    rows = [(k.replace("_", " "), *(_of(own.get(k)) for own in cries.values())) for k in kinds]
    return Table("Episodes with an alarm under harmless variations.", ("Variation", *cries), rows)


def brief_tables(judgement: Judgement) -> list[Table]:
    """The chief columns of the main table, and the harmless variations, narrow enough for a terminal."""
    rate = judgement.rate

    def row(name: str, cell: Cell, score: Score | None) -> tuple[str, ...]:
        found, delay = _interval(cell.found.get(rate)), _milliseconds(cell.median_ms)
        alarms, right = (f"{score.false_alarms_per_hour:.1f}", _percent(score.attribution)) if score else ("", "")
        return name, f"{cell.auroc:.3f}", found, delay, alarms, right

    summary = Table(
        f"found within {judgement.window_s:g} s at a false-alarm rate of {100 * rate:g} %",
        ("monitor", "AUROC", "found", "median [ms]", "alarms/h", "right channel"),
        [row(IDEAL, judgement.ideal(), None), *(row(s.monitor, s.cell, s) for s in judgement.scores)],
    )
    first = next(iter(judgement.verdicts))
    caption = f"episodes with an alarm of {first} under harmless variations"
    harmless = Table(caption, ("variation", "alarms"), [r[:2] for r in harmless_table(judgement).rows])
    return [summary, harmless]


def publish(folder: Path, judgement: Judgement, details: Mapping[str, Any], video: Path | None = None) -> None:
    """Writes ``results.parquet``, ``results.json``, ``results.md`` and ``report.html``."""
    _write_parquet(folder / "results.parquet", judgement)
    tables = [main_table(judgement), kinds_table(judgement), harmless_table(judgement)]
    (folder / "results.md").write_text("\n\n".join(map(markdown, tables)) + "\n", encoding="utf-8")
    summary = {"settings": details, "tables": [{"headings": t.headings, "rows": t.rows} for t in tables]}
    (folder / "results.json").write_text(json.dumps(summary, indent=1, default=str) + "\n", encoding="utf-8")
    cells = judgement.cells
    severities = list(dict.fromkeys(s for _, s in judgement.visible))
    thresholds = {m: own[judgement.rate] for m, own in judgement.thresholds.items()}
    figures = {
        "AUROC by kind of fault and severity. In brackets: no observer could see it.": plots.heat_map(
            cells, judgement.visible
        ),
        "ROC over all faults, each against nominal episodes of its task in the same steps.": plots.roc_curves(
            judgement.verdicts, judgement.window_s
        ),
        "How soon faults were found.": plots.delay_curves(judgement.verdicts, thresholds, judgement.window_s),
    }
    if len(severities) > 1:
        figures["Faults found at each severity."] = plots.severity_curves(cells, severities, judgement.rate)
    if judgement.examples:
        first = next(iter(judgement.verdicts))
        figures[f"Typical episodes as {first} saw them: surprise over its threshold, the fault's span, the alarms."] = (
            surprise_figure(judgement.examples)
        )
    for trace in judgement.examples:
        figures[f"{trace.title}: the channels that surprised most."] = stream_figure(trace)
        figures[f"{trace.title}: where the surprise came from."] = attribution_figure(trace)
    write_report(
        folder / "report.html",
        "Who notices what",
        f"{len(judgement.sights)} faulty episodes, {len(judgement.verdicts)} monitors. The ideal observer knows the "
        "healthy twin of every faulty episode and the sensors' noise: no monitor can do better than its row.",
        tables,
        figures,
        video,
        details,
    )


def _write_parquet(path: Path, judgement: Judgement) -> None:
    with needed_for("results.parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    sights = {(s.task, s.kind, s.severity, s.seed): s for s in judgement.sights}
    rows = [
        _row(v, sights.get((v.task, v.kind, v.severity, v.seed)), judgement.thresholds[m][judgement.rate], judgement)
        for group in (judgement.verdicts, judgement.harmless)
        for m, verdicts in group.items()
        for v in verdicts
    ]
    unfinished = path.with_name(f".{path.name}.unfinished")
    pq.write_table(pa.Table.from_pylist(rows), unfinished, compression="zstd")
    unfinished.replace(path)


def _row(verdict: Verdict, sight: Sight | None, threshold: float, judgement: Judgement) -> dict[str, Any]:
    after = verdict.detected_after(threshold)
    window = window_steps(judgement.window_s, verdict.dt)
    return {
        "task": verdict.task,
        "monitor": verdict.monitor,
        "kind": verdict.kind,
        "severity": verdict.severity,
        "seed": verdict.seed,
        "onset": verdict.onset,
        "steps": len(verdict),
        "dt": verdict.dt,
        "threshold": threshold,
        "alarm": bool((verdict.surprise > threshold).any()),
        "detected": after is not None and after < window if verdict.onset is not None else None,
        "delay_s": None if after is None else (after + 1) * verdict.dt,
        "peak_in_window": float(verdict.surprise[verdict.window(judgement.window_s)].max(initial=0.0)),
        "blamed": verdict.blamed or None,
        "blamed_rightly": verdict.blamed in verdict.guilty if verdict.blamed and verdict.guilty else None,
        "ideal_separation": sight.separation if sight else None,
        "ideal_delay_s": (sight.earliest + 1) * sight.dt if sight and sight.earliest is not None else None,
        "surprise": np.asarray(verdict.surprise, np.float32).tolist(),
    }


def _score(score: Score) -> tuple[str, ...]:
    return (
        score.monitor,
        *_cell(score.cell),
        f"{score.false_alarms.k} of {score.false_alarms.n}",
        f"{score.false_alarms_per_hour:.1f}",
        f"{score.balanced_accuracy:.3f}",
        f"{score.timestep_weighted_accuracy:.3f}",
        _percent(score.attribution),
    )


def _cell(cell: Cell) -> tuple[str, ...]:
    return (
        f"{cell.auroc:.3f}",
        "" if math.isnan(cell.precision) else f"{cell.precision:.3f}",
        *(_interval(cell.found.get(r)) for r in (0.005, 0.01, 0.05)),
        _milliseconds(cell.median_ms),
        _milliseconds(cell.p95_ms),
    )


def _milliseconds(delay: float) -> str:
    return f"{delay:.0f}" if math.isfinite(delay) else "missed"


def _percent(share: Share | None) -> str:
    return f"{100 * share.value:.0f} %" if share is not None and share.n else ""


def _interval(share: Share | None) -> str:
    if share is None or not share.n:
        return ""
    low, high = share.interval
    return f"{100 * share.value:.0f} % ({100 * low:.0f}–{100 * high:.0f})"


def _of(share: Share | None) -> str:
    return f"{share.k} of {share.n}" if share is not None and share.n else ""
