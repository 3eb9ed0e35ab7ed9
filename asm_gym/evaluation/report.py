"""One self-contained HTML file: tables, figures and a film, with nothing to fetch."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

from matplotlib.figure import Figure

from asm_gym.evaluation.metrics import Row
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.trace import NOMINAL, POLICY_ALONE

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title</title>
<style>
:root { color-scheme: light dark; --paper: #fdfdfc; --ink: #1d2126; --soft: #5c6570; --rule: #dcdfe3; --even: #f4f5f6; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #15181c; --ink: #e8eaed; --soft: #a0a8b2; --rule: #343a42; --even: #1c2026; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 64rem; padding: 3rem 1.5rem; background: var(--paper); color: var(--ink);
       font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; font-weight: 650; margin: 0 0 1rem; }
h2 { font-size: 1.2rem; font-weight: 600; margin: 3rem 0 1rem; break-after: avoid; }
p { max-width: 44rem; margin: 0 0 0.8rem; }
figure { margin: 0 0 2.5rem; break-inside: avoid; }
figcaption { color: var(--soft); font-size: 0.9rem; max-width: 44rem; margin-top: 0.5rem; }
img { display: block; max-width: 100%; height: auto; background: #fff; border-radius: 6px; padding: 0.6rem;
      border: 1px solid var(--rule); }
video { display: block; width: 100%; max-width: 42rem; border-radius: 6px; }
.scroll { overflow-x: auto; margin-bottom: 2.5rem; break-inside: avoid; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
caption { caption-side: top; text-align: left; color: var(--soft); padding-bottom: 0.6rem;
          max-width: min(44rem, 90vw); }
th, td { padding: 0.45rem 0.8rem; text-align: right; vertical-align: top; }
td { white-space: nowrap; }
th:first-child, .text { text-align: left; }
td.text { white-space: normal; min-width: 9rem; }
thead th { border-bottom: 2px solid var(--rule); font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 600; white-space: nowrap; }
tbody tr { border-bottom: 1px solid var(--rule); }
tbody tr:nth-child(even) { background: var(--even); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.25rem 1.5rem; font-size: 0.9rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
@media print {
  :root { --paper: #fff; --ink: #000; --soft: #444; --rule: #bbb; --even: #f4f4f4; }
  body { padding: 0; max-width: none; font-size: 10pt; }
  .film { display: none; }
  .scroll { overflow: visible; }
}
@page { margin: 18mm; }
</style>
</head>
<body>
<main>
<h1>$title</h1>
$body
</main>
</body>
</html>
""")


@dataclass(frozen=True)
class Table:
    """A table: one heading a column, and rows as long as the headings; the first cell of a row names it."""

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"the table has {len(self.headings)} columns, but a row of {len(row)}: {list(row)}")


def detection_table(rows: Sequence[Row], window_s: float) -> Table:
    """What the monitor told, watching the policy alone."""
    window = 1e3 * window_s
    cells = [
        (
            r.condition,
            _share(r.false_alarm_episodes),
            _number(r.false_alarms_per_hour),
            _interval(r.detected),
            _delay(r.delays.median_ms if r.delays else None, window),
            _delay(r.delays.p95_ms if r.delays else None, window),
            "" if r.auroc is None else f"{r.auroc:.2f}",
            ", ".join(f"{label}\u00a0({n})" for label, n in r.top_labels),
        )
        for r in rows
    ]
    return Table(
        f"Detection, the monitor only watching. False alarm: raised before the fault, or at all in nominal episodes. "
        f"Detected: alarm raised within {window:.0f} ms of the onset, with the 95 % Wilson interval; a miss counts as "
        f"infinitely late. AUROC: against nominal episodes over the same steps.",
        ("Condition", "With false alarm", "False alarms per hour", "Detected", "Median delay [ms]",
         "95th percentile [ms]", "AUROC", "Most surprising channel at the alarm"),
        cells,
    )  # fmt: skip


def outcome_table(rows: Sequence[Row]) -> Table:
    """What the override changed, against the policy alone."""
    cells = [
        (
            r.condition,
            o.acting,
            _interval(o.success),
            "" if o.acting == POLICY_ALONE else _share(o.ended_by_alarm),
            _number(o.peak_force),
        )
        for r in rows
        for o in r.outcomes
    ]
    return Table(
        "What acting on the alarm changes. Peak contact force: median over episodes of the greatest force.",
        ("Condition", "Acting", "Task solved", "Ended by the alarm", "Peak contact force [N]"),
        cells,
    )


def headline(rows: Sequence[Row]) -> str:
    """One sentence: detected of all faults, false alarms of all nominal episodes."""
    detected = Share(sum(r.detected.k for r in rows), sum(r.detected.n for r in rows))
    alarms = [r.false_alarm_episodes for r in rows if r.condition == NOMINAL]
    false = Share(sum(a.k for a in alarms), sum(a.n for a in alarms))
    return f"{_share(detected)} faults detected; {_share(false)} nominal episodes with a false alarm."


def write_report(
    path: str | Path,
    title: str,
    intro: str,
    tables: Sequence[Table],
    figures: Mapping[str, Path | Figure],
    video: Path | None = None,
    details: Mapping[str, object] | None = None,
) -> Path:
    """Writes the report; the file appears under its name only when it is complete.

    Args:
        path: the HTML file.
        title: one line.
        intro: plain text; an empty line starts a new paragraph.
        tables: in order.
        figures: caption to a PNG file, or to a Figure.
        video: an MP4 file.
        details: what it takes to make the report again: arguments, seed, versions.
    """
    path = Path(path)
    parts = [f"<p>{escape(p)}</p>" for p in intro.split("\n\n") if p.strip()]
    if video is not None:
        film = (
            f'<video controls muted loop playsinline preload="metadata" src="{_uri("video/mp4", video.read_bytes())}">'
        )
        parts.append(f'<section class="film"><h2>Film</h2>\n{film}This browser plays no MP4.</video></section>')
    if tables:
        parts.append("<section><h2>Results</h2>\n" + "\n".join(map(_table, tables)) + "</section>")
    if figures:
        shown = "\n".join(_shown(caption, figure) for caption, figure in figures.items())
        parts.append(f"<section><h2>Figures</h2>\n{shown}</section>")
    if details:
        items = "\n".join(f"<dt>{escape(k)}</dt><dd>{escape(str(v))}</dd>" for k, v in details.items())
        parts.append(f"<section><h2>How this was made</h2>\n<dl>{items}</dl></section>")
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_text(_PAGE.substitute(title=escape(title), body="\n".join(parts)), encoding="utf-8")
    return unfinished.replace(path)


def _table(table: Table) -> str:
    text = [any(_is_text(row[i]) for row in table.rows) for i in range(len(table.headings))]
    head = "".join(
        f'<th scope="col" class="text">{escape(h)}</th>' if words else f'<th scope="col">{escape(h)}</th>'
        for words, h in zip(text, table.headings, strict=True)
    )
    open_td = ['<td class="text">' if words else "<td>" for words in text]
    body = "\n".join(
        f'<tr><th scope="row">{escape(str(row[0]))}</th>'
        + "".join(f"{td}{escape(str(cell))}</td>" for td, cell in zip(open_td[1:], row[1:], strict=True))
        + "</tr>"
        for row in table.rows
    )
    return (
        f'<div class="scroll"><table><caption>{escape(table.caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def _is_text(cell: object) -> bool:
    """Words are set to the left, numbers to the right."""
    return isinstance(cell, str) and cell[:1].isalpha()


def _shown(caption: str, figure: Path | Figure) -> str:
    if isinstance(figure, Figure):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
        png = buffer.getvalue()
    else:
        png = Path(figure).read_bytes()
    width = int.from_bytes(png[16:20], "big") * 3 // 4  # 150 dpi on a screen of about 112
    return (
        f'<figure><img alt="{escape(caption)}" width="{width}" src="{_uri("image/png", png)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _share(share: Share) -> str:
    return f"{share.k} of {share.n}"


def _interval(share: Share) -> str:
    if not share.n:
        return ""
    low, high = share.interval
    return f"{share.k} of {share.n} ({100 * low:.0f}–{100 * high:.0f} %)"


def _delay(value: float | None, window_ms: float) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if math.isfinite(value) else f"> {window_ms:.0f}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.1f}"
