"""Results as files: one self-contained HTML page, and a benchmark's tables and rows."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from asm_gym.evaluation.comparison import BenchmarkResult
from asm_gym.evaluation.detection_tables import (
    kept_table,
    kinds_table,
    lead_table,
    monitors_table,
    splits_table,
)
from asm_gym.evaluation.scored_episode import window_steps
from asm_gym.evaluation.tables import Table, markdown
from asm_gym.extras import require
from asm_gym.files import write_text, written_whole

_PAGE = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))


def write_report(
    path: str | Path,
    title: str,
    intro: str,
    tables: Sequence[Table],
    drawn: Mapping[str, Figure],
    details: Mapping[str, object] | None = None,
) -> Path:
    """Write an HTML file, which appears when it is complete.

    Args:
        intro: plain text; an empty line starts a new paragraph.
        drawn: figures by caption.
        details: how to make the report again: arguments, seed, versions.
    """
    path = Path(path)
    parts = [f"<p>{escape(p)}</p>" for p in intro.split("\n\n") if p.strip()]
    if tables:
        parts.append("<section><h2>Results</h2>\n" + "\n".join(map(_table, tables)) + "</section>")
    if drawn:
        shown = "\n".join(_figure(caption, figure) for caption, figure in drawn.items())
        parts.append(f'<section><h2>Figures</h2>\n<div class="figures">{shown}</div></section>')
    if details:
        items = "\n".join(
            f"<dt>{escape(k)}</dt><dd>{escape(str(v))}</dd>" for k, v in details.items()
        )
        parts.append(f"<section><h2>How this was made</h2>\n<dl>{items}</dl></section>")
    write_text(path, _PAGE.substitute(title=escape(title), body="\n".join(parts)))
    return path


def _table(table: Table) -> str:
    name, *headings = table.headings
    cells = [list(map(str, row)) for row in table.rows]
    frame = pd.DataFrame(
        [c[1:] for c in cells], pd.Index([c[0] for c in cells]), headings
    ).rename_axis(columns=name)
    with pd.option_context("display.max_colwidth", None):
        start, rest = frame.to_html(border=0).split("\n", 1)
    return f'<div class="scroll">{start}<caption>{escape(table.caption)}</caption>\n{rest}</div>'


def _figure(caption: str, figure: Figure) -> str:
    buffer = io.StringIO()
    with mpl.rc_context(
        {"svg.hashsalt": caption}
    ):  # ids are the same each time, and differ between figures
        figure.savefig(
            buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    svg = buffer.getvalue()[buffer.getvalue().index("<svg") :]
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", svg)  # HTML needs none
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def publish(folder: Path, result: BenchmarkResult, details: Mapping[str, Any]) -> None:
    """Write ``results.parquet``, ``results.md`` and ``report.html``."""
    require("pyarrow", what="results.parquet")
    with written_whole(folder / "results.parquet") as file:
        pd.DataFrame(_rows(result)).to_parquet(file, index=False)
    tables = [monitors_table(result), kept_table(result), splits_table(result), kinds_table(result)]
    if len(result.monitors) > 1:
        tables.insert(1, lead_table(result))
    write_text(folder / "results.md", "\n\n".join(map(markdown, tables)) + "\n")
    intro = (
        f"{len(result.detectability)} faulty episodes, {len(result.monitors)} monitors. The ideal observer knows the "
        "healthy twin of every faulty episode and the sensors' noise: no monitor can do better than its row."
    )
    write_report(folder / "report.html", "Who notices what", intro, tables, {}, details=details)


def _rows(result: BenchmarkResult) -> Iterator[dict[str, Any]]:
    """Yield what each monitor made of each episode."""
    possible = {(d.task, d.kind, d.severity, d.seed): d for d in result.detectability}
    for monitor in result.monitors.values():
        for trace in (*monitor.nominal, *monitor.traces):
            ideal = possible.get((trace.task, trace.kind, trace.severity, trace.seed))
            after, window = trace.detected_after, window_steps(result.window_s, trace.dt)
            yield {
                **{
                    name: getattr(trace, name)
                    for name in ("task", "monitor", "kind", "severity", "seed", "onset")
                },
                "steps": len(trace),
                "dt": trace.dt,
                "threshold": trace.threshold,
                "alarm": bool(trace.alarms),
                "detected": None if trace.onset is None else after is not None and after < window,
                "delay_s": trace.delay,
                "peak_in_window": float(
                    trace.surprise[trace.window(result.window_s)].max(initial=0.0)
                ),
                "blamed": trace.top_channel if after is not None else None,
                "ideal_separation": ideal.separation if ideal else None,
                "ideal_delay_s": ideal.delay if ideal else None,
                "surprise": np.asarray(trace.surprise, np.float32),
            }
